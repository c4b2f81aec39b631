"""Worker processes and the compiled loop simulate what numpy does in one, to the last bit."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import RunError
from pemviz.faults import SimulationError
from pemviz.pem import as_pem, load_pem
from pemviz.processes import ProcessPool
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.problem import sample, side_by_side
from pemviz.sampling.rollouts import pooled as pooled_rollouts
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.runners import BatchTask, CompiledRunner, run_here
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.simulators.braking import compiled, vectorized
from pemviz.simulators.braking.compiled import CompiledRollouts, Loops, compiled_loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import StateBatch
from tests.toy import ConstantPem, MissCounter

HALF = ConstantProposal(detection_probability=0.5)


def at_once(function, *arguments):
    future = Future()
    future.set_result(function(*arguments))
    return future


def sampled(problem, *, count=37):
    return sample(problem, proposal=HALF, count=count, seeds=np.random.SeedSequence(4))


def assert_same_scores(found, expected):
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
    assert_same_scores(sampled(pooled), sampled(toy_problem))


def test_real_processes_give_the_serial_rollouts_and_end(toy_problem):
    problem = replace(toy_problem, batch_rollouts=10, pem=ConstantPem(0.1))
    with ProcessPool(2) as pool:
        pooled = sampled(replace(problem, run_batches=PooledRunner(pool.submit, 2)))
    assert_same_scores(pooled, sampled(problem))
    assert multiprocessing.active_children() == []


def test_stopping_calls_back_what_was_handed_in(toy_problem):
    handed_in = []

    def never(function, *arguments):
        handed_in.append(Future())
        if len(handed_in) <= 4:  # two rollouts alone, and what else the first batch has
            handed_in[-1].set_result(replace(function(*arguments), took_s=0.001))
        return handed_in[-1]

    def stop(done, total):
        raise KeyboardInterrupt

    problem = replace(
        toy_problem, batch_rollouts=10, run_batches=PooledRunner(never, 2), progress=stop
    )
    with pytest.raises(KeyboardInterrupt):
        sampled(problem)
    assert [future.cancelled() for future in handed_in] == [False] * 4 + [True] * 2


@pytest.mark.parametrize(
    ("start_s", "each_s", "rest"), [(0.3, 0.001, [144, 144]), (0.0, 0.05, 29 * [10])]
)
def test_pieces_are_sized_by_what_one_rollout_more_takes(toy_problem, start_s, each_s, rest):
    """One that is started for each piece, and steps rollouts side by side, gets large ones."""
    handed_in = []

    def submit(function, simulator, pem, task):
        handed_in.append(len(task.uniforms))
        done = Future()
        done.set_result(
            replace(function(simulator, pem, task), took_s=start_s + each_s * handed_in[-1])
        )
        return done

    problem = replace(toy_problem, run_batches=PooledRunner(submit, 2))
    assert_same_scores(sampled(problem, count=300), sampled(toy_problem, count=300))
    assert handed_in[:4] == [1, 1, 5, 5]
    assert len(handed_in[4:]) == len(rest)
    assert max(handed_in[4:]) == max(rest)


class ClosedClientError(Exception):
    """As Dask's client raises once it has given up."""


@pytest.mark.parametrize("goes_after", [0, 1, 5])
@pytest.mark.parametrize("raises", [False, True])
def test_a_scheduler_that_goes_is_told_as_that(toy_problem, raises, goes_after):
    handed_in = []

    def submit(function, *arguments):
        handed_in.append(Future())
        if len(handed_in) <= goes_after:
            handed_in[-1].set_result(function(*arguments))
        elif raises:
            raise ClosedClientError("Client is closed")
        else:
            handed_in[-1].cancel()
        return handed_in[-1]

    problem = replace(toy_problem, batch_rollouts=10, run_batches=PooledRunner(submit, 2))
    with pytest.raises(RunError, match=r"^the cluster's scheduler is gone, or cannot be reached"):
        sampled(problem)


