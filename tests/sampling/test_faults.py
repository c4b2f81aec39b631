"""Simulators that raise, return what is no number, or hang."""

import dataclasses
import pickle
import signal
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from pemviz.faults import SimulationError, from_outside, signals_distinguished
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.runners import by_numpy
from pemviz.sampling.splitting.run import split as splitting
from pemviz.sampling.subset.run import SubsetSimulation
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.simulators.episodic import side_by_side
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.stl import FormulaMonitor, parse
from tests.slot_toys import TwoCars
from tests.toy import FunctionPem, MissCounter, constant_pem, splitting_runs, subset_runs

STATES = 12


@dataclass(frozen=True)
class Faulty(MissCounter):
    """After ``good_steps`` steps, does what ``fault`` does to the gaps."""

    states: int = STATES
    good_steps: int = 5
    fault: object = None

    def step(self, states, detected):
        after = super().step(states, detected)
        if int(after.step) <= self.good_steps:
            return after
        return replace(after, signals={"gap": self.fault(after.signals["gap"])})


def problem_of(fault, **options):
    return Problem(
        simulator=Faulty(fault=fault),
        pem=constant_pem(detection_probability=0.9),
        robustness=lambda signals: signals["gap"].min(axis=1),
        violated=lambda signals: signals["gap"].min(axis=1) < 0.0,
        **options,
    )


def draw(problem, count=10):
    return sample(problem, proposal=PemProposal(), count=count, seeds=np.random.SeedSequence(0))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_no_number_is_told_with_rollout_and_step(value):
    def spoil(gap):
        spoiled = gap.copy()
        spoiled[min(2, gap.size - 1)] = value
        return spoiled

    with pytest.raises(SimulationError) as caught:
        draw(problem_of(spoil, batch_rollouts=4), count=10)
    words = str(caught.value)
    assert "simulator miss-counter: gap is" in words
    assert "rollout 2, step 6" in words


def test_rows_for_fewer_rollouts_are_told_before_a_monitor_meets_them():
    """Which watches for violations while rollouts unfold."""
    monitor = FormulaMonitor(parse("always[0,11] (gap >= 0)"))
    problem = with_absorbing_violation(
        problem_of(lambda gap: gap[:-1], batch_rollouts=4, monitor=monitor)
    )
    words = (
        r"simulator miss-counter: gap has shape \(3,\) in rollouts 0 to 3, step 6: must be \(4,\)"
    )
    with pytest.raises(SimulationError, match=words):
        draw(problem, count=10)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e101])
def test_logits_that_are_no_finite_number_are_refused(value):
    """They cannot be read back from a kept stage, and differences of them are no number."""
    pem = FunctionPem(lambda x: np.full(x.shape[0], value))
    words = r"error model: logit is .* in rollout 0, step 0: must be a finite number"
    with pytest.raises(SimulationError, match=words):
        draw(replace(problem_of(lambda gap: gap), pem=pem))


def split(problem, runs=splitting_runs):
    method = runs(stages=2, rollouts=5, seed=0)
    return method.step(problem, method.init(problem, repetition=0))


@pytest.mark.parametrize("carry_out", [draw, split, partial(split, runs=subset_runs)])
def test_a_simulator_that_hangs_fails_in_time(carry_out):
    released = threading.Event()

    def hang(gap):
        released.wait(60.0)
        return gap

    problem = problem_of(hang, step_time_limit_s=0.2)
    try:
        with pytest.raises(SimulationError, match=r"longer than step_time_limit_s = 0\.2"):
            carry_out(problem)
    finally:
        released.set()


@pytest.mark.parametrize("carry_out", [draw, split, partial(split, runs=subset_runs)])
def test_a_slow_simulator_is_no_fault_while_its_steps_are_done_in_time(carry_out):
    def slowly(gap):
        time.sleep(0.04)
        return gap

    problem = problem_of(slowly, step_time_limit_s=0.2)
    began = time.monotonic()
    carry_out(problem)
    assert time.monotonic() - began > 0.2


