import multiprocessing
import os

import pytest

from pemviz.errors import ConfigError, RunError
from pemviz.processes import ONE_THREAD
from pemviz.reproduce.workers import Job, no_progress, run_jobs


def square(value):
    return value * value, os.environ.get("OMP_NUM_THREADS")


def refuse(value):
    raise ConfigError(f"value = {value}: must be another")


def leave(value):
    os._exit(value)


def never():
    return False


def jobs_of(function, values):
    return {value: Job(f"job {value}", function, (value,)) for value in values}


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_by_key_with_progress(workers):
    told = []
    results = run_jobs(
        jobs_of(square, range(5)),
        workers=workers,
        on_progress=lambda *what: told.append(what),
        should_stop=never,
    )
    assert {key: value for key, (value, _) in results.items()} == {v: v * v for v in range(5)}
    assert [done for done, _, _ in told] == [1, 2, 3, 4, 5]
    assert {total for _, total, _ in told} == {5}
    assert {label for _, _, label in told} == {f"job {v}" for v in range(5)}


def test_each_process_has_one_thread_and_the_parent_keeps_its_own():
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    results = run_jobs(
        jobs_of(square, range(2)), workers=2, on_progress=no_progress, should_stop=never
    )
    assert {threads for _, threads in results.values()} == {"1"}
    assert {name: os.environ.get(name) for name in ONE_THREAD} == before


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_job_raises_comes_through(workers):
    with pytest.raises(ConfigError, match="must be another"):
        run_jobs(
            jobs_of(refuse, range(2)), workers=workers, on_progress=no_progress, should_stop=never
        )
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("workers", [1, 2])
def test_a_request_to_stop_ends_it(workers):
    with pytest.raises(RunError, match="nothing was written"):
        run_jobs(
            jobs_of(square, range(3)),
            workers=workers,
            on_progress=no_progress,
            should_stop=lambda: True,
        )
    assert multiprocessing.active_children() == []


def test_a_process_that_dies_is_one_line():
    with pytest.raises(RunError, match="a worker process died"):
        run_jobs(jobs_of(leave, (3, 4)), workers=2, on_progress=no_progress, should_stop=never)
