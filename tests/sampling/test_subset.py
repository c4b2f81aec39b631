"""Subset simulation: moves keep the normal, runs have no bias, and systems without restarts do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pemviz.sampling.subset.moves import Shape, Tuning, moved, spreads
from pemviz.sampling.subset.run import SubsetSimulation
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion, toy_problem_of

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
        numbers, kind, shape=SHAPE, scale=0.7, spread=spreads(numbers), generator=generator
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
        numbers, kind, shape=SHAPE, scale=0.7, spread=spreads(numbers), generator=generator
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


@pytest.mark.parametrize("count", [50, 200])
def test_runs_have_no_bias_however_small_they_are(count):
    """400 runs with levels found once; |z| < 4 fails one time in 16,000."""
    simulator, pem = ToySimulator(initial_gap=4, states=12), ToyPem()
    exact = toy_probability_by_recursion(simulator, pem)
    problem = toy_problem_of(simulator, pem)
    prepared, spent = SubsetSimulation().prepare(
        problem, count=200, generator=np.random.default_rng(1)
    )
    assert len(prepared.levels) >= 1
    assert spent > 200
    generators = [np.random.default_rng([7, number]) for number in range(400)]
    runs = prepared.carry_out(problem, count=count, generators=generators)
    found = np.exp([run.log_probability for run in runs])
    error = found.std(ddof=1) / math.sqrt(found.size)
    assert error < 0.3 * exact
    assert abs(found.mean() - exact) < 4.0 * error
