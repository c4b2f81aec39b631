"""``pemviz record``: run an experiment, keep it in a run folder, set an exit code by it."""

from collections.abc import Sequence

from pemviz.cli.record_arguments import parse


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The arguments are wrong; nothing was simulated or written.
        RunError: The run failed.
    """
    arguments = parse(words)
    from pemviz.cli.record_run import record  # noqa: PLC0415  --help answers without it

    return record(arguments)
