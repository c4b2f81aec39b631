"""The errors a user can act on, each one line: what, where, allowed; and the exit codes."""

from collections.abc import Callable

EXIT_DONE = 0
EXIT_GATE_TRIPPED = 1
EXIT_BAD_INPUT = 2
EXIT_FAILED = 3
EXIT_GATE_UNDECIDED = 4

LONGEST_MESSAGE = 1000
"""Characters; a message that quotes more than that from a file loses its middle."""
KEPT_END = 300


class HelpShown(SystemExit):
    """A command printed its help; nothing else may end the process from within."""


class PemvizError(Exception):
    """Base of every error that pemviz raises on purpose.

    Messages quote names and values from files that may come from anywhere: whatever they hold,
    the message stays one short line that does nothing to a terminal.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class InputError(PemvizError):
    """Something the user gave is wrong; the command line exits with code 2.

    Attributes:
        traceback_text: Where the user's own code raised something, as Python prints it; empty
            where it did not.
    """

    traceback_text: str = ""


class ConfigError(InputError):
    """A configuration value is unknown, out of range or contradicts another."""


class PemError(InputError):
    """A perception error model, or the data for one, cannot be used; one line says why."""


class RunError(PemvizError):
    """A run could not be carried to its end; the command line exits with code 3.

    Attributes:
        traceback_text: Where other people's code raised something, from their frames on, as Python
            prints it; empty if it is no fault of such code's.
        rollout: Repetition, stage and number of the one rollout at which a run failed; ``None``
            where it was not at one, or at several.
    """

    def __init__(
        self,
        message: str = "",
        *,
        traceback_text: str | Callable[[], str] = "",
        rollout: tuple[int, int, int] | None = None,
    ) -> None:
        """Keep all three; what gives the text is asked for it late, as few errors are shown."""
        super().__init__(message)
        self._traceback, self.rollout = traceback_text, rollout

    @property
    def traceback_text(self) -> str:
        """See above."""
        if not isinstance(self._traceback, str):
            self._traceback = self._traceback()
        return self._traceback

    def __reduce__(self) -> str | tuple[object, ...]:
        """To another process goes the text."""
        self._traceback = self.traceback_text
        return super().__reduce__()


class UndecidedError(PemvizError):
    """Nothing may be decided by an answer; a gate exits with code 4."""


def one_line(text: str) -> str:
    """``text`` with blanks for line breaks, escapes for what cannot be printed, cut if long."""
    if len(text) > LONGEST_MESSAGE:
        start = LONGEST_MESSAGE - KEPT_END
        text = f"{text[:start]} ... {text[-KEPT_END:]}"
    if text.isprintable():
        return text
    return "".join(_shown(character) for character in text)


def _shown(character: str) -> str:
    if character.isprintable():
        return character
    return " " if character.isspace() else character.encode("unicode_escape").decode("ascii")
