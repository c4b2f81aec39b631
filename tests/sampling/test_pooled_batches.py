import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from pemviz.faults import SimulationError
from pemviz.processes import ProcessPool
from pemviz.proposals.fixed import ConstantProposal
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.batches import PooledRunner
from tests.toy import ConstantPem

HALF = ConstantProposal(detection_probability=0.5)


def at_once(function, *arguments):
    future = Future()
    future.set_result(function(*arguments))
    return future


def drawn(problem, *, count=37):
    return sample(problem, proposal=HALF, count=count, seeds=np.random.SeedSequence(4))


def assert_same(found, expected):
    assert np.array_equal(found.robustness, expected.robustness)
    assert np.array_equal(found.violated, expected.violated)
    for name in ("detected", "pem_logit", "proposal_logit", "log_weight"):
        assert np.array_equal(getattr(found.rollouts, name), getattr(expected.rollouts, name))
    for name, values in expected.rollouts.signals.items():
        assert np.array_equal(found.rollouts.signals[name], values)


@pytest.mark.parametrize("workers", [1, 2, 3, 100])
@pytest.mark.parametrize("batch", [1, 10, 1000])
def test_pieces_put_together_are_the_serial_rollouts(toy_problem, workers, batch):
    problem = replace(toy_problem, batch_rollouts=batch)
    pooled = replace(problem, run_batches=PooledRunner(at_once, workers))
    assert_same(drawn(pooled), drawn(toy_problem))


def test_real_processes_give_the_serial_rollouts_and_end(toy_problem):
    problem = replace(toy_problem, batch_rollouts=10, pem=ConstantPem(0.1))
    with ProcessPool(2) as pool:
        pooled = drawn(replace(problem, run_batches=PooledRunner(pool.submit, 2)))
    assert_same(pooled, drawn(problem))
    assert multiprocessing.active_children() == []


def test_stopping_calls_back_what_was_handed_in(toy_problem):
    handed_in = []

    def never(function, *arguments):
        handed_in.append(Future())
        if len(handed_in) <= 2:
            handed_in[-1].set_result(function(*arguments))
        return handed_in[-1]

    def stop(done, total):
        raise KeyboardInterrupt

    problem = replace(
        toy_problem, batch_rollouts=10, run_batches=PooledRunner(never, 2), progress=stop
    )
    with pytest.raises(KeyboardInterrupt):
        drawn(problem)
    assert len(handed_in) == 4
    assert [future.cancelled() for future in handed_in] == [False, False, True, True]


def test_a_worker_that_is_killed_fails_the_batch_in_one_line(toy_problem):
    problem = replace(toy_problem, pem=ConstantPem(0.1))
    with ProcessPool(1) as pool:
        runner = PooledRunner(lambda function, *rest: pool.submit(time.sleep, 60), 1)
        killer = threading.Thread(target=kill_first_child)
        killer.start()
        with pytest.raises(SimulationError, match="a worker process died"):
            drawn(replace(problem, run_batches=runner))
        killer.join()


def kill_first_child():
    while not multiprocessing.active_children():
        time.sleep(0.05)
    pid = multiprocessing.active_children()[0].pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
