"""What code of other people's raises while it is evaluated: one line, with where and how.

Simulators, error models, proposals and methods may raise anything, SystemExit and KeyboardInterrupt
included. Whoever calls them hands what they raise to :func:`blame`; what a signal raises, a
person's Ctrl-C above all, is no fault of theirs and passes.
"""

import contextlib
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType, TracebackType
from typing import Any, NoReturn, TypeVar

from pemviz.errors import InputError, RunError, one_line

Refusal = TypeVar("Refusal", bound=InputError)

STOPS = (signal.SIGINT, signal.SIGTERM)
MARK = "_pemviz_from_outside"
LIBRARIES = ("pemviz", "numpy", "scipy", "torch")
"""Whose code other people's may be reached through; a traceback that ends there is shown whole."""
LONGEST_TRACEBACK = 100
"""Lines; of a longer one the middle is left out."""


class StopRequested(Exception):  # noqa: N818  not an error: the user asked
    """Raised between batches when a run is to stop."""


class SimulationError(RunError):
    """A simulator or model raised something, gave what is no number, or gave nothing in time.

    Those that it passes on its way add what they know of where that was. All it holds are numbers
    and text: it can be sent from one process to another.

    Attributes:
        what: What was evaluated, and what came of it.
        why: What was raised, or what is allowed.
        step: The scenario's own step, or those that were evaluated at once.
        rollouts: Which of the stage's: the one, or all that were evaluated at once.
        among: One of so many, where they do not lie beside each other.
        ahead: So many stages after the one that is being carried out.
        during: The stage and the repetition, in words.
        broke: Whether it is the simulator that raised something, or failed in our words.
        outcomes: How many outcomes the rollouts had by then, where they are counted.
    """

    def __init__(
        self,
        what: str,
        *,
        why: str = "",
        step: int | range | None = None,
        rollouts: range | None = None,
        traceback_text: str | Callable[[], str] = "",
    ) -> None:
        """Tell what is known where it happened."""
        super().__init__(what, traceback_text=traceback_text)
        self.what, self.why, self.step, self.rollouts = what, why, step, rollouts
        self.among: int | None = None
        self.ahead = 0
        self.during = ""
        self.broke = False
        self.outcomes: int | None = None

    def __str__(self) -> str:
        """One line: what, where, why."""
        rollouts = _numbered("rollout", self.rollouts)
        if self.among is not None:
            rollouts = f"one of {self.among} rollouts"
        place = ", ".join(part for part in (rollouts, _numbered("step", self.step)) if part)
        where = f" in {place}" if place else ""
        during = f" ({self.during})" if self.during else ""
        return one_line(f"{self.what}{where}{during}{f': {self.why}' if self.why else ''}")

    def add(self, *, step: int | range | None = None, rollouts: range | None = None) -> None:
        """Where it was, as far as that is not known better."""
        self.step = step if self.step is None else self.step
        self.rollouts = rollouts if self.rollouts is None else self.rollouts


def _numbered(name: str, numbers: int | range | None) -> str:
    if numbers is None:
        return ""
    if isinstance(numbers, int) or len(numbers) == 1:
        return f"{name} {numbers if isinstance(numbers, int) else numbers[0]}"
    return f"{name}s {numbers[0]} to {numbers[-1]}" if numbers else ""


def blame(
    error: BaseException,
    what: str,
    *,
    step: int | range | None = None,
    rollouts: range | None = None,
    breaks: bool = False,
) -> NoReturn:
    """Raise what tells of an error that something raised.

    Args:
        error: What was raised.
        what: By what.
        step: See :class:`SimulationError`.
        rollouts: Likewise, as they are counted where this is called.
        breaks: Whether it is a simulator that raised it.

    Raises:
        SimulationError: With where it was, as far as that was not known.
        BaseException: As it came, what a signal raised, a request to stop, or a complaint about
            what was given.
    """
    error = presentable(error)
    if from_outside(error) is not None or isinstance(error, StopRequested | InputError):
        raise error
    if isinstance(error, SimulationError):
        error.add(step=step, rollouts=rollouts)
        raise error
    if isinstance(error, RunError):  # in our words
        found = SimulationError(str(error))
    else:
        found = SimulationError(
            f"{what} raises {type(error).__name__}",
            why=message_of(error),
            traceback_text=partial(traceback_of, error),
        )
    found.broke = breaks
    found.add(step=step, rollouts=rollouts)
    raise found from error


@contextlib.contextmanager
def counted_from(first: int, count: int | None = None) -> Generator[None, None, None]:
    """Let a fault name rollouts that are counted from another one on.

    Args:
        first: What the first of them counts as.
        count: How many there are, for a fault that does not say which it was.
    """
    try:
        yield
    except SimulationError as error:
        if count is not None:
            error.add(rollouts=range(count))
        if error.rollouts is not None:
            error.rollouts = range(error.rollouts.start + first, error.rollouts.stop + first)
        raise


@contextlib.contextmanager
def reordered(order: Sequence[int]) -> Generator[None, None, None]:
    """Let a fault in one rollout name the place that it had before they were put in ``order``."""
    try:
        yield
    except SimulationError as error:
        if error.rollouts is not None and len(error.rollouts) == 1:
            row = order[error.rollouts[0]]
            error.rollouts = range(row, row + 1)
        raise


@contextlib.contextmanager
def of_no_rollouts() -> Generator[None, None, None]:
    """Let a fault name none of a stage's rollouts: it is others that are evaluated here."""
    try:
        yield
    except SimulationError as error:
        error.rollouts, error.ahead = None, 0
        raise