def test_a_scheduler_that_is_gone_is_told_as_that_of_what_is_begun_beside(toy_problem):
    def submit(*_):
        raise ClosedClientError("Client is closed")

    task = BatchTask(PemProposal(), np.full((1, 6), 0.5), None)
    with pytest.raises(RunError, match=r"^the cluster's scheduler is gone"):
        PooledRunner(submit, 2).hand_in(toy_problem.simulator, toy_problem.pem, task)


def test_a_scheduler_that_takes_work_and_is_gone_is_not_waited_for(toy_problem):
    looks = iter([True, True, False])
    runner = PooledRunner(lambda *_: Future(), 2, is_there=lambda: next(looks))
    with pytest.raises(RunError, match=r"^the cluster's scheduler is gone"):
        sampled(replace(toy_problem, run_batches=runner))


def test_a_worker_that_is_killed_fails_the_batch_in_one_line(toy_problem):
    problem = replace(toy_problem, pem=ConstantPem(0.1))
    with ProcessPool(1) as pool:
        runner = PooledRunner(lambda function, *rest: pool.submit(time.sleep, 60), 1)
        killer = threading.Thread(target=kill_first_child)
        killer.start()
        with pytest.raises(SimulationError, match="a worker process died"):
            sampled(replace(problem, run_batches=runner))
        killer.join()


@dataclass(frozen=True)
class Aborts(MissCounter):
    """Ends its process at rollouts with certain outcomes; once only if there is a file for it."""

    outcomes: tuple[bool, ...] = ()
    once: str = ""
    end: Callable[[], None] = os.abort

    def initial(self, *, count):
        begun = super().initial(count=count)
        return StateBatch(step=begun.step, signals=begun.signals, memory={"as": np.ones(count)})

    def step(self, states, detected):
        alike = states.memory["as"] * (detected == self.outcomes[int(states.step)])
        reached = super().step(states, detected)
        again = bool(self.once) and Path(self.once).exists()
        if int(reached.step) == self.states - 1 and alike.any() and not again:
            if self.once:
                Path(self.once).touch()
            self.end()
        return StateBatch(step=reached.step, signals=reached.signals, memory={"as": alike})


@pytest.fixture
def with_one_alike(toy_problem):
    """A problem of 13 steps with its serial rollouts, and one whose outcomes no other has."""
    problem = replace(toy_problem, simulator=MissCounter(states=14), pem=ConstantPem(0.1))
    serial = sampled(replace(problem, batch_rollouts=6))
    outcomes = [tuple(row) for row in serial.rollouts.detected.tolist()]
    (number, *_) = [n for n in range(20, 37) if outcomes.count(outcomes[n]) == 1]
    return replace(problem, batch_rollouts=6), serial, number, outcomes[number]


def test_what_was_lost_with_a_worker_is_simulated_again(with_one_alike, tmp_path):
    problem, serial, _, outcomes = with_one_alike
    simulator = Aborts(states=14, outcomes=outcomes, once=str(tmp_path / "aborted"))
    with ProcessPool(2) as pool:
        runner = PooledRunner(pool.submit, 2, renew=pool.renew)
        found = sampled(replace(problem, simulator=simulator, run_batches=runner))
    assert_same_scores(found, serial)
    assert (tmp_path / "aborted").exists()
    assert runner.lost == 1
    assert multiprocessing.active_children() == []


def test_a_rollout_that_ends_every_worker_is_named(with_one_alike):
    problem, _, number, outcomes = with_one_alike
    simulator = Aborts(states=14, outcomes=outcomes)
    with ProcessPool(2) as pool:
        runner = PooledRunner(pool.submit, 2, renew=pool.renew)
        words = (
            rf"worker processes were lost .* in rollout {number}: the process was ended by SIGABRT"
        )
        with pytest.raises(SimulationError, match=words):
            sampled(replace(problem, simulator=simulator, run_batches=runner))
    assert multiprocessing.active_children() == []


