"""Processes that work for this one: one pool, with what every user of it needs."""

import contextlib
import faulthandler
import itertools
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, ParamSpec, Self, TypeVar, cast

from pemviz.errors import RunError
from pemviz.faults import STOPS, exception_text

Given = ParamSpec("Given")
Returned = TypeVar("Returned")
Item = TypeVar("Item")
Result = TypeVar("Result")

DIED = "worker process died: killed, or the machine is out of memory"
KILLED = 9
"""The signal by which the system, out of memory, ends a process, and a pool the rest of its own."""
GUARD = 'a program must begin its work under if __name__ == "__main__":'
POLL_S = 0.2
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def usable_cpus() -> int:
    """How many CPUs this process may use; at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def resident_bytes() -> int:
    """Memory that this process holds; 0 where the system does not say."""
    with contextlib.suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    return 0


def machine_bytes() -> int:
    """Memory that this machine has; 0 where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # as on Windows
        return 0


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
def signals_held_back() -> Generator[None, None, None]:
    """Ctrl-C reaches all processes of a terminal, but the parent alone shall act on it.

    Processes that are started meanwhile hold the signals back for good, from their first
    instruction; the parent gets them afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # as on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent(scratch: Path | None = None) -> None:
    """Let this process end when the one that started it does, and remove the folder ``scratch``."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class _Worker(SpawnProcess):
    """A process whose executor, which waits for it once another has died, can end it."""

    def terminate(self) -> None:
        self.kill()  # SIGTERM is held back


class _Workers(SpawnContext):
    Process = _Worker


class ProcessPool:
    """Processes that work for this one: what every part that wants more than one core uses.

    They are spawned when they are first needed, so that threads and locks of this process are not
    copied. Each has one thread for linear algebra, holds back the terminal's signals, and ends
    with the pool, or by itself when this process dies. One that is killed makes what was handed in
    raise :class:`concurrent.futures.BrokenExecutor`; the pool is of no use until it is renewed.
    """

    def __init__(self, count: int, *, scratch: Path | None = None) -> None:
        """Plan for at least one process; none is started yet.

        If this process dies, the folder ``scratch`` is removed.
        """
        self._processes: list[BaseProcess] = []
        self._retired: list[tuple[threading.Thread, list[BaseProcess]]] = []
        self._count = count
        self._new_executor = partial(
            ProcessPoolExecutor,
            count,
            mp_context=_Workers(),
            initializer=end_with_parent,
            initargs=(scratch,),
        )
        self._executor = self._new_executor()

    def __enter__(self) -> Self:
        """The pool itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """End all processes."""
        self.close()

    def submit(
        self, function: Callable[Given, Returned], *arguments: Given.args, **named: Given.kwargs
    ) -> Future[Returned]:
        """Have a process call a module's function; it and its arguments can be pickled."""
        before = set(multiprocessing.active_children())
        # here and not in the pool's own thread, which would end at what is no Exception
        try:
            call = ForkingPickler.dumps((function, arguments, named))
        except BaseException as error:
            failed: Future[Returned] = Future()
            if not isinstance(error, Exception):
                why = f"pickling what a worker process is to work on raises {exception_text(error)}"
                error = RunError(why)
            failed.set_exception(error)
            return failed
        # a process that stops at the terminal's signals would look like one that died
        with one_thread_each(), signals_held_back():
            try:
                future = self._executor.submit(_called, bytes(call))
            except (OSError, RuntimeError):  # so it is if one dies while another is started
                self._executor.submit(int)  # of a broken pool this says so
                raise
        added = set(multiprocessing.active_children()) - before
        self._processes += added
        if added and len(self._processes) == self._count:
            # the executor looks for deaths among processes that were there when it was last called
            with contextlib.suppress(OSError, RuntimeError):  # of a broken pool the future tells
                self._executor.submit(int)
        return future

    def renew(self) -> str:
        """End all processes; others are started when they are needed.

        Returns:
            How one had ended by itself; empty where none had, or was killed.
        """
        processes = self._processes
        self.close()
        codes = [process.exitcode for process in processes]  # now that nobody else waits for them
        self._start_afresh()
        own = [code for code in codes if code is not None and code != -KILLED]
        return _ending(own[0]) if own else ""

    def retire(self) -> None:
        """Let processes finish what they are at and end; others are started for what comes next.

        What no process is at is cancelled, to be handed in again.
        """
        # in a thread, as an executor that is told not to wait cannot be waited for later
        ending = threading.Thread(
            target=self._executor.shutdown, kwargs={"wait": True, "cancel_futures": True}
        )
        ending.start()
        self._retired.append((ending, self._processes))
        self._start_afresh()

    def _start_afresh(self) -> None:
        self._processes, self._executor = [], self._new_executor()

    def close(self) -> None:
        """End all processes at once, whatever they are at."""
        for process in itertools.chain(self._processes, *(ending for _, ending in self._retired)):
            process.kill()
        self._executor.shutdown(wait=True, cancel_futures=True)
        for ending, _ in self._retired:
            ending.join()
        self._retired.clear()