class Odd(BaseException):
    """What nobody expects."""


RAISED = (SystemExit(0), SystemExit(1), KeyboardInterrupt(), Odd("neither"), StopIteration(),
          GeneratorExit(), ZeroDivisionError("wheel fell off"))  # fmt: skip


@dataclass(frozen=True)
class Raises(MissCounter):
    """Raises something at a step, as soon as more rollouts than it is tried with are there."""

    states: int = STATES
    at: int = 5
    error: BaseException = dataclasses.field(default_factory=lambda: ValueError("wheel fell off"))

    def step(self, states, detected):
        if int(states.step) == self.at and states.shape[0] > 4:
            raise self.error
        return super().step(states, detected)


def raising(**options):
    return replace(problem_of(lambda gap: gap), simulator=Raises(**options))


@pytest.mark.parametrize("error", RAISED, ids=repr)
@pytest.mark.parametrize("limit_s", [None, 5.0])
def test_whatever_a_simulator_raises_is_told_with_its_place(error, limit_s):
    problem = replace(raising(error=error), batch_rollouts=30, step_time_limit_s=limit_s)
    with signals_distinguished(), pytest.raises(SimulationError) as caught:
        draw(problem, count=50)
    words = (
        f"simulator miss-counter: step raises {type(error).__name__} in rollouts 0 to 29, step 5"
    )
    assert str(caught.value).startswith(words)
    assert caught.value.__cause__ is error
    first, *frames = caught.value.traceback_text.splitlines()
    assert first.startswith("Traceback")
    assert __file__ in frames[0]


def at_once(function, *arguments):
    future = Future()
    try:
        future.set_result(function(*arguments))
    except BaseException as error:
        future.set_exception(error)
    return future


def test_rollouts_are_counted_from_the_first_of_the_stage(monkeypatch):
    """Only the second batch has so few rollouts."""
    monkeypatch.setattr("pemviz.sampling.rollouts.pooled.PIECE_S", 1e9)  # however busy

    class Late(Raises):
        def step(self, states, detected):
            if states.shape[0] == 300 and int(states.step) == 3:
                raise ValueError("late")
            return MissCounter.step(self, states, detected)

    problem = replace(raising(), simulator=Late(), batch_rollouts=700)
    with pytest.raises(SimulationError, match="in rollouts 700 to 999, step 3: late"):
        draw(problem, count=1000)
    pooled = replace(problem, run_batches=PooledRunner(at_once, 2), batch_rollouts=1300)
    with pytest.raises(SimulationError, match="in rollouts 1300 to 1599, step 3: late"):
        draw(pooled, count=1900)