def test_a_worker_that_stalls_is_replaced_as_one_that_died(with_one_alike, tmp_path):
    """Threads take part as workers: those that stall are left behind, as processes are killed."""
    problem, serial, number, outcomes = with_one_alike
    released, pools = threading.Event(), [ThreadPoolExecutor(2)]

    def submit(function, *arguments):
        return pools[-1].submit(function, *arguments)

    def renew():
        pools[-1].shutdown(wait=False, cancel_futures=True)
        pools.append(ThreadPoolExecutor(2))

    once = Aborts(states=14, outcomes=outcomes, once=str(tmp_path / "one"), end=released.wait)
    runner = PooledRunner(submit, 2, renew=renew, limit_s=1.5)
    try:
        found = sampled(replace(problem, simulator=once, run_batches=runner))
        assert_same_scores(found, serial)
        assert runner.lost >= 1
        words = rf"lost one after the other in rollout {number}: one rollout takes longer than st"
        with pytest.raises(SimulationError, match=words):
            sampled(replace(problem, simulator=replace(once, once=""), run_batches=runner))
    finally:
        released.set()


def test_what_a_worker_imports_is_no_rollout_s_time(with_one_alike):
    """Threads take part as workers, which are there only after longer than a rollout may take."""
    problem, serial, _, _ = with_one_alike

    def begun():
        return ThreadPoolExecutor(1, initializer=time.sleep, initargs=(1.6,))

    pools = [begun()]

    def submit(function, *arguments):
        return pools[-1].submit(function, *arguments)

    def renew():
        pools[-1].shutdown(wait=False, cancel_futures=True)
        pools.append(begun())

    for loses in (False, True):
        runner = PooledRunner(submit, 1, renew=renew, limit_s=0.3, loses=loses)
        found = sampled(replace(problem, run_batches=runner))
        assert_same_scores(found, serial)
        assert not lost_rows(found.rollouts).any()
        renew()


def test_workers_that_come_later_get_work_too(toy_problem):
    there, handed_in = iter([1, 8]), []

    def elsewhere(function, simulator, pem, task):
        handed_in.append(len(task.uniforms))
        return at_once(function, simulator, pem, task)

    runner = PooledRunner(elsewhere, 1, recount=lambda: next(there))
    problem = replace(toy_problem, batch_rollouts=50, run_batches=runner)
    expected = sampled(toy_problem, count=40)
    assert_same_scores(sampled(problem, count=40), expected)
    alone = len(handed_in)
    assert_same_scores(sampled(problem, count=40), expected)
    assert len(handed_in) - alone == 8
    assert side_by_side(problem) == 8


def test_slow_rollouts_are_handed_in_one_by_one(toy_problem):
    """So that the limit is one of a rollout, and no worker waits for another for long."""
    sizes = []

    def elsewhere(function, simulator, pem, task):
        future = Future()
        sizes.append(len(task.uniforms))
        took_s = 3.0 * len(task.uniforms)
        future.set_result(replace(function(simulator, pem, task), took_s=took_s))
        return future

    problem = replace(toy_problem, run_batches=PooledRunner(elsewhere, 4))
    assert_same_scores(sampled(problem), sampled(toy_problem))
    assert sizes == [1] * 37


def kill_first_child():
    while not multiprocessing.active_children():
        time.sleep(0.05)
    pid = multiprocessing.active_children()[0].pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)


PEM = load_pem("ml-nn")
SCENARIOS = st.builds(
    ScenarioConfig,
    initial_speed_kmh=st.floats(1.0, 144.0),
    initial_gap_m=st.floats(1.0, 60.0),
    lead_deceleration_mps2=st.floats(0.0, 20.0),
    lead_brake_time_s=st.floats(0.0, 1.0),
    emergency_gap_m=st.floats(1.0, 60.0),
    speed_gain_per_s=st.floats(0.0, 5.0),
    speed_integral_gain_per_s2=st.floats(0.0, 2.0),
    maximum_acceleration_mps2=st.floats(0.0, 5.0),
    maximum_deceleration_mps2=st.floats(0.0, 5.0),
    dt_s=st.floats(0.01, 0.3),
    states=st.integers(2, 14),
)


