"""Rollouts that are not the same again are found, and nothing is decided by them."""

import time
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

import pemviz
from pemviz.config import METHODS
from pemviz.config.settings import Rule
from pemviz.errors import ConfigError
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.reports.gate import EXIT_GATE_UNDECIDED, decide_run
from pemviz.runs.uncertainty import run_interval_caveats, run_remedy
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.repeat import MOST, SHARE, RepeatedAhead, repeated, to_repeat
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


def some_of(problem, scored, *, stage=0):
    return to_repeat(problem, SimpleNamespace(stage=stage, scored=scored, sampled=None))


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
    some = some_of(problem, scored)
    none = some_of(problem, scored.take(slice(0, 0)))
    found = repeated(problem, [some, none, some])
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
        some = some_of(problem, scored)
        assert 1 <= repeated(problem, [some]).count <= most
    assert SHARE * 10_000 > MOST


@dataclass(frozen=True, kw_only=True)
class Slow(ToySimulator):
    """Takes 6 ms a rollout."""

    def step(self, states, detected):
        if int(states.step) == 0:
            time.sleep(0.006 * detected.size)
        return super().step(states, detected)


@dataclass
class Handed:
    """A pool that does at once what it is handed in, and counts; ``loses`` so many repeats."""

    loses: int = 0
    rollouts: int = 0

    def submit(self, function, simulator, pem, task):
        future = Future()
        self.rollouts += len(task.uniforms)
        if self.loses and not isinstance(task.proposal, PemProposal):
            self.loses -= 1
            future.set_exception(BrokenExecutor("a worker died"))
        else:
            future.set_result(function(simulator, pem, task))
        return future


def of_a_stage(pool, *, proposal=None, simulator=None, lost="end"):
    """240 rollouts in batches of 40, what is under way when they are done, and their problem."""
    problem = built(simulator or Slow(), lost=lost).problem
    runner = PooledRunner(pool.submit, 4, loses=lost != "end")
    problem = replace(problem, batch_rollouts=40, run_batches=runner)
    ahead = RepeatedAhead(problem)
    scored = sample(
        replace(problem, seen=ahead.saw),
        proposal=proposal or PemProposal(),
        count=240,
        seeds=np.random.SeedSequence(1),
    )
    return problem, ahead, scored


def begun(ahead):
    return sum(len(each) for each in ahead.under_way.values())


@pytest.mark.parametrize("proposal", [PemProposal(), ConstantProposal(detection_probability=0.4)])
def test_what_is_repeated_while_a_stage_is_under_way_is_what_is_repeated_of_it(proposal):
    pool = Handed()
    problem, ahead, scored = of_a_stage(pool, proposal=proposal)
    some, early = some_of(problem, scored), begun(ahead)
    assert some.scored.rollouts.count == 5
    assert 2 <= early <= 4  # two that lie evenly, and violations, where all weigh alike
    assert pool.rollouts == 240 + early
    assert repeated(problem, [some], ahead=ahead) == repeated(replace(problem), [some])
    assert begun(ahead) == 0  # none was in vain


ALL_DETECTED = ConstantProposal(detection_probability=1.0 - 1e-12)


def test_rollouts_that_are_alike_are_each_repeated():
    pool = Handed()
    problem, ahead, scored = of_a_stage(pool, proposal=ALL_DETECTED)
    some = some_of(problem, scored)
    assert len(np.unique(some.scored.rollouts.detected, axis=0)) == 1
    assert begun(ahead) == 2
    assert repeated(problem, [some], ahead=ahead).count == some.scored.rollouts.count
    assert pool.rollouts == 240 + some.scored.rollouts.count


def test_nothing_is_repeated_early_where_no_worker_would_be_idle():
    pool = Handed()
    _, ahead, _ = of_a_stage(pool, simulator=ToySimulator())
    assert (begun(ahead), pool.rollouts) == (0, 240)


@pytest.mark.parametrize("lost", ["end", "violation"])
def test_what_is_lost_of_it_is_simulated_again(lost):
    problem, ahead, scored = of_a_stage(Handed(loses=2), lost=lost)
    some = some_of(problem, scored)
    told = []
    watched = replace(problem, progress=lambda done, total: told.append((done, total)))
    assert repeated(watched, [some], ahead=ahead).count == some.scored.rollouts.count
    assert told == [(done, 5) for done in (1, 2, 3, 5)]  # the two that were lost, side by side


def test_what_differs_is_found_early_too():
    problem, ahead, scored = of_a_stage(Handed())
    some = some_of(problem, scored, stage=3)
    signals = {"gap": some.scored.rollouts.signals["gap"] + 1.0}
    rollouts = replace(some.scored.rollouts, signals=signals)
    other = replace(some, scored=replace(some.scored, rollouts=rollouts))
    found = repeated(problem, [other], ahead=ahead)
    assert found.differing == some.number.size
    assert found.example.endswith(f"at step 0 of rollout {some.number[0]} of stage 3")


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
