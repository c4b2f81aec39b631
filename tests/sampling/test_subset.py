"""Subset simulation: moves keep the normal, runs have no bias, and systems without restarts do."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from pemviz.config import ExperimentConfig
from pemviz.faults import StopRequested
from pemviz.latents import LatentCounts
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.subset.moves import Shape, Tuning, moved, spreads
from pemviz.sampling.subset.run import SubsetSimulation
from pemviz.types import StateBatch
from tests.latent_toys import DISTANCE
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion, toy_problem_of
from tests.sampling.test_batches import at_once
from tests.toy import ConstantPem, stepped_through, subset_runs

SHAPE = Shape(outcomes=12, start=3, steps=6, noise=2)


def flat(numbers):
    return np.concatenate([each.reshape(numbers.count, -1) for each in numbers.each], axis=1)


@pytest.mark.parametrize("window", ["small", "start", "anew", "any angle", "reordered"])
def test_moves_keep_the_normal_and_can_be_taken_back(window):
    """(z, z') has the density of (z', z): all moments up to the fourth agree. 5 sigma."""
    generator = np.random.default_rng(3)
    kinds = {"small": [0], "start": [1]} | {
        name: [2 + place * SHAPE.places.size + step for step in range(SHAPE.places.size)]
        for place, name in enumerate(("anew", "any angle", "reordered"))
    }
    numbers = SHAPE.normals(generator, 40_000)
    kind = generator.choice(kinds[window], size=numbers.count)
    after = moved(
        numbers, kind, shape=SHAPE, scale=0.7, spread=spreads(numbers, SHAPE), generator=generator
    )
    one, other = flat(numbers), flat(after)
    assert np.any(one != other)
    for power in (1, 2, 3, 4):
        error = np.sqrt((stats.norm.moment(2 * power)) / numbers.count)
        wrong = (other**power).mean(axis=0) - stats.norm.moment(power)
        assert np.all(np.abs(wrong) < 5.0 * error)
    forth, back = (one**2 * other).mean(axis=0), (other**2 * one).mean(axis=0)
    assert np.all(np.abs(forth - back) < 5.0 * np.sqrt(2.0 * 15.0 / numbers.count))


def test_a_reordered_window_keeps_steps_together():
    generator = np.random.default_rng(4)
    numbers = SHAPE.normals(generator, 500)
    kind = np.full(500, 2 + 2 * SHAPE.places.size)
    after = moved(
        numbers, kind, shape=SHAPE, scale=0.7, spread=spreads(numbers, SHAPE), generator=generator
    )
    steps = [
        np.concatenate([each.outcomes.reshape(500, 6, 2), each.noise], axis=2)
        for each in (numbers, after)
    ]
    before, now = (np.sort(each[..., 0], axis=1) for each in steps)
    np.testing.assert_allclose(before, now, rtol=1e-12)
    for row in range(500):
        known = {tuple(np.round(step, 9)) for step in steps[0][row]}
        assert {tuple(np.round(step, 9)) for step in steps[1][row]} == known


def test_small_moves_leave_seeds_as_they_are_and_others_do_not():
    shape, generator = replace(SHAPE, seeds=1), np.random.default_rng(6)
    numbers = shape.normals(generator, 300)
    small, of_start = (
        moved(
            numbers,
            np.full(300, kind),
            shape=shape,
            scale=0.7,
            spread=spreads(numbers, shape),
            generator=generator,
        ).start
        != numbers.start
        for kind in (0, 1)
    )
    assert small.all(axis=0).tolist() == [True, True, False]
    assert not small[:, 2].any()
    assert np.all(of_start.mean(axis=0) > 0.3)


def test_what_moves_nothing_is_seldom_chosen():
    tuning = Tuning.begun(SHAPE)
    generator = np.random.default_rng(5)
    for _ in range(50):
        kind = tuning.chosen(40, generator)
        gain = np.where(kind == 7, 0.5, 0.0)
        tuning = tuning.learned(kind, gain, gain > 0.0)
    chosen = tuning.chosen(4_000, generator)
    assert np.mean(chosen == 7) > 5.0 / SHAPE.kinds
    assert np.unique(chosen).size == SHAPE.kinds
    assert not np.any(Tuning.begun(replace(SHAPE, start=0)).chosen(4_000, generator) == 1)


@pytest.mark.parametrize("count", [40, 100])
def test_runs_have_no_bias_however_small_they_are(count):
    """500 runs with levels found once; |z| < 4 fails one time in 16,000."""
    simulator, pem = ToySimulator(initial_gap=3, states=12), ToyPem(at_zero=2.5)
    exact = toy_probability_by_recursion(simulator, pem)
    problem = toy_problem_of(simulator, pem)
    prepared, spent = SubsetSimulation().prepare(
        problem, count=200, generator=np.random.default_rng(1)
    )
    assert len(prepared.levels) >= 2
    assert spent > 200
    generators = [np.random.default_rng([7, number]) for number in range(500)]
    runs = prepared.carry_out(problem, count=count, generators=generators)
    found = np.exp([run.log_probability for run in runs])
    error = found.std(ddof=1) / math.sqrt(found.size)
    assert error < 0.2 * exact
    assert abs(found.mean() - exact) < 4.0 * error


def test_how_long_chains_are_depends_on_no_rollout_of_the_run():
    """Each level that is reached costs what was fixed before, however many came below it."""
    problem = toy_problem_of(ToySimulator(initial_gap=4, states=12), ToyPem())
    prepared, _ = SubsetSimulation().prepare(problem, count=100, generator=np.random.default_rng(1))
    generators = [np.random.default_rng([8, number]) for number in range(40)]
    runs = prepared.carry_out(problem, count=100, generators=generators)
    costs = np.cumsum([100, *(100 - level.chains(100) for level in prepared.levels)])
    assert {run.simulated for run in runs} <= set(costs.tolist())
    reached = [run for run in runs if run.log_probability > -math.inf]
    assert {run.simulated for run in reached} == {int(costs[-1])}
    assert len({run.log_probability for run in reached}) > 5


@pytest.mark.parametrize("batch", [1, 7, 64, 10_000])
def test_batches_workers_and_observers_do_not_show(batch):
    simulator, pem = ToySimulator(initial_gap=4, states=12), ToyPem()
    method = subset_runs(stages=4, rollouts=30, seed=2)
    expected, _ = stepped_through(method, toy_problem_of(simulator, pem))
    heard, searched = [], []
    problem = toy_problem_of(
        simulator,
        pem,
        batch_rollouts=batch,
        run_batches=PooledRunner(at_once, 3),
        searched=searched.append,
        progress=lambda done, total: heard.append(done / total),
    )
    found, _ = stepped_through(method, problem)
    assert method.estimate(found) == method.estimate(expected)
    for one, other in zip(found.runs, expected.runs, strict=True):
        assert one.log_probability == other.log_probability
        assert np.array_equal(one.scored.rollouts.detected, other.scored.rollouts.detected)
    assert searched[0] == 30  # of the run that finds the levels
    assert len(searched) > 5
    assert 0.0 < heard[0] < 1.0
    assert heard[-1] == 1.0
    assert len(set(heard)) > 5


def test_a_run_can_be_stopped_between_any_two_batches():
    problem = toy_problem_of(ToySimulator(initial_gap=4, states=12), ToyPem(), batch_rollouts=50)
    pauses = []
    for stops_at in (1, 5, 30):

        def pause(stops_at=stops_at):
            pauses.append(stops_at)
            if pauses.count(stops_at) == stops_at:
                raise StopRequested

        method = subset_runs(stages=5, rollouts=100, seed=2)
        with pytest.raises(StopRequested):
            stepped_through(method, replace(problem, pause=pause))


@dataclass(frozen=True)
class Seeded(ToySimulator):
    """The walk whose steps a generator of its own, seeded by a latent, makes longer at times."""

    latents = LatentCounts(start=1, seeds=1)

    def initial(self, *, count, start):
        begun = super().initial(count=count)
        words = (1e6 * stats.norm.cdf(start[:, 1])).astype(np.int64)
        drawn = np.array([np.random.default_rng(int(word)).random(11) < 0.1 for word in words])
        longer = {f"longer{step}": drawn[:, step] for step in range(11)}
        return replace(begun, memory=longer | {"start": start[:, 0].copy()})

    def step(self, states, detected):
        after = super().step(states, detected)
        at = int(states.step)
        nearer = states.memory[f"longer{at}"] & ~detected
        gap = np.maximum(after.signals["gap"] - nearer, 0.0)
        gap = np.where(states.signals["gap"] == 0.0, 0.0, gap)
        return replace(after, signals={"gap": gap}, memory=states.memory)


def seeded_probability(simulator, pem):
    """By recursion: a miss leads one step nearer, or, a tenth of them, two; 0 is absorbing."""
    gaps = np.arange(simulator.largest_gap + 1)
    missed = stats.logistic.cdf(-pem.logit(gaps[:, None].astype(float)))
    value = (gaps == 0).astype(float)
    for _ in range(simulator.states - 1):
        nearer = 0.9 * value[np.maximum(gaps - 1, 0)] + 0.1 * value[np.maximum(gaps - 2, 0)]
        away = value[np.minimum(gaps + 1, simulator.largest_gap)]
        value = np.where(gaps == 0, 1.0, missed * nearer + (1.0 - missed) * away)
    return value[simulator.initial_gap]


def test_seeds_of_a_simulator_s_own_generator_change_too():
    """|z| < 4 over 200 runs fails one time in 16,000."""
    simulator, pem = Seeded(initial_gap=4, states=12), ToyPem(at_zero=2.5)
    exact = seeded_probability(simulator, pem)
    problem = toy_problem_of(simulator, pem)
    prepared, _ = SubsetSimulation().prepare(problem, count=300, generator=np.random.default_rng(1))
    assert len(prepared.levels) >= 2
    generators = [np.random.default_rng([9, number]) for number in range(200)]
    runs = prepared.carry_out(problem, count=100, generators=generators)
    found = np.exp([run.log_probability for run in runs])
    error = found.std(ddof=1) / math.sqrt(found.size)
    assert error < 0.15 * exact
    assert abs(found.mean() - exact) < 4.0 * error


@dataclass(frozen=True)
class Jump:
    """The distance is 1 m, or far below 0 where a standard normal is above a limit."""

    limit: float
    states: int = 2
    name: str = "jump"
    dt_s: float = 0.1

    @property
    def latents(self):
        return LatentCounts(start=1)

    @property
    def signals(self):
        return (DISTANCE,)

    def initial(self, *, count, start=None):
        normal = np.zeros(count) if start is None else start[:, 0]
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={"distance": np.where(normal > self.limit, -normal, 1.0)},
        )

    def step(self, states, detected, noise=None):
        return StateBatch(step=states.step + 1, signals=dict(states.signals))

    def salient(self, signals):
        return signals["distance"][..., None]


def test_no_level_lies_below_what_violates():
    """A level at those of one or two violations would leave half out, or a third. |z| < 4."""
    jump = Jump(1.7)
    config = ExperimentConfig(method="subset", spec="always[0,1] (distance >= 0)")
    problem = build_experiment(config, simulator=jump, pem=ConstantPem(0.5)).problem
    found: list[float] = []
    for pilot in range(100):
        prepared, _ = SubsetSimulation().prepare(
            problem, count=30, generator=np.random.default_rng(pilot)
        )
        generators = [np.random.default_rng([pilot, number]) for number in range(6)]
        runs = prepared.carry_out(problem, count=30, generators=generators)
        found.append(float(np.mean(np.exp([run.log_probability for run in runs]))))
    error = np.std(found, ddof=1) / math.sqrt(len(found))
    assert error < 0.1 * stats.norm.sf(1.7)
    assert abs(np.mean(found) - stats.norm.sf(1.7)) < 4.0 * error


def test_mirrored_latents_keep_their_size_and_reach_every_side():
    """Of 4,000 rollouts each start has either sign in half, within five standard errors."""
    shape = Shape(outcomes=3, start=3, steps=3, noise=2, seeds=1)
    generator = np.random.default_rng(4)
    numbers = shape.normals(generator, 4000)
    spread = numbers.take(slice(1)).map(np.ones_like)
    kind = np.full(4000, shape.mirrored)
    found = moved(numbers, kind, shape=shape, scale=1.0, spread=spread, generator=generator)
    for before, after in zip(numbers.each, found.each, strict=True):
        np.testing.assert_array_equal(np.abs(after), np.abs(before))
    np.testing.assert_array_equal(found.outcomes, numbers.outcomes)
    np.testing.assert_array_equal(found.start[:, 2], numbers.start[:, 2])
    mirrored = found.start[:, :2] == -numbers.start[:, :2]
    together = np.mean(mirrored.all(axis=1))
    # all in one of two, else each by a coin
    for share, expected in ((mirrored[:, 0].mean(), 0.75), (together, 0.5 + 0.5 * 0.25)):
        assert share == pytest.approx(expected, abs=5.0 * np.sqrt(0.25 / 4000))
    sign = np.sign(found.noise * numbers.noise)
    np.testing.assert_array_equal(sign, np.broadcast_to(sign[:, :1], sign.shape))


def test_without_latents_nothing_is_mirrored():
    shape = Shape(outcomes=4, start=0, steps=4, noise=0)
    kinds = Tuning.begun(shape).chosen(5000, np.random.default_rng(0))
    assert (kinds != shape.mirrored).all()
