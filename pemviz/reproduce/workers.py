"""Jobs on a few processes: in any order, with progress, ending at once when asked to stop."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pemviz.errors import RunError

POLL_S = 0.2
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Job:
    """A call of a module's function with arguments that can be pickled.

    Attributes:
        label: For progress displays.
        function: What is called.
        arguments: With what.
    """

    label: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


OnProgress = Callable[[int, int, str], None]


def no_progress(done: int, total: int, label: str) -> None:
    """Take no note of what is done."""


def run_jobs(
    jobs: Mapping[Any, Job],
    *,
    workers: int,
    on_progress: OnProgress,
    should_stop: Callable[[], bool],
) -> dict[Any, Any]:
    """Results by the jobs' keys, whatever the number of processes.

    Raises:
        RunError: Asked to stop, or a process died.
        Exception: What a job raised.
    """
    if workers == 1 or len(jobs) <= 1:
        return _in_turn(jobs, on_progress=on_progress, should_stop=should_stop)
    before = set(multiprocessing.active_children())
    with _one_thread_each():
        pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
        try:
            with _interrupts_held_back():
                futures = {pool.submit(j.function, *j.arguments): key for key, j in jobs.items()}
            results = _collect(jobs, futures, on_progress=on_progress, should_stop=should_stop)
        except BaseException:
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        pool.shutdown()
    return results


def _in_turn(
    jobs: Mapping[Any, Job], *, on_progress: OnProgress, should_stop: Callable[[], bool]
) -> dict[Any, Any]:
    results: dict[Any, Any] = {}
    for key, job in jobs.items():
        _raise_if(should_stop())
        results[key] = job.function(*job.arguments)
        on_progress(len(results), len(jobs), job.label)
    return results


def _collect(
    jobs: Mapping[Any, Job],
    futures: dict[Future[Any], Any],
    *,
    on_progress: OnProgress,
    should_stop: Callable[[], bool],
) -> dict[Any, Any]:
    results: dict[Any, Any] = {}
    pending = set(futures)
    while pending:
        _raise_if(should_stop())
        done, pending = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
        for future in done:
            key = futures[future]
            try:
                results[key] = future.result()
            except BrokenProcessPool as error:
                message = "a worker process died; the machine may be out of memory"
                raise RunError(message) from error
            on_progress(len(results), len(jobs), jobs[key].label)
    return results


def _raise_if(stop: bool) -> None:
    if stop:
        message = "interrupted; nothing was written"
        raise RunError(message)


@contextmanager
def _interrupts_held_back() -> Generator[None, None, None]:
    """Ctrl-C reaches all processes of a terminal, but the parent alone shall act on it.

    Processes that are started meanwhile hold it back for good, from their first instruction;
    the parent gets it afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # as on Windows
        yield
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextmanager
def _one_thread_each() -> Generator[None, None, None]:
    """Let child processes start with one thread for linear algebra, as each has one core."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
