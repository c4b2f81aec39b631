"""Several rules in the mixture: until when a rollout counts, and what it is drawn from."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.proposals.defensive import share_for
from pemviz.proposals.offset_logistic import OffsetLogisticProposal
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.mixture.balance_heuristic import PLAIN
from pemviz.sampling.mixture.stages import several_rules
from pemviz.simulators.check import check_simulator
from pemviz.types import outcome_log_likelihood
from tests.lattice_walk import ToyPem, ToySimulator
from tests.toy import stepped_through

STATES = 13
WALK, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=STATES), ToyPem(at_zero=1.6)
FIRST_BROKEN = {
    "touch": lambda gap: gap <= 0,
    "deep": lambda gap: gap <= -3,
    "late": lambda gap: (gap < 4) & (np.arange(gap.shape[1]) == STATES - 1),
}
"""Rules by the states that break them."""
RULES = {
    "touch": f"always[0,{STATES - 1}] (gap >= 0.5)",
    "deep": f"always[0,{STATES - 1}] (gap >= -2.5)",
    "late": f"always[{STATES - 1},{STATES - 1}] (gap >= 3.5)",
}


@pytest.fixture(scope="module")
def drawn():
    """A run's last state and its last rollouts."""
    config = ExperimentConfig(
        method="mixture", stages=4, rollouts=100, final_rollouts=150, seed=5
    ).with_rules(RULES)
    experiment = build_experiment(config, simulator=WALK, pem=PEM, twin=WALK)
    method = experiment.method
    state, results = stepped_through(method, experiment.problem)
    return method, state, results[-1].scored.rollouts


def steps_until(gap, rule):
    """How many outcomes of each rollout count under a rule, ``[N]``; ``None``: the first broken."""
    if rule is None:
        return np.min([steps_until(gap, each) for each in FIRST_BROKEN], axis=0)
    broken = FIRST_BROKEN[rule](gap)
    return np.where(broken.any(axis=1), broken.argmax(axis=1), gap.shape[1] - 1)


def log_ratio_of(state, rollouts, moves, rule):
    """Log q / p of each rollout, naively: outcome by outcome until either rule is broken."""
    proposal = OffsetLogisticProposal(
        features=state.features,
        basis=state.basis,
        coefficients=moves.coefficients,
        violated="nothing",
        defensive=moves.defensive or share_for(drawn_steps=2.0, steps=STATES - 1),
        by_step=moves.by_step,
    )
    logit = proposal.logit(rollouts.decision_states(), rollouts.pem_logit)
    each = outcome_log_likelihood(logit, rollouts.detected) - rollouts.log_p
    gap = rollouts.signals["gap"]
    until = np.minimum(steps_until(gap, rule), steps_until(gap, moves.rule))
    return np.where(np.arange(STATES - 1) < until[:, None], each, 0.0).sum(axis=1)


@pytest.mark.parametrize("rule", [None, *RULES])
def test_a_rollout_counts_until_the_rule_is_broken(drawn, rule):
    _, state, rollouts = drawn
    pool = state.pool if rule is None else state.pool.under_rule(rule)
    plain, *fitted = pool.proposals
    assert not plain.coefficients.any()
    assert not pool.log_ratio[-rollouts.count :, PLAIN].any()
    found = pool.log_ratio[-rollouts.count :, PLAIN + 1 :]
    assert {moves.rule for moves in fitted} == set(RULES)
    for place, moves in enumerate(fitted):
        expected = log_ratio_of(state, rollouts, moves, rule)
        np.testing.assert_allclose(found[:, place], expected, atol=1e-9)


def test_a_proposal_leaves_the_error_model_until_its_rule_is_broken(drawn):
    """What was recorded while drawing, against the states of the rollouts drawn."""
    _, state, rollouts = drawn
    component = state.pool.component[-rollouts.count :]
    steps, gap = np.arange(STATES - 1), rollouts.signals["gap"]
    after = 0
    for place in np.unique(component[component > PLAIN]):
        rows = np.flatnonzero(component == place)
        moves = state.pool.proposals[place - 1]
        until = steps_until(gap[rows], moves.rule)
        broken = steps >= until[:, None]
        moved = rollouts.proposal_logit[rows] != rollouts.pem_logit[rows]
        assert not moved[broken].any()
        # a proposal that looks at the step alone leaves the model at some
        leaves = np.ones(STATES - 1, dtype=bool) if moves.by_step is None else moves.by_step != 0.0
        assert not moved[:, ~leaves].any()
        assert moved[~broken & leaves].mean() > 0.9
        after += int(broken.sum())
    assert after > 100


def test_weights_under_a_rule_average_to_one(drawn):
    """Of all rollouts, in the mean over the last batch alone: a law of any likelihood ratio."""
    _, state, rollouts = drawn
    component = state.pool.component[-rollouts.count :]
    for rule in RULES:
        ratio = state.pool.under_rule(rule).log_ratio[-rollouts.count :]
        shares = np.bincount(component, minlength=ratio.shape[1]) / component.size
        live = shares > 0.0
        weight = np.exp(-logsumexp(ratio[:, live] + np.log(shares[live]), axis=1))
        error = weight.std() / np.sqrt(weight.size)
        assert abs(weight.mean() - 1.0) < 4.5 * error  # false alarm 7e-6 each
        assert error < 0.4


def test_rules_that_the_same_rollouts_break_are_learned_once(drawn):
    """And a rule that nothing breaks is no such rule."""
    _, state, _ = drawn
    pool = state.pool
    twice = replace(
        pool,
        broken={**pool.broken, "again": pool.broken["touch"]},
        rule_robustness={**pool.rule_robustness, "again": pool.robustness},
    )
    assert [one.rule for one in twice.each_target()] == list(RULES)
    never = np.zeros(pool.count, dtype=np.bool_)
    unbroken = replace(twice, broken={**pool.broken, "again": never, "more": never, "touch": never})
    unbroken = replace(unbroken, rule_robustness={**twice.rule_robustness, "more": pool.robustness})
    assert [one.rule for one in unbroken.each_target()] == [*RULES, "again", "more"]


def test_one_rule_is_not_several():
    config = ExperimentConfig(method="mixture").with_rules({"touch": RULES["touch"]})
    one = build_experiment(config, simulator=WALK, pem=PEM, twin=WALK)
    assert several_rules(one.problem) == ()


def test_a_scenario_of_one_s_own_may_not_use_the_names():
    class Named(ToySimulator):
        def initial(self, *, count):
            states = super().initial(count=count)
            return replace(states, memory={"violated touch": np.zeros(count)})

    with pytest.raises(ConfigError, match="'violated touch' is pemviz's own"):
        check_simulator(Named(initial_gap=4, states=STATES))