def _called(call: bytes) -> Any:
    function, arguments, named = cast(Any, ForkingPickler).loads(call)
    return function(*arguments, **named)


def can_be_sent(*things: object) -> bool:
    """Whether another process can have these."""
    try:
        ForkingPickler.dumps(things)
    except BaseException as error:
        exception_text(error)  # raises what a signal raised; else it is theirs, an exit included
        return False
    return True


class ProcessLostError(Exception):
    """A process ended before its work, or said nothing for too long; the words say which."""


def told_by_process(
    function: Callable[..., None], *arguments: Any, limit_s: float | None = None
) -> Iterator[Any]:
    """What a module's function tells in a process of its own, one thing after the other.

    Nothing that the function does there, an abort included, reaches this process; what is not
    looked at any more is ended.

    Args:
        function: Called with what takes a thing to tell, then the arguments; all can be pickled.
        arguments: Of the function.
        limit_s: After the first thing no other may take longer [s]; ``None``: any time.

    Raises:
        ProcessLostError: The process ended, or took too long.
        RunError: What goes to it cannot be pickled.
    """
    try:
        call = bytes(ForkingPickler.dumps((function, arguments)))
    except Exception as error:
        why = f"pickling what a process is to work on raises {exception_text(error)}"
        raise RunError(why) from error
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    process = context.Process(target=_tell_all, args=(call, writer))
    with one_thread_each(), signals_held_back():
        process.start()
    writer.close()  # so that the end of the process is the end of what it tells
    try:
        begun = False
        while True:
            if begun and not reader.poll(limit_s):
                raise ProcessLostError(f"nothing came of it for {limit_s:g} s")
            told = reader.recv()
            if told is None:
                return
            begun = True
            yield told[0]
    except EOFError:
        process.join()
        raise ProcessLostError(_ending(process.exitcode or 0)) from None
    finally:
        process.kill()
        process.join()
        reader.close()


def _tell_all(call: bytes, writer: Connection) -> None:
    end_with_parent()
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)  # what aborts says where
    function, arguments = cast(Any, ForkingPickler).loads(call)

    def tell(thing: Any) -> None:
        writer.send((thing,))

    function(tell, *arguments)
    writer.send(None)


@contextlib.contextmanager
def ending_told(words: str) -> Generator[None, None, None]:
    """Have ``words`` on standard error if this process ends meanwhile without saying so.

    As other people's code can end it, or the system that is out of memory.
    """
    shell = shutil.which("sh")
    if shell is None:  # as on Windows
        yield
        return
    command = [shell, "-c", 'read -r over || printf "%s\\n" "$0" >&2', words]
    # our own words, as an argument
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True) as waiting:  # noqa: S603
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # somebody ended it
                waiting.communicate(b"over\n")


def _is_program() -> bool:
    """Whether what runs is a script of the user's own, which processes that are spawned import."""
    main = sys.modules["__main__"]
    is_script = getattr(main, "__spec__", None) is None
    path = getattr(main, "__file__", None) or ""
    return is_script and Path(path).stem not in {"", __package__}


def _ending(exit_code: int) -> str:
    if exit_code == 1 and _is_program():  # its import in the process may have begun the work anew
        return f"the process ended with exit code 1; {GUARD}"
    if exit_code >= 0:
        return f"the process ended with exit code {exit_code}"
    with contextlib.suppress(ValueError):  # of a signal that has no name here
        return f"the process was ended by {signal.Signals(-exit_code).name}"
    return f"the process was ended by signal {-exit_code}"


def map_in_processes(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int,
    on_done: Callable[[int], None] | None = None,
    check_stop: Callable[[], None] | None = None,
) -> list[Result]:
    """The results for all items, in their order, whatever the number of processes.

    Args:
        function: A module's function; it, items and results can be pickled.
        items: What it is called with, one after the other.
        workers: How many processes call it; with 1 this one does.
        on_done: Told the index of an item when its result is there.
        check_stop: Called several times a second; what it raises ends all processes at once.

    Raises:
        RunError: A process died.
        Exception: What a call raised.
    """
    pause, tell = check_stop or _nothing, on_done or _nothing
    results: dict[int, Result] = {}
    if workers == 1 or len(items) <= 1:
        for index, item in enumerate(items):
            pause()
            results[index] = function(item)
            tell(index)
        return list(results.values())
    with ProcessPool(min(workers, len(items))) as pool:
        futures = {pool.submit(function, item): index for index, item in enumerate(items)}
        pending = set(futures)
        while pending:
            pause()
            done, pending = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                try:
                    results[futures[future]] = future.result()
                except BrokenExecutor as error:
                    raise RunError(f"a {DIED}") from error
                tell(futures[future])
    return [results[index] for index in range(len(items))]


def _nothing(*_: object) -> None: ...
