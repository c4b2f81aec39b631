"""What processes that work for this one need: one thread each, no signals of the terminal's."""

import contextlib
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
INTERRUPT = (signal.SIGINT,)
ALL_STOPS = (signal.SIGINT, signal.SIGTERM)


def usable_cpus() -> int:
    """How many CPUs this process may use; at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@contextlib.contextmanager
def one_thread_each() -> Generator[None, None, None]:
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


@contextlib.contextmanager
def signals_held_back(
    numbers: tuple[signal.Signals, ...] = INTERRUPT,
) -> Generator[None, None, None]:
    """Ctrl-C reaches all processes of a terminal, but the parent alone shall act on it.

    Processes that are started meanwhile hold the signals back for good, from their first
    instruction; the parent gets them afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # as on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent(scratch: Path | None = None) -> None:
    """Let this process end when the one that started it does, however that ended.

    Args:
        scratch: A folder that nobody needs then; removed.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def process_pool(count: int) -> Generator[Callable[..., Future[Any]], None, None]:
    """Yield what takes a function and its arguments to one of ``count`` processes.

    They are started when they are first needed, ended when the context is left, and end by
    themselves if this process dies.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        count, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent
    )

    def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        with one_thread_each(), signals_held_back(ALL_STOPS):
            return pool.submit(function, *arguments)

    try:
        yield submit
    finally:
        for child in set(multiprocessing.active_children()) - before:
            child.kill()
        pool.shutdown(wait=True, cancel_futures=True)
