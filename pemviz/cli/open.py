"""``pemviz open``: look at a recording."""

from collections.abc import Sequence

from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import check_fields
from pemviz.recording.open import OpenArguments, open_recording

DESCRIPTION = "Show a run's recording in rerun's viewer until it is closed or Ctrl-C is pressed."


def run(words: Sequence[str]) -> int:
    """Carry out the command.

    Raises:
        InputError: There is no such recording, or an argument is wrong.
        RunError: The viewer failed.
    """
    arguments = parse_arguments(OpenArguments, words, command="open", description=DESCRIPTION)
    check_fields(arguments)
    return open_recording(arguments)