class Places:
    """An environment that fails at a step of the episode that is the so many-th from now."""

    name, states, dt_s, signals = "places", 41, 0.1, MissCounter(states=41).signals

    def __init__(self, episode, step, outcome=None):
        self.left, self.step_, self.outcome = episode, step, outcome

    def reset(self):
        self.left, self.now, self.gap = self.left - 1, 0, 3.5
        return {"gap": self.gap}

    def step(self, detected):
        if self.left < 0 and self.now == self.step_:
            if isinstance(self.outcome, BaseException):
                raise self.outcome
            return self.outcome
        self.now, self.gap = self.now + 1, self.gap - (not detected)
        return {"gap": self.gap}, False

    def salient(self, signals):
        return signals["gap"][..., None]


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        (ValueError("wheel fell off"), "step raises ValueError in {}, step 30: wheel fell off"),
        (SystemExit(0), "step raises SystemExit in {}, step 30: 0"),
        (None, "step gives nothing in {}, step 30: must be two things, signals by name and"),
        (({"gap": [1.0]}, False), r"gap is an array of shape \(1,\) in {}, step 30: must be one"),
        (({"speed": 1.0}, False), r"gives \['speed'\], signals declare \['gap'\] in {}, step 30"),
        (({"gap": np.nan}, False), "gap is nan in {}, step 31: must be a finite number"),
    ],
    ids=["error", "exit", "nothing", "an array", "other names", "no number"],
)
@pytest.mark.parametrize("beside", [1, 3])
def test_an_environment_that_fails_names_the_very_rollout(outcome, words, beside):
    """Rollout 100 is place 1 of 3 in the 34th reset of each, or the 101st of the one."""
    made = [Places(10_000, 30) for _ in range(beside)]
    made[100 % beside] = Places(100 // beside, 30, outcome)
    simulator = side_by_side(made)
    problem = replace(problem_of(None), simulator=simulator, batch_rollouts=60)
    with pytest.raises(SimulationError, match=words.format("rollout 100")):
        draw(problem, count=140)


@pytest.mark.parametrize(("rows", "shape"), [(slice(1), "1,"), (0, ""), (slice(3), "3,")])
def test_a_wrong_shape_is_refused_where_numpy_would_repeat_it(rows, shape):
    words = rf"gap has shape \({shape}\) in rollouts 0 to 9, step 6: must be \(10,\)"
    with pytest.raises(SimulationError, match=words):
        draw(problem_of(lambda gap: gap[rows]))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda after: replace(after, signals={}), r"gives \[\] in rollouts 0 to 9, step 5"),
        (lambda after: None, "gives a NoneType in rollouts 0 to 9, step 4"),
    ],
)
def test_signals_or_states_that_go_missing_are_reported_with_their_step(spoil, words):
    class Forgets(MissCounter):
        def step(self, states, detected):
            after = super().step(states, detected)
            return spoil(after) if int(states.step) == 4 else after

    with pytest.raises(SimulationError, match=words):
        draw(replace(problem_of(None), simulator=Forgets(states=STATES)))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (SystemExit(0), "logit raises SystemExit in {}, step 3: 0"),
        (lambda x: np.zeros(1), r"logit has shape \(1,\) in {}, step 3: must be"),
        (lambda x: None, r"logit has shape \(\) in {}, step 3: must be"),
    ],
    ids=["exit", "one for all", "nothing"],
)
@pytest.mark.parametrize(
    ("carry_out", "who"), [(draw, "rollouts 0 to 9"), (split, "one of 10 rollouts")]
)
def test_an_error_model_that_fails_is_told_with_its_step(answer, words, carry_out, who):
    asked = []

    def logit(salient):
        asked.append(0)
        if len(asked) <= 3:
            return np.zeros(salient.shape[0])
        if isinstance(answer, BaseException):
            raise answer
        return answer(salient)

    problem = replace(problem_of(lambda gap: gap), pem=FunctionPem(logit))
    with pytest.raises(SimulationError, match=words.format(who)):
        carry_out(problem)


def test_slots_turns_are_no_steps():
    class Fails(TwoCars):
        def step(self, states, detected):
            if int(states.step) == 4:
                raise ValueError("wheel fell off")
            return super().step(states, detected)

    problem = Problem(
        simulator=UnrolledSimulator(Fails(starts=(3, 4), states=11, in_view=3)),
        pem=FunctionPem(lambda salient: np.zeros(salient.shape[:-1])),
        robustness=lambda signals: next(iter(signals.values())).min(axis=1),
        violated=None,
        turns=2,
    )
    with pytest.raises(SimulationError, match="ValueError in rollouts 0 to 9, step 4: wheel"):
        draw(problem)


@dataclass(frozen=True)
class SpoiltLate(MissCounter):
    """No number at step 8 once the third miss has come, which no rollout begins with."""

    states: int = STATES

    def step(self, states, detected):
        after = super().step(states, detected)
        gap = after.signals["gap"].copy()
        gap[(gap < 1.0) & (int(after.step) == 8)] = np.nan
        return replace(after, signals={"gap": gap})


