import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, wait
from multiprocessing.context import SpawnProcess

import pytest

from pemviz.errors import RunError
from pemviz.processes import GUARD, ONE_THREAD, STOPS, ProcessPool, can_be_sent, map_in_processes


def slowest_first(value):
    time.sleep(0.2 if value == 0 else 0.0)
    return -value


def surroundings(_):
    """What a process sees: signals held back, threads for linear algebra."""
    held_back = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return set(STOPS) <= held_back, {os.environ.get(name) for name in ONE_THREAD}


def leave(value):
    os._exit(value)


def sleep_after_telling(seconds):
    print("working", flush=True)
    time.sleep(seconds)


class LeavesWhenPickled:
    def __reduce__(self):
        raise SystemExit(0)


class LeavesWhenUnpickled:
    def __reduce__(self):
        return sys.exit, (0,)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_results_are_in_the_items_order_and_each_is_told_once(workers):
    told = []
    results = map_in_processes(slowest_first, range(4), workers=workers, on_done=told.append)
    assert results == [0, -1, -2, -3]
    assert sorted(told) == [0, 1, 2, 3]
    assert multiprocessing.active_children() == []


def test_processes_hold_signals_back_and_have_one_thread_while_the_parent_keeps_its_own():
    before = surroundings(None)
    assert map_in_processes(surroundings, range(2), workers=2) == [(True, {"1"})] * 2
    assert surroundings(None) == before


def test_a_process_that_dies_is_one_line():
    with pytest.raises(RunError, match="a worker process died") as caught:
        map_in_processes(leave, (3, 4), workers=2)
    assert "\n" not in str(caught.value)
    assert multiprocessing.active_children() == []


def test_what_leaves_when_it_is_pickled_is_not_waited_for():
    """The pool's own thread would end at it, and nobody would say so."""
    with pytest.raises(RunError, match="a worker process is to work on raises SystemExit: 0"):
        map_in_processes(slowest_first, (LeavesWhenPickled(), 1), workers=2)
    with pytest.raises(SystemExit):
        map_in_processes(slowest_first, (LeavesWhenUnpickled(), 1), workers=2)


def test_a_request_to_stop_ends_processes_at_once():
    """Long before they would be done: they are killed, not waited for."""
    began_s = time.monotonic()

    def check_stop():
        if len(multiprocessing.active_children()) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_in_processes(time.sleep, (600.0, 600.0), workers=2, check_stop=check_stop)
    assert time.monotonic() - began_s < 300.0
    assert multiprocessing.active_children() == []


def test_the_death_of_one_pools_process_leaves_the_others_alone():
    with ProcessPool(1) as one, ProcessPool(1) as other:
        dying, living = one.submit(leave, 3), other.submit(slowest_first, 0)
        with pytest.raises(BrokenExecutor):
            dying.result()
        assert living.result() == 0
        one.close()
        assert other.submit(slowest_first, 1).result() == -1


def test_a_pool_in_which_a_process_died_ends_the_others_and_says_so():
    """They hold back the signal that an executor ends its processes with, and waits for."""
    with ProcessPool(2) as pool:
        pool.submit(time.sleep, 600)
        dying = pool.submit(leave, 3)
        processes = multiprocessing.active_children()
        assert isinstance(dying.exception(), BrokenExecutor)
        # a thread of the executor's waits for them too, and may not have told yet
        end_s = time.monotonic() + 60.0
        while any(process.is_alive() for process in processes) and time.monotonic() < end_s:
            time.sleep(0.01)
        assert [process.is_alive() for process in processes] == [False, False]
        with pytest.raises(BrokenExecutor):
            pool.submit(slowest_first, 1)


def test_a_process_that_dies_while_another_is_started_is_said_as_at_any_other_time(monkeypatch):
    start = SpawnProcess.start

    def after_the_other_died(process):
        wait([dying], timeout=5)  # no longer: where a lock guards a start it is told afterwards
        time.sleep(0.1)  # till the executor has let go of what a start hands over
        start(process)

    with ProcessPool(2) as pool:
        dying = pool.submit(leave, 3)
        monkeypatch.setattr(SpawnProcess, "start", after_the_other_died)
        with pytest.raises(BrokenExecutor):
            pool.submit(slowest_first, 1).result()


PARENT = """
import time
from pemviz.processes import ProcessPool
from tests.test_processes import sleep_after_telling
if __name__ == "__main__":
    with ProcessPool(1) as pool:
        pool.submit(sleep_after_telling, 600).result()
"""


def test_processes_end_when_their_parent_is_killed(tmp_path, request):
    began_s = time.monotonic()
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env={**os.environ, "PYTHONPATH": str(request.config.rootpath)},
    ) as parent:  # fmt: skip
        assert parent.stdout is not None
        assert parent.stdout.readline().strip() == "working"
        parent.kill()
        # The child holds the pipe's other end too: the pipe is at its end once both have ended.
        assert parent.stdout.read() == ""
    assert time.monotonic() - began_s < 300.0


UNGUARDED = """
from concurrent.futures import wait
from pemviz.processes import ProcessPool

pool = ProcessPool(1)
wait([pool.submit(abs, -3)])
print(pool.renew())
"""


def test_a_program_that_begins_its_work_where_it_is_imported_is_told_so(tmp_path, request):
    script = tmp_path / "program.py"
    script.write_text(UNGUARDED, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=True, timeout=300.0,
        env={**os.environ, "PYTHONPATH": str(request.config.rootpath)},
    )  # fmt: skip
    assert done.stdout == f"the process ended with exit code 1; {GUARD}\n"


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("os._exit(7)", "the process ended with exit code 7"),
        ("os._exit(0)", "the process ended with exit code 0"),
        ("os.abort()", "the process was ended by SIGABRT"),
        ("os.kill(os.getpid(), 9)", ""),  # as the system does that is out of memory
    ],
)
def test_a_pool_that_is_renewed_tells_how_a_process_had_ended(how, told):
    with ProcessPool(2) as pool:
        futures = [pool.submit(exec, f"import os; {how}"), pool.submit(time.sleep, 60.0)]
        wait(futures)
        assert all(isinstance(future.exception(), BrokenExecutor) for future in futures)
        assert pool.renew() == told
        assert pool.submit(abs, -3).result(timeout=60.0) == 3
        assert pool.renew() == ""


@pytest.mark.parametrize(
    ("how", "code"),
    [("os._exit(0)", 0), ("os.kill(os.getpid(), 9)", -9), ("pass", 0), ("1 / 0", 1)],
)
def test_the_end_of_a_process_is_told_where_it_does_not_tell_itself(how, code):
    words = "gone; it's in `run` $HOME 100%"
    script = (
        f"import os\nfrom pemviz.processes import ending_told\nwith ending_told({words!r}): {how}"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert ended.returncode == code
    last = ended.stderr.splitlines()[-1:]
    assert last == {"pass": [], "1 / 0": ["ZeroDivisionError: division by zero"]}.get(how, [words])


def test_what_another_process_can_have():
    assert can_be_sent(1.5, "words", slowest_first)
    assert not can_be_sent(lambda: 0)
    assert not can_be_sent(LeavesOnlyWithAnError())
    assert not can_be_sent(LeavesWhenPickled())


class LeavesOnlyWithAnError:
    def __reduce__(self):
        raise ValueError("never")
