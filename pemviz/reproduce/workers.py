"""Jobs on a few processes: in any order, with progress, ending at once when asked to stop."""

import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from pemviz.errors import RunError
from pemviz.processes import one_thread_each, signals_held_back

POLL_S = 0.2


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
    with one_thread_each():
        pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
        try:
            with signals_held_back():
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