def test_splitting_names_run_and_particle():
    """The first that is no number, of all runs, is among the particles that were drawn first."""
    problem = replace(problem_of(None), simulator=SpoiltLate())
    generators = [np.random.default_rng(seed) for seed in range(4)]
    with pytest.raises(SimulationError) as caught:
        splitting(problem, count=20, generators=generators)
    alone = []
    for run in range(4):
        uniforms = np.random.default_rng(run).random((STATES - 1, 20))
        misses = (uniforms[:8] < 0.1).sum(axis=0)
        alone += [(run, row) for row in np.flatnonzero(misses >= 3).tolist()]
    found = caught.value
    assert (found.ahead, found.rollouts[0]) == alone[0]
    assert found.step == 8


def first_misses(run, count):
    """How many of the first seven outcomes of each of a subset run's first rollouts are misses."""
    normals = np.random.default_rng(run).standard_normal((count, STATES - 1))
    return (stats.norm.cdf(normals[:, :8]) < 0.1).sum(axis=1)


def test_subset_names_run_and_rollout_and_none_where_levels_are_sought():
    problem = replace(problem_of(None), simulator=SpoiltLate(), batch_rollouts=7)
    generators = [np.random.default_rng(seed) for seed in range(4)]
    with pytest.raises(SimulationError) as caught:
        SubsetSimulation().carry_out(problem, count=20, generators=generators)
    alone = [
        (run, row)
        for run in range(4)
        for row in np.flatnonzero(first_misses(run, 20) >= 3).tolist()
    ]
    found = caught.value
    assert (found.ahead, found.rollouts[0], found.step) == (*alone[0], 8)
    with pytest.raises(SimulationError) as caught:
        SubsetSimulation().prepare(problem, count=200, generator=np.random.default_rng(0))
    assert (caught.value.rollouts, caught.value.step) == (None, 8)


def test_a_rollout_of_a_chain_is_counted_on_from_those_before_it():
    """In the third step of the chains of two runs."""
    problem = problem_of(lambda gap: gap)
    prepared, _ = SubsetSimulation().prepare(problem, count=100, generator=np.random.default_rng(1))
    assert prepared.levels
    calls = []

    def fails_late(simulator, pem, tasks):
        for task in tasks:
            calls.append(len(task.uniforms))
            if len(calls) > 3:
                raise SimulationError("wheel", why="off", rollouts=range(2, 3))
            yield by_numpy(simulator, pem, task)

    generators = [np.random.default_rng([5, run]) for run in range(2)]
    with pytest.raises(SimulationError) as caught:
        prepared.carry_out(
            replace(problem, run_batches=fails_late), count=100, generators=generators
        )
    chains = prepared.levels[0].chains(100)
    assert calls[:4] == [200, 2 * chains, 2 * chains, 2 * chains]
    assert (caught.value.ahead, caught.value.rollouts[0]) == (0, 3 * chains + 2)


def test_where_it_was_survives_another_process():
    with pytest.raises(SimulationError) as caught:
        draw(raising(error=Odd("two\nlines")))
    sent = pickle.loads(pickle.dumps(caught.value))  # noqa: S301  just made
    assert str(sent) == str(caught.value)
    assert "two lines" in str(sent)
    assert sent.traceback_text == caught.value.traceback_text != ""


def test_a_message_that_cannot_be_told_does_no_harm():
    class NastyError(Exception):
        def __str__(self):
            raise SystemExit(0)

    with pytest.raises(SimulationError, match="its message cannot be shown"):
        draw(raising(error=NastyError()))


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("turned", [None, SystemExit(1), RuntimeError("interrupted")])
def test_a_signals_interrupt_is_no_fault_of_the_simulator(turned):
    """Nor is what the simulator makes of it."""

    class Interrupted(MissCounter):
        def step(self, states, detected):
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                if turned is None:
                    raise
                raise turned from None
            return super().step(states, detected)

    problem = replace(problem_of(None), simulator=Interrupted(states=STATES))
    before = signal.getsignal(signal.SIGINT)
    expected = KeyboardInterrupt if turned is None else type(turned)
    with signals_distinguished(), pytest.raises(expected) as caught:
        draw(problem)
    assert isinstance(from_outside(caught.value), KeyboardInterrupt)
    assert signal.getsignal(signal.SIGINT) is before