@pytest.fixture(params=["as written", "compiled"])
def loops(request):
    """The loops; Python's own numbers wrap around as the compiled ones do, but warn."""
    if request.param == "as written":
        with np.errstate(over="ignore"):
            yield Loops()
        return
    pytest.importorskip("numba")
    found = compiled_loops()
    assert found is not None
    yield found


def assert_same(found, expected):
    for part in ("signals", "memory"):
        one, other = getattr(found, part), getattr(expected, part)
        assert list(one) == list(other)
        for name, values in other.items():
            np.testing.assert_array_equal(one[name], values, err_msg=name)
            assert one[name].T.flags.c_contiguous
    for name in ("detected", "pem_logit", "proposal_logit"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert found.latents is expected.latents is None


def both(simulator, rollouts, uniforms, pem=PEM):
    expected = simulate(simulator=simulator, pem=pem, proposal=PemProposal(), uniforms=uniforms)
    assert_same(rollouts.simulate(uniforms), expected)


@settings(max_examples=25, deadline=None)
@given(config=SCENARIOS, seed=st.integers(0, 2**31))
def test_random_scenarios_written_out(config, seed):
    simulator, generator = VectorizedSimulator(config), np.random.default_rng(seed)
    rollouts = CompiledRollouts(simulator, PEM.logit, Loops())
    uniforms = generator.random((6, config.states - 1))
    with np.errstate(over="ignore"):
        both(simulator, rollouts, uniforms)  # nothing is known: all by numpy
        both(simulator, rollouts, uniforms)  # all is known: all by the loop
        both(simulator, rollouts, generator.random((6, config.states - 1)))  # some


@pytest.mark.parametrize("pem", ["ml-nn", "gb-raw", "ml-nn-ensemble"])
def test_shipped_models_and_tables_that_grow(loops, pem, monkeypatch):
    simulator, generator = VectorizedSimulator(ScenarioConfig(states=20)), np.random.default_rng(3)
    monkeypatch.setattr(compiled, "FEWEST_PLACES", 4)
    model = load_pem(pem)
    rollouts = CompiledRollouts(simulator, model.logit, loops)
    for count in (3, 70, 1, 200):
        both(simulator, rollouts, generator.random((count, 19)), model)


def test_a_full_table_is_begun_anew(loops, monkeypatch):
    simulator, generator = VectorizedSimulator(ScenarioConfig(states=30)), np.random.default_rng(4)
    monkeypatch.setattr(compiled, "FEWEST_PLACES", 64)
    monkeypatch.setattr(compiled, "MOST_PLACES", 256)
    rollouts = CompiledRollouts(simulator, PEM.logit, loops)
    for _ in range(4):
        both(simulator, rollouts, generator.random((40, 29)))


def test_every_config_and_number_of_the_scenario_is_told(loops):
    """town01 has another speed, deceleration and limit; the lead car may brake late."""
    config = ScenarioConfig(
        initial_speed_kmh=30.0, lead_deceleration_mps2=8.0, maximum_acceleration_mps2=2.0,
        lead_brake_time_s=0.7, emergency_deceleration_mps2=6.0, states=40,
    )  # fmt: skip
    simulator, generator = VectorizedSimulator(config), np.random.default_rng(5)
    rollouts = CompiledRollouts(simulator, PEM.logit, loops)
    for _ in range(2):
        both(simulator, rollouts, generator.random((50, 39)))


SIMULATOR = VectorizedSimulator(ScenarioConfig())


@pytest.mark.parametrize(
    ("simulator", "pem", "proposal"),
    [
        (VectorizedSimulator(ScenarioConfig(tracker="2/3")), PEM, PemProposal()),
        (SIMULATOR, as_pem(SimpleNamespace(logit=PEM.logit)), PemProposal()),
        (SIMULATOR, PEM, ConstantProposal(0.5)),
        (build_experiment(ExperimentConfig(memory_s=0.2)).problem.simulator, PEM, PemProposal()),
    ],
)
def test_what_the_loop_does_not_know_numpy_simulates(simulator, pem, proposal, monkeypatch):
    monkeypatch.setattr(vectorized, "compiled_loops", Loops)
    task = BatchTask(proposal, np.full((2, simulator.states - 1), 0.5))
    assert CompiledRunner(0)._compiled(simulator, pem, task) is None
    assert CompiledRunner(0)._compiled(SIMULATOR, PEM, replace(task, proposal=PemProposal()))


@pytest.mark.parametrize("broken", ["absent", "no cache", "fails"])
def test_without_a_numba_that_works_numpy_simulates(broken, monkeypatch, caplog):
    def njit(function=None, *, cache=False):
        if broken == "fails":
            raise ImportError("Numba needs NumPy 1.26 or less")
        if cache:
            raise RuntimeError("cannot cache function")
        return function

    monkeypatch.setattr(compiled, "find_spec", lambda _: None if broken == "absent" else "there")
    monkeypatch.setitem(sys.modules, "numba", SimpleNamespace(njit=njit))
    compiled_loops.cache_clear()
    try:
        found = compiled_loops()
        uniforms = np.random.default_rng(6).random((2, 99))
        with np.errstate(over="ignore"):
            batches = list(CompiledRunner(0)(SIMULATOR, PEM, [BatchTask(PemProposal(), uniforms)]))
    finally:
        compiled_loops.cache_clear()
    assert (found is None) == (broken != "no cache")
    assert ("numpy computes" in caplog.text) == (broken == "fails")
    expected = next(run_here(SIMULATOR, PEM, [BatchTask(PemProposal(), uniforms)]))
    assert_same(batches[0], expected)


def test_a_stage_does_not_depend_on_the_loop_or_its_batches():
    pytest.importorskip("numba")
    problem = build_experiment(ExperimentConfig(method="monte-carlo")).problem
    by_numpy, by_loop = (
        sample(
            replace(problem, run_batches=runner, batch_rollouts=size),
            proposal=PemProposal(), count=1500, seeds=np.random.SeedSequence(8),
        )
        for runner, size in ((run_here, 1500), (CompiledRunner(first_by_numpy=400), 350))
    )  # fmt: skip
    assert_same(by_loop.rollouts, by_numpy.rollouts)
    np.testing.assert_array_equal(by_loop.robustness, by_numpy.robustness)
    assert np.unique(by_numpy.robustness).size > 10


class Keeps(MissCounter):
    """Every call of ``step`` keeps 4 MB in its process for good."""

    kept: ClassVar[list[np.ndarray]] = []

    def step(self, states, detected):
        self.kept.append(np.ones(2**19))
        return super().step(states, detected)


def test_workers_that_grow_are_replaced_and_nothing_is_lost(toy_problem, monkeypatch):
    """After 100 MB, which each holds after five pieces."""
    monkeypatch.setattr(pooled_rollouts, "GROWN_BYTES", 100 * 2**20)
    monkeypatch.setattr(pooled_rollouts, "LEAST_PIECES", 3)
    monkeypatch.setattr(pooled_rollouts, "AHEAD_S", 0.0)  # or workers are done before one is asked
    problem = replace(toy_problem, batch_rollouts=6, pem=ConstantPem(0.1))
    processes = set()

    def submit(function, *arguments):
        future = pool.submit(function, *arguments)
        future.add_done_callback(note)
        return future

    def note(future):
        if not future.cancelled():
            processes.add(future.result().process)

    with ProcessPool(2) as pool:
        runner = PooledRunner(submit, 2, renew=pool.renew, retire=pool.retire)
        simulator = Keeps(states=problem.simulator.states)
        found = sampled(replace(problem, simulator=simulator, run_batches=runner), count=73)
    assert_same_scores(found, sampled(problem, count=73))
    assert runner.lost == 0
    assert runner.retired >= 1
    assert len(processes) >= 3
    assert multiprocessing.active_children() == []