@contextlib.contextmanager
def refusing() -> Generator[None, None, None]:
    """Let what other people's code does while it is looked at be bad input, an exit included.

    Raises:
        InputError: One line that says whose code it was.
    """
    try:
        yield
    except SimulationError as error:
        raise refused(InputError(str(error)), error) from error.__cause__
    except BaseException as error:
        if isinstance(error, Exception) or from_outside(error) is not None:
            raise
        last = traceback.extract_tb(_from_theirs(error.__traceback__))[0]
        message = (
            f"{last.name} ({last.filename}, line {last.lineno}) raises {exception_text(error)}"
        )
        raise refused(InputError(message), error) from error


def exception_text(error: BaseException) -> str:
    """What other people's code raised, in one line; what a signal raised is raised on.

    Raises:
        BaseException: It comes from outside.
    """
    if from_outside(error) is not None:
        raise error
    if isinstance(error, SimulationError):
        return str(error) if error.__cause__ is None else exception_text(error.__cause__)
    text, kind = message_of(error), type(error).__name__
    return f"{kind}: {text}" if text else kind


def presentable(error: BaseException) -> BaseException:
    """What was raised, or one that stands for it if to look at it would raise more."""
    try:
        for each in _chain(error):
            shown = each.__class__, each.__traceback__, getattr(each, MARK, False)
            shown = *shown, getattr(each, "__notes__", ())
    except BaseException:  # theirs, as all of it
        kind = type.__getattribute__(type(error), "__name__")
        return RuntimeError(f"a {kind} that cannot be looked at")
    return error


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An error and what led to it, each once."""
    seen: set[int] = set()
    each: BaseException | None = error
    while each is not None and id(each) not in seen:
        yield each
        seen.add(id(each))
        each = each.__cause__ or each.__context__


def message_of(error: BaseException) -> str:
    """An error's message in one line."""
    try:
        return " ".join(str(error).split())
    except BaseException:  # theirs, as all of it
        return "its message cannot be shown"


def traceback_of(error: BaseException) -> str:
    """The traceback as Python prints it, from the first frame on that is other people's.

    All of it where none is; lines do nothing to a terminal.
    """
    try:
        theirs = _from_theirs(error.__traceback__)
        found = traceback.TracebackException(type(error), error, theirs)
        lines = "".join(found.format()).splitlines()
    except BaseException:  # theirs, as all of it
        return "its traceback cannot be shown"
    if len(lines) > LONGEST_TRACEBACK:
        half = LONGEST_TRACEBACK // 2
        lines = [*lines[:half], f"  ... {len(lines) - 2 * half} lines ...", *lines[-half:]]
    return "\n".join(one_line(line) for line in lines)


def refused(refusal: Refusal, raised: BaseException) -> Refusal:
    """The refusal of what other people's code raised, with its traceback."""
    if isinstance(raised, RunError):
        refusal.traceback_text = raised.traceback_text
    else:
        ours = {*LIBRARIES, *sys.stdlib_module_names}
        each = raised.__traceback__
        while each is not None and _home(each) in ours:
            each = each.tb_next
        refusal.traceback_text = "" if each is None else traceback_of(raised)
    return refusal


def _from_theirs(frames: TracebackType | None) -> TracebackType | None:
    each = frames
    while each is not None and (_home(each) == "pemviz" or _home(each) in sys.stdlib_module_names):
        each = each.tb_next
    return frames if each is None or _home(each) in LIBRARIES else each


def _home(frames: TracebackType) -> str:
    return str(frames.tb_frame.f_globals.get("__name__", "")).split(".")[0]


@dataclass(frozen=True)
class _Marking:
    """A signal's handler; what it raises can be told from what other code raises."""

    handler: Callable[[int, FrameType | None], Any]

    def __call__(self, number: int, frame: FrameType | None) -> None:
        try:
            self.handler(number, frame)
        except BaseException as error:
            mark_from_outside(error)
            raise


def mark_from_outside(error: BaseException) -> None:
    """Let :func:`from_outside` know it."""
    setattr(error, MARK, True)


@contextlib.contextmanager
def signals_distinguished() -> Generator[None, None, None]:
    """While this lasts, it is known what signals raise; handlers do what they did.

    Only the main thread gets signals: elsewhere there is nothing to do.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in STOPS}
    marking = {n: _Marking(h) for n, h in before.items() if callable(h)}
    for number, handler in marking.items():
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, handler in marking.items():
            if signal.getsignal(number) is handler:  # else somebody wants another one
                signal.signal(number, before[number])


def from_outside(error: BaseException) -> BaseException | None:
    """What a signal raised, be it the error or what led to it; ``None``: it is another's.

    Where that cannot be told, a KeyboardInterrupt counts as a signal's.
    """
    for each in _chain(error):
        if getattr(each, MARK, False):
            return each
    return error if isinstance(error, KeyboardInterrupt) and _may_get_signals() else None


def _may_get_signals() -> bool:
    """Whether a Ctrl-C may raise something in this thread that is not marked."""
    if threading.current_thread() is not threading.main_thread():
        return False
    if isinstance(signal.getsignal(signal.SIGINT), _Marking | signal.Handlers):
        return False
    if not hasattr(signal, "pthread_sigmask"):  # as on Windows
        return True
    held_back = signal.pthread_sigmask(signal.SIG_BLOCK, ())  # as in worker processes
    return signal.SIGINT not in held_back
