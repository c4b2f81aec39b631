"""Arguments parsed by tyro into a dataclass, with tyro's complaints cut to one line."""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Annotated, TypeVar

import tyro

from pemviz.cli.help import HelpPage, asked_help, help_text
from pemviz.config.ranges import Range
from pemviz.config.typed_text import PERCENT, share_of
from pemviz.errors import EXIT_DONE, HelpShown, InputError

Arguments = TypeVar("Arguments")
Processes = Annotated[int, Range(low=1, high=1024)]
"""An option that several commands have."""

FRAME = re.compile("[\u2500-\u257f]+|-{4,}|^[|+]|[|+]$", re.MULTILINE)
"""Around a complaint, also where a terminal has no letters but ASCII's."""
COLOUR = re.compile("\x1b\\[[0-9;]*m")
MISSING = re.compile(r"Required options Missing from .*?: (?P<options>.*)")
NO_NUMBER = re.compile(
    r"Error parsing (?P<option>\S+): .*?(?:could not convert string to float"
    r"|invalid literal for (?P<whole>int)\(.*?10): (?P<word>'.*?')"
)
"""Of a number, also one that may be left out."""


def parse_arguments(
    kind: type[Arguments],
    words: Sequence[str],
    *,
    command: str,
    default: Arguments | None = None,
    description: str | None = None,
    program: str = "pemviz",
    page: HelpPage | None = None,
) -> Arguments:
    """Parse a command's words into ``kind``; ``--help`` prints and exits with 0.

    Args:
        kind: A dataclass whose field docstrings are the help texts.
        words: The words after the command.
        command: Its name, for messages.
        default: Values of fields that the words leave out; without it, the fields' own.
        description: Shown above the options.
        program: What the command is one of.
        page: What ``--help`` shows, with its topics; without it, all options.

    Raises:
        InputError: One line with tyro's complaint.
    """
    topic = asked_help(words)
    if topic is not None and page is not None:
        print(help_text(page, topic, kind, default=default))
        raise HelpShown(EXIT_DONE)
    given = [PERCENT.sub(share_of, word) for word in words] if topic is None else ["--help"]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                kind,
                prog=f"{program} {command}",
                args=given,
                description=description,
                config=(tyro.conf.FlagCreatePairsOff,),
                default=tyro.MISSING_NONPROP if default is None else default,
            )
    except SystemExit as stop:
        if not stop.code:
            raise HelpShown(EXIT_DONE) from None
        text = one_line(complaint.getvalue(), command=f"{program} {command}")
        raise InputError(text) from None


def one_line(complaint: str, *, command: str) -> str:
    """A framed, coloured, wrapped complaint as one plain line."""
    text = " ".join(FRAME.sub(" ", COLOUR.sub("", complaint)).split())
    text = re.sub(r" ?(Argument helptext:|For full helptext,).*$", "", text)
    text = re.sub(r" ?Perhaps you meant: (\S+).*$", r"; did you mean \1?", text)
    text = re.sub(r"^(Unrecognized options) \1:", r"\1:", text)
    text = re.sub(r"^(Value error|Missing argument|Parsing error|Invalid choice) ", "", text)
    if missing := MISSING.match(text):
        names = [part.split()[0] for part in missing["options"].split("(required)") if part.strip()]
        text = f"must be given: {', '.join(names)}"
    if wrong := NO_NUMBER.match(text):
        kind = "a whole number" if wrong["whole"] else "a number"
        text = f"{wrong['option']} {wrong['word']}: must be {kind}"
    return f"{text.strip() or 'the arguments cannot be read'} (see {command} --help)"
