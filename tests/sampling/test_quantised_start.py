"""A quantised start: all starts gone through, chosen by their values, against closed forms."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

import pemviz
from pemviz.latents import LatentCounts
from pemviz.runs.rollout_files import load_rollouts, log_weights
from pemviz.sampling.problem import sample
from pemviz.sampling.zero_variance.left_out import left_out_share
from pemviz.sampling.zero_variance.reachable_states import SAFE_NODE, explore
from pemviz.sampling.zero_variance.reference import exact_log_probability
from pemviz.sampling.zero_variance.values import solve
from pemviz.simulators.quantised import StartCells, quantised_start, start_cells
from pemviz.types import Signal, StateBatch
from tests.faults.test_resume import stopped_and_whole
from tests.latent_toys import Drift, Flat, RandomWalkStart, TwoDrifts, miss_of_either
from tests.lattice_walk import ToyPem
from tests.sampling.test_tracked import by_chains, tracker_of

ERRS, SELDOM = Flat(0.1), ToyPem(at_zero=8.0)
BEYOND_M = 4.05
AT_END = f"always[16,16] (distance <= {BEYOND_M})"
WALK = "always[0,14] (gap >= 0.5)"
START = Drift(noise_sd_m=0.0, miss_m=0.4)
SLOTS = TwoDrifts(noise_sd_m=0.0, miss_m=0.4)
FLAT = {"car": Flat(0.05), "ghost": Flat(0.95)}


def experiment_of(simulator, spec=AT_END, *, pem=ERRS, cells=16, twin=None, **settings):
    settings = {"method": "zero-variance", "final_rollouts": 1_000, **settings}
    config = pemviz.ExperimentConfig(spec=spec, plan=False, measured_memory=False, **settings)
    if twin is None:
        twin = simulator if start_cells(simulator) else quantised_start(simulator, cells=cells)
    return pemviz.build_experiment(config, simulator=simulator, pem=pem, twin=twin)


def exact(experiment):
    return math.exp(exact_log_probability(experiment.problem, twin=experiment.twin))


def by_cells(miss, *, cells):
    """Of the drift from each cell's median: misses are binomial."""
    edges = np.concatenate([[-np.inf], np.linspace(-4.0, 4.0, cells + 1)[1:-1], [np.inf]])
    steps, misses = START.states - 1, np.arange(START.states)
    total = 0.0
    for low, high in itertools.pairwise(edges):
        share = stats.norm.cdf(high) - stats.norm.cdf(low)
        median = stats.norm.ppf(stats.norm.cdf(low) + 0.5 * share)
        beyond = START.start_sd_m * median + START.miss_m * misses > BEYOND_M
        total += share * stats.binom.pmf(misses, steps, miss)[beyond].sum()
    return total


def test_cells_are_those_of_the_normal_distribution():
    cells = StartCells(5, 2)
    drawn = np.random.default_rng(1).standard_normal((40_000, 2))
    share = np.bincount(cells.index(drawn), minlength=25) / 40_000
    p = np.exp(cells.log_p)
    assert p.sum() == pytest.approx(1.0, rel=1e-14)
    assert (np.abs(share - p) < 5.0 * np.sqrt(p / 40_000) + 1e-4).all()
    np.testing.assert_array_equal(cells.index(cells.medians), np.arange(25))
    outermost = StartCells(8, 1)
    assert outermost.medians[-1, 0] == pytest.approx(stats.norm.isf(0.5 * stats.norm.sf(3.0)))
    assert outermost.log_p[-1] == pytest.approx(stats.norm.logsf(3.0), rel=1e-13)


