"""One damaged input at a time, under limits on time and memory; what comes out is judged."""

import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from pemviz.errors import InputError
from tests.fuzz.valid import ValidFiles

CASE_S = 10.0
"""Processor time a case may take: a busy machine raises no false alarm."""
EXTRA_BYTES = 400 * 1024 * 1024
"""Memory a case may take beyond what the process has; the inputs have some kilobytes."""
LONGEST_LINE = 2000


class TooSlowError(BaseException):
    """The case's time is over; no handler of the code under test catches it."""


@dataclass(frozen=True)
class Case:
    """What a target gets: what draws the damage, an empty folder for it, files to damage."""

    rng: random.Random
    folder: Path
    valid: ValidFiles


@dataclass(frozen=True)
class Target:
    """Something that reads what users bring, by its name on the command line."""

    name: str
    carry_out: Callable[[Case], None]
    """Damages an input and reads it; an AssertionError: what was accepted is not sound."""
    weight: float
    """Its share of a run's cases."""


@dataclass(frozen=True)
class Finding:
    """Something undocumented came out."""

    target: str
    seed: int
    what: str


@dataclass
class Counts:
    """What became of a target's cases."""

    target: str
    cases: int = 0
    rejected: int = 0
    accepted: int = 0
    wall_s: float = 0.0


@contextmanager
def valid_files() -> Generator[ValidFiles, None, None]:
    """Valid files in a folder that goes with the context; in memory where there is such a disk."""
    memory = Path("/dev/shm")  # noqa: S108
    parent = memory if memory.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="pemviz-fuzz-", dir=parent) as folder:
        yield ValidFiles(Path(folder))


def carry_out(
    target: Target, seeds: Sequence[int], *, valid: ValidFiles, counts: Counts
) -> Iterator[Finding]:
    """Carry out a target's cases; yields what should not have come out."""
    for seed in range(-3, 0):  # import and build what the first case would be charged for
        judge(target, seed, valid=valid, counts=Counts(target.name), limited=False)
    for seed in seeds:
        started_s = time.perf_counter()
        finding = judge(target, seed, valid=valid, counts=counts)
        counts.wall_s += time.perf_counter() - started_s
        if finding is not None:
            yield finding


def judge(
    target: Target, seed: int, *, valid: ValidFiles, counts: Counts, limited: bool = True
) -> Finding | None:
    """One case."""
    folder = Path(tempfile.mkdtemp(dir=valid.folder))
    case = Case(random.Random(f"{target.name}/{seed}"), folder, valid)  # noqa: S311
    counts.cases += 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with _time_limit(limited), _memory_limit(limited):
                target.carry_out(case)
        counts.accepted += 1
    except InputError as error:
        counts.rejected += 1
        if not documented(str(error)):
            return Finding(target.name, seed, f"not one short line: {str(error)[:300]!r}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        story = "".join(traceback.format_exception(error))
        return Finding(target.name, seed, story[-2500:])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return None


def documented(message: str) -> bool:
    """Whether a message is one line that a terminal shows as it is."""
    return 0 < len(message) <= LONGEST_LINE and message.isprintable()


@contextmanager
def _time_limit(limited: bool) -> Generator[None, None, None]:
    if not limited:
        yield
        return

    def over(number: int, frame: FrameType | None) -> None:
        raise TooSlowError(f"more than {CASE_S:g} s of processor time")

    before = signal.signal(signal.SIGPROF, over)
    signal.setitimer(signal.ITIMER_PROF, CASE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def _memory_limit(limited: bool) -> Generator[None, None, None]:
    """Refuse more memory than some kilobytes of input should need; Linux only."""
    if not limited or not sys.platform.startswith("linux"):
        yield
        return
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = pages * resource.getpagesize() + EXTRA_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (now, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
