"""Rollouts that are not the same again are found, and nothing is decided by them."""

from dataclasses import dataclass, field

import numpy as np
import pytest

import pemviz
from pemviz.config import METHODS
from pemviz.config.settings import Rule
from pemviz.errors import ConfigError
from pemviz.proposals.fixed import ConstantProposal
from pemviz.reports.gate import EXIT_GATE_UNDECIDED, decide_run
from pemviz.runs.uncertainty import run_interval_caveats, run_remedy
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.repeat import MOST, SHARE, repeated, to_repeat
from pemviz.types import StateBatch
from tests.latent_toys import Drift
from tests.lattice_walk import ToyPem, ToySimulator
from tests.slot_toys import TwoCars

SPEC = "always[0,14] (gap > 0)"
QUICK = {"measured_memory": False, "rollouts": 100, "final_rollouts": 400, "stages": 3}
WORDS = "rollouts that were simulated again went otherwise"


@dataclass(frozen=True, kw_only=True)
class Wanders(ToySimulator):
    """At its last step, one gap in so many is 0 by a randomness that nobody declared."""

    one_in: int = 200
    generator: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def step(self, states, detected):
        reached = super().step(states, detected)
        if int(reached.step) < self.states - 1:
            return reached
        lost = self.generator.random(detected.size) < 1.0 / self.one_in
        gap = np.where(lost, 0.0, reached.signals["gap"])
        return StateBatch(step=reached.step, signals={"gap": gap})


@dataclass(frozen=True, kw_only=True)
class Tires(ToyPem):
    """Answers as it should for so many questions, and then another logit."""

    after: int = 60
    asked: list = field(default_factory=list)

    def logit(self, salient):
        self.asked.append(1)
        return super().logit(salient) + (0.5 if len(self.asked) > self.after else 0.0)


def built(simulator=None, pem=None, twin=None, **settings):
    config = pemviz.ExperimentConfig(**{"spec": SPEC, "seed": 3, **QUICK, **settings})
    simulator = ToySimulator() if simulator is None else simulator
    return pemviz.build_experiment(config, simulator=simulator, pem=pem or ToyPem(), twin=twin)


def of_not_repeatable(estimate):
    return [one for one in estimate.diagnostics if one.kind == "not-repeatable"]


@pytest.mark.parametrize(
    ("simulator", "settings"),
    [
        (ToySimulator(), {}),
        (ToySimulator(), {"memory_s": 1.5}),
        (ToySimulator(), {"memory_s": 1.5, "frailty": 0.8}),
        (Drift(miss_m=0.3), {"spec": Drift().spec(2.0)}),
        (TwoCars(), {"spec": "always[0,20] (gap_a > 0 and gap_b > 0)"}),
    ],
)
def test_what_is_decided_by_outcomes_and_latents_is_the_same(simulator, settings):
    problem = built(simulator, **settings).problem
    scored = sample(
        problem,
        proposal=ConstantProposal(detection_probability=0.5),
        count=300,
        seeds=np.random.SeedSequence(1),
    )
    some = to_repeat(problem, scored)
    found = repeated(problem, [some, some.take(slice(0, 0)), some])
    assert (found.count, found.differing, found.example) == (12, 0, "")


def test_a_share_of_a_stage_and_never_more_than_so_many():
    problem = built(ToySimulator()).problem
    for count, most in ((1, 1), (60, 2), (10_000, MOST)):
        scored = sample(
            problem,
            proposal=ConstantProposal(detection_probability=0.5),
            count=count,
            seeds=np.random.SeedSequence(1),
        )
        some = to_repeat(problem, scored)
        assert 1 <= repeated(problem, [some]).count <= most
    assert SHARE * 10_000 > MOST


@pytest.mark.parametrize("method", sorted(set(METHODS.shipped) - {"zero-variance"}))
def test_randomness_that_nobody_declared_decides_nothing(method):
    """The trial before the run, of four rollouts, does not meet it."""
    result = pemviz.run(built(Wanders(), method=method))
    (found,) = of_not_repeatable(result.estimate)
    assert "simulator toy: gap" in found.text
    assert WORDS in run_interval_caveats(result)[0]
    assert "declare as latents what is random" in run_remedy(result)
    assert decide_run(result, limit=0.9999).exit_code == EXIT_GATE_UNDECIDED


def test_an_error_model_that_answers_otherwise_later_decides_nothing():
    result = pemviz.run(built(pem=Tires(), method="mixture"))
    (found,) = of_not_repeatable(result.estimate)
    assert "error model Tires: logit" in found.text


def test_counts_of_several_repetitions_and_each_rule_are_told_it_too():
    rules = (Rule("near", "always[0,14] (gap > 0)"), Rule("far", "always[0,14] (gap > 2)"))
    settings = {"method": "monte-carlo", "final_rollouts": 2_000, "repetitions": 2}
    spec = " and ".join(f"({rule.formula})" for rule in rules)
    result = pemviz.run(built(Wanders(), rules=rules, spec=spec, **settings))
    assert "in 2 of 2 repetitions" in of_not_repeatable(result.estimate)[0].text
    assert all(of_not_repeatable(rule.estimate) for rule in result.rules)


@pytest.mark.parametrize(
    ("twin", "other"), [(ToySimulator(), ""), (ToySimulator(initial_gap=6), "is another system")]
)
def test_nothing_is_told_by_a_twin_that_is_another_system(twin, other):
    settings = {"method": "mixture", "measured_memory": True}
    result = pemviz.run(built(twin=twin, **settings))
    assert of_not_repeatable(result.estimate) == []
    assert len(result.memory.measured) == (0 if other else 2)
    assert other in result.memory.unmeasured
    assert any("fast twin is another" in warning for warning in result.warnings) == bool(other)
    assert (result.reference is None) == bool(other)


@dataclass(frozen=True)
class Odd:
    """An error model that is none: random, or one that looks at the rows beside."""

    how: str
    generator: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def logit(self, salient):
        own = 3.0 - 0.2 * salient[..., 0]
        if self.how == "random":
            return own + 0.1 * self.generator.standard_normal(own.shape)
        return own - own.mean()


@pytest.mark.parametrize("how", ["random", "beside"])
def test_a_model_that_answers_otherwise_when_asked_again_is_refused(how):
    with pytest.raises(ConfigError, match=r"pem = 'Odd' .* when it is asked again: must depend"):
        built(pem=Odd(how))