def test_starts_within_a_cell_have_their_distribution():
    cells, place = StartCells(6, 1), np.random.default_rng(2).random((4_000, 1))
    for cell, low, high in ((0, -np.inf, -8 / 3), (3, 0.0, 4 / 3), (5, 8 / 3, np.inf)):
        found = cells.within(np.full(4_000, cell), place)[:, 0]
        share = stats.norm.cdf(found) - stats.norm.cdf(low)
        share = share / (stats.norm.cdf(high) - stats.norm.cdf(low))
        assert stats.kstest(share, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("cells", [2, 7, 16])
def test_the_recursion_is_exact_for_the_quantised_start(cells):
    assert exact(experiment_of(START, cells=cells)) == pytest.approx(
        by_cells(0.1, cells=cells), rel=1e-11
    )


def test_so_it_is_with_slots():
    """A camera's misses and a ghost's reports add up alike."""
    found = exact(experiment_of(SLOTS, pem=FLAT))
    assert found == pytest.approx(by_cells(miss_of_either(0.05, 0.05), cells=16), rel=1e-11)


def test_a_start_that_is_discrete_by_itself_has_no_other_answer():
    """Cells end where the walk's starts do; starts that are alike are one."""
    walk = RandomWalkStart(median=3.0, largest_gap=7)
    experiment = experiment_of(walk, WALK, pem=SELDOM)
    assert exact(experiment) == pytest.approx(walk.probability(SELDOM), rel=1e-11)
    graph = explore(twin=experiment.twin, pem=SELDOM, unsafe=experiment.problem.unsafe)
    assert graph.layers[0].count < np.unique(graph.start).size + 1 <= 9


def test_behind_a_tracker_it_is_exact_too():
    walk = RandomWalkStart(median=3.0, largest_gap=7, states=11)
    rule, pem = (2, 3, 1), ToyPem(at_zero=3.0)
    tracked = pemviz.tracked(walk, tracker_of(*rule))
    found = exact(experiment_of(tracked, "always[0,10] (gap >= 0.5)", pem=pem))
    start = stats.norm.cdf(np.arange(2, 8) - 1 - walk.median)
    shares = np.diff(np.concatenate([[0.0], start, [1.0]]))
    by_start = [by_chains(rule, start=gap, steps=10, largest=7, pem=pem) for gap in range(1, 8)]
    assert found == pytest.approx(float(shares @ by_start), rel=1e-10)


@pytest.mark.parametrize(
    ("simulator", "pem", "miss"),
    [(START, ERRS, 0.1), (SLOTS, FLAT, miss_of_either(0.05, 0.05))],
    ids=["one outcome", "slots"],
)
def test_the_answer_is_that_of_the_continuous_start(simulator, pem, miss):
    """Also with cells so wide that the twin's own is a third of it.

    Within four standard errors: a false alarm with probability 6e-5 each.
    """
    truth = START.probability(BEYOND_M, miss=miss)
    assert by_cells(miss, cells=8) < 0.5 * truth
    for cells, error in ((8, 0.1), (64, 0.08)):
        found = pemviz.run(experiment_of(simulator, pem=pem, cells=cells, seed=3)).estimate
        assert abs(found.probability - truth) < 4.0 * found.std_error
        assert found.std_error < error * truth


def test_without_a_defensive_share_every_violating_rollout_weighs_the_same():
    experiment = experiment_of(quantised_start(START, cells=16))
    proposal = replace(
        experiment.method.init(experiment.problem, repetition=0).proposal, defensive=1e-12
    )
    problem = replace(experiment.problem, batch_rollouts=30)
    seeds = np.random.SeedSequence(3)
    whole, parts = (
        sample(one, proposal=proposal, count=100, seeds=seeds)
        for one in (experiment.problem, problem)
    )
    np.testing.assert_array_equal(whole.rollouts.log_weight, parts.rollouts.log_weight)
    np.testing.assert_allclose(np.exp(whole.rollouts.log_weight), exact(experiment), rtol=1e-9)


@dataclass(frozen=True, kw_only=True)
class TwoStarts(Drift):
    """Begins at the sum of two latents, violating or not, with names."""

    latents = LatentCounts(start=2)
    starts = tuple(Signal(name=n, key=f"{n}_m", unit="m", low=-9.0, high=9.0) for n in "ab")
    start_plane = ("a", "b")

    def start_values(self, start):
        return {"a": 1.0 * start[:, 0], "b": 1.0 * start[:, 1]}

    def initial(self, *, count, start):
        return StateBatch(np.zeros((), dtype=np.int64), {"distance": start.sum(axis=1)})


def test_starts_that_violate_already_and_such_that_cannot():
    """Two latents of three cells each, misses that change nothing."""
    system = TwoStarts(noise_sd_m=0.0, miss_m=0.0)
    twin = quantised_start(system, cells=3)
    experiment = experiment_of(twin, "always[0,16] (distance <= 2.5)")
    outer = stats.norm.isf(0.5 * stats.norm.sf(4 / 3))
    assert 2.0 * outer > 2.5
    assert exact(experiment) == pytest.approx(stats.norm.sf(4 / 3) ** 2, rel=1e-12)
    result = pemviz.run(experiment)
    assert result.estimate.probability == pytest.approx(stats.norm.sf(4 / 3) ** 2, rel=0.1)
    dangerous = twin.start_values(np.full((1, 2), 5.0))
    assert dangerous["a"] == pytest.approx([outer])
    assert result.starts is not None


def test_what_is_left_out_counts_starts_called_safe():
    """All starts but the last are called safe: what leads to violations from them is told."""
    experiment = experiment_of(quantised_start(START, cells=8))
    problem = experiment.problem
    asked = {"twin": experiment.twin, "pem": problem.pem, "unsafe": problem.unsafe}
    graph = explore(**asked)
    values = solve(graph)
    assert left_out_share(graph, values, **asked) == 0.0
    blind = replace(graph, start=np.where(np.arange(8) < 7, SAFE_NODE, graph.start))
    share = np.exp(graph.log_start + values.log_start_value - values.log_probability)[:7].sum()
    found = left_out_share(blind, solve(blind), **asked, rollouts=40_000)
    assert found == pytest.approx(share, rel=0.05)


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(tmp_path):
    experiment = experiment_of(START, final_rollouts=40, repetitions=2)
    result, whole, _ = stopped_and_whole(experiment, tmp_path, 1)
    assert pemviz.read_result(whole) == result
    rollouts = load_rollouts(whole)
    weights = np.exp(log_weights(rollouts)) * rollouts["violated"]
    assert weights.mean() == pytest.approx(result.estimate.probability, rel=1e-12)


def test_mixture_agrees_on_the_quantised_scenario():
    """And is compared with the recursion; four standard errors: a false alarm in 16,000."""
    spent = {"rollouts": 60, "stages": 5, "final_rollouts": 200}
    twin = quantised_start(START, cells=16)
    result = pemviz.run(experiment_of(twin, method="mixture", seed=2, **spent))
    assert result.reference.probability == pytest.approx(by_cells(0.1, cells=16), rel=1e-9)
    found = result.estimate
    assert abs(found.probability - result.reference.probability) < 4.0 * found.std_error
    alone = pemviz.run(experiment_of(START, twin=twin, method="mixture", seed=2, **spent))
    assert alone.reference is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: quantised_start(Drift(), cells=8), "1 at the start and 1 at every step: must be"),
        (
            lambda: quantised_start(START, cells=1),
            "cells = 1: must be a whole number from 2 to 4096",
        ),
        (lambda: quantised_start(TwoStarts(noise_sd_m=0.0), cells=65), "from 2 to 64"),
        (lambda: experiment_of(START, twin=START), "it has latents.*quantised_start"),
        (lambda: experiment_of(START, frailty=0.5), "takes a quantised start or frailty, not both"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, words):
    with pytest.raises(pemviz.ConfigError, match=words) as told:
        make()
    assert "\n" not in str(told.value)
