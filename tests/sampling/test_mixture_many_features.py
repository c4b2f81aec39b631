"""Proposals that look at many features, where what follows decisive misses no longer matters."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.proposals.defensive import LARGEST_SHARE
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.auto.method import AutoSampling, Limits
from pemviz.sampling.estimates.estimators import ADAPTATION, HARD_ADAPTATION
from pemviz.sampling.mixture.fit import WIDE_SHARE, WIDEST, WIDEST_SHARE
from pemviz.sampling.mixture.method import MixtureSampling
from tests.misses_in_a_row import MissesInARow, probability, problem_of
from tests.toy import ConstantPem, carried_out, stepped_through

MISS = 0.05
LATE = MissesInARow(4, shown=True, later=4, phases=3, states=61)
"""It fails four steps after the fourth miss, whatever is detected until then."""
LONG = replace(LATE, needed=20, later=1)
FEW = replace(LATE, phases=1)


def method(seed=3, **changed):
    return replace(
        MixtureSampling(learning_stages=4, rollouts=60, final_rollouts=60, seed=seed), **changed
    )


def fits_after(system, *, stages=3):
    """What the stage after so many samples from."""
    problem, own = problem_of(system, MISS), method()
    state = own.init(problem, repetition=0)
    for _ in range(stages):
        state, _ = own.step(problem, state)
    return state.fits


def test_half_of_the_rollouts_take_much_from_the_error_model_where_a_failure_takes_few_steps():
    main, wide, *others = fits_after(LATE)
    assert main.defensive is None
    assert 3.0 < main.departure < 7.0
    assert wide.share / (main.share + wide.share) == WIDEST_SHARE
    assert np.array_equal(wide.coefficients, main.coefficients)
    assert {fit.defensive for fit in (wide, *others)} == {WIDEST}
    assert others


def test_a_failure_of_many_steps_leaves_less_to_the_error_model():
    main, wide, *others = fits_after(LONG)
    assert main.departure > 15.0
    assert np.isclose(wide.share / (main.share + wide.share), WIDE_SHARE)
    assert wide.defensive == LARGEST_SHARE
    assert all(fit.defensive is None for fit in others)


def test_intervals_are_wider_where_proposals_are_hard_to_learn():
    assert all(fit.defensive is None for fit in fits_after(FEW))
    factors = []
    for system in (FEW, LONG, LATE):
        state, _ = stepped_through(method(), problem_of(system, MISS))
        factors.append(method().kept_columns(state)["error_factor"].max())
    assert factors == [ADAPTATION, ADAPTATION, HARD_ADAPTATION]


def test_unwarned_intervals_hold_the_truth():
    """20 runs of 300 rollouts each.

    Were 93 % of unwarned intervals to hold the truth, fewer than all but five would in 2e-3. Of
    so few rollouts about 75 % do, so that some seeds miss the bound.
    """
    truth, problem = probability(LATE, MISS), problem_of(LATE, MISS)
    found = [carried_out(method(seed=2), problem, repetition=number)[0] for number in range(20)]
    unwarned = [each for each in found if not each.warnings]
    assert len(unwarned) >= 15
    assert sum(each.ci_low <= truth <= each.ci_high for each in unwarned) >= len(unwarned) - 5


@pytest.mark.slow
def test_unwarned_intervals_of_the_defaults_hold_the_truth():
    """20 runs of ``auto``, which takes about 2,800 rollouts where proposals are hard to learn.

    Were 95 % of unwarned intervals to hold the truth, fewer than all but four would in 3e-3.
    """
    truth = probability(LATE, MISS)
    experiments = [
        build_experiment(
            ExperimentConfig(method="auto", spec="always[0,60] (gap > 0)", seed=seed, plan=False),
            simulator=LATE,
            pem=ConstantPem(MISS),
        )
        for seed in range(20)
    ]
    found = [run(experiment).estimate for experiment in experiments]
    unwarned = [each for each in found if not each.diagnostics]
    assert len(unwarned) >= 18
    assert sum(each.ci_low <= truth <= each.ci_high for each in unwarned) >= len(unwarned) - 4
    assert max(abs(each.probability / truth - 1.0) for each in found) < 0.2


def test_auto_learns_from_more_where_proposals_are_hard_to_learn():
    """However precise the first answer."""
    rollouts = []
    for system in (FEW, LATE):
        own = AutoSampling(
            mixture=method(seed=5),
            first=60,
            most_looked_at=60,
            most_plain=60,
            limits=Limits(precision=5.0, most=4_000),
        )
        state, _ = stepped_through(own, problem_of(system, MISS))
        rollouts.append(state.proposing.method.rollouts)
    assert rollouts[0] == 60
    assert rollouts[1] >= 120
