"""Method auto: plain rollouts where they pay, proposals where they do not, one answer checked."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
from scipy import stats

from benchmarks.trust_systems import MissesInSets, windows
from pemviz.cli.parsing import parse_arguments
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.reports.safety_case import _sampling_step
from pemviz.reports.terminal import summary_text
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.auto import method
from pemviz.sampling.estimates.diagnostics import plain_disagreement
from pemviz.sampling.mixture import explored, fit
from pemviz.sampling.mixture.rejuvenated import SHARE
from pemviz.sampling.problem import FinishedStage
from tests.latent_toys import Drift
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion
from tests.toy import (
    ConstantPem,
    MissCounter,
    exact_failure_probability,
    simulated_in,
    stepped_through,
)

RARE = ToySimulator(initial_gap=5, states=20), ToyPem(at_zero=2.5)
SELDOM = ToySimulator(initial_gap=4, states=12), ToyPem(at_zero=2.0)
OFTEN = ToySimulator(initial_gap=2, states=12), ToyPem(at_zero=1.0)


def experiment(simulator, pem, **settings):
    spec = f"always[0,{simulator.states - 1}] (gap >= 0.5)"
    config = ExperimentConfig(method="auto", spec=spec, **settings)
    return build_experiment(config, simulator=simulator, pem=pem)


def answers(simulator, pem, *, seeds, **settings):
    return [run(experiment(simulator, pem, seed=seed, **settings)) for seed in range(seeds)]


@pytest.mark.parametrize("precision", [0.1, 0.3])
def test_frequent_violations_are_counted_as_precisely_as_was_asked(precision):
    """Of 20 exact 95 % intervals fewer than 16 hold in three of a thousand studies."""
    exact = toy_probability_by_recursion(*OFTEN)
    assert exact > 0.02
    results = answers(*OFTEN, seeds=20, precision=precision)
    held = 0
    for result in results:
        found = result.estimate
        assert found.method == "monte-carlo"
        assert {stage.kind for stage in result.stages} <= {"pretrain", "final"}
        assert found.ci_high - found.ci_low < 2.6 * precision * found.probability
        held += found.ci_low <= exact <= found.ci_high
    assert held >= 16


def test_rare_violations_are_left_to_proposals():
    exact = toy_probability_by_recursion(*RARE)
    assert exact < 1e-4
    for result in answers(*RARE, seeds=4):
        found = result.estimate
        assert found.method == "mixture"
        assert result.stages[0].kind == "pretrain"
        sampled = sum(stage.rollouts for stage in result.stages)
        assert sampled < found.rollouts_simulated <= (1.0 + SHARE) * sampled
        assert found.probability == pytest.approx(exact, rel=0.5)


def test_what_is_not_precise_goes_on_and_stops_at_the_most():
    few = experiment(*RARE, seed=1, precision=0.02, max_rollouts=6_000)
    found = run(few).estimate
    sampled = found.rollouts_in_estimate
    assert sampled <= 6_000 + few.method.first
    assert found.rollouts_simulated <= sampled + SHARE * 6_000
    assert found.rollouts_simulated > 3_000
    coarse = run(experiment(*RARE, seed=1, precision=0.5)).estimate
    assert coarse.rollouts_simulated < found.rollouts_simulated / 2
    assert found.std_error < coarse.std_error


@pytest.mark.parametrize("system", [RARE, OFTEN])
@pytest.mark.parametrize("stops", [1, 2, 5])
def test_a_repetition_goes_on_to_the_last_bit_from_what_is_left(system, stops):
    whole = experiment(*system, seed=3, precision=0.1)
    state, results = stepped_through(whole.method, whole.problem)
    left = {
        result.stage: FinishedStage(result.scored, result.kept, result.sampled)
        for result in results[:stops]
    }
    problem = replace(whole.problem, finished=lambda _, stage: left.get(stage))
    again, _ = stepped_through(whole.method, problem)
    assert whole.method.estimate(again) == whole.method.estimate(state)


def test_what_only_the_last_stage_shows_is_learned_from_and_resumed_to_the_last_bit(monkeypatch):
    """Of two windows of time one has a weight that stands out in the last stage alone.

    So it is with polynomials of the state alone, which are slow to learn of it. That it is within
    20 % of the truth is 3 of the errors that it states.
    """
    monkeypatch.setattr(fit, "LEAST_GAIN", math.inf)
    monkeypatch.setattr(explored, "MOST_MODES", 0)
    system = windows(0, 100)
    config = ExperimentConfig(method="auto", spec=system.spec, seed=17, max_rollouts=9_000)
    whole = build_experiment(config, simulator=system, pem=MissesInSets(system=system))
    state, results = stepped_through(whole.method, whole.problem)
    sizes = {stage.stage: stage.scored.rollouts.count for stage in results if stage.kind == "learn"}
    late = max(sizes, key=lambda stage: sizes[stage])
    assert sizes[late] > 8 * config.rollouts
    assert late < max(sizes)
    assert [stage.kind for stage in results].count("final") == 1
    assert sum(stage.scored.rollouts.count for stage in results[2:]) <= config.max_rollouts
    found = whole.method.estimate(state)
    assert not found.diagnostics
    assert found.probability == pytest.approx(system.probability(miss=0.05), rel=0.2)
    for stops in (late, late + 1, len(results) - 1):
        left = {
            result.stage: FinishedStage(result.scored, result.kept, result.sampled)
            for result in results[:stops]
        }
        problem = replace(whole.problem, finished=lambda _, stage, left=left: left.get(stage))
        again, _ = stepped_through(whole.method, problem)
        assert whole.method.estimate(again) == found


@dataclass(frozen=True, kw_only=True)
class Slow(ToySimulator):
    """Each rollout takes so long by a clock that stands in for the machine's."""

    clock: SimpleNamespace
    rollout_s: float = 0.1

    def initial(self, *, count):
        self.clock.now_s += count * self.rollout_s
        return super().initial(count=count)


def slow(system, monkeypatch, **settings):
    """An experiment with a slow simulator, and its clock."""
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(method, "time", SimpleNamespace(perf_counter=lambda: clock.now_s))
    walk, pem = system
    simulator = Slow(clock=clock, initial_gap=walk.initial_gap, states=walk.states)
    whole = experiment(simulator, pem, **({"seed": 3, "chains": 0} | settings))
    clock.now_s = 0.0  # it was tried
    return whole, clock


def restoring(whole, results):
    """Its problem with what another process left."""
    left = {
        result.stage: FinishedStage(result.scored, result.kept, result.sampled)
        for result in results
    }
    return replace(whole.problem, finished=lambda _, stage: left.get(stage))


@pytest.mark.parametrize("minutes", [0.2, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("system", [RARE, OFTEN])
def test_minutes_end_it_with_an_answer_and_a_run_that_goes_on_decides_as_it_would_have(
    system, minutes, monkeypatch
):
    """Rollouts of a tenth of a second: the first stage alone takes 24."""
    whole, clock = slow(system, monkeypatch, precision=0.02, max_minutes=minutes)
    state, results = stepped_through(whole.method, whole.problem)
    assert 0.6 * 60.0 * minutes < clock.now_s < 1.1 * 60.0 * minutes
    found, exact = whole.method.estimate(state), toy_probability_by_recursion(*system)
    if found.method == "mixture":
        assert found.probability == pytest.approx(exact, rel=0.6)
    else:
        assert found.ci_low <= exact <= found.ci_high
    assert (found.method == "mixture") == (minutes >= 1.0)

    again, _ = stepped_through(whole.method, restoring(whole, results))
    assert whole.method.estimate(again) == found
    cut = found.method == "monte-carlo"
    once, _ = stepped_through(whole.method, restoring(whole, results[: -1 - cut]))
    if not cut:  # when a count was cut off, the clock alone knows
        assert whole.method.estimate(once) == found


@pytest.mark.parametrize("system", [RARE, OFTEN])
@pytest.mark.parametrize(
    ("begun", "wanted"),
    [
        ({"max_minutes": 0.3}, {"max_minutes": 20.0}),
        ({"max_minutes": 1.0}, {"max_minutes": 20.0}),
        ({"max_rollouts": 1_200}, {"max_rollouts": 20_000}),
        ({"max_rollouts": 1_200}, {"max_rollouts": 20_000, "max_minutes": 20.0}),
        ({"precision": 0.5}, {"precision": 0.1}),
    ],
)
def test_a_run_goes_on_with_other_limits_from_where_the_old_ones_ended_it(
    system, begun, wanted, monkeypatch
):
    """Nothing that was simulated is lost; stopped again at any stage it gives the same."""
    asked = {"precision": 0.1} | begun
    first, clock = slow(system, monkeypatch, **asked)
    _, results = stepped_through(first.method, first.problem)
    took_s = clock.now_s
    second, clock = slow(system, monkeypatch, **(asked | wanted))
    state, longer = stepped_through(second.method, restoring(second, results))
    found, exact = second.method.estimate(state), toy_probability_by_recursion(*system)
    assert found.probability == pytest.approx(exact, rel=0.3)
    assert found.relative_half_width < 1.3 * 0.1
    assert [each.stage for each in longer] == list(range(len(longer)))
    for before, after in zip(results, longer, strict=False):
        assert before.scored.rollouts is after.scored.rollouts
    # of what was moved before, what came of it is simulated again, not each move
    again = sum(len(each.kept.get("moved.outcomes", ())) for each in results)
    assert clock.now_s == pytest.approx(0.1 * (again + simulated_in(longer[len(results) :])))
    assert found.rollouts_simulated == simulated_in(longer)
    assert took_s + clock.now_s < 60.0 * 20.0
    for stops in range(len(results), len(longer)):
        again, _ = stepped_through(second.method, restoring(second, longer[:stops]))
        assert second.method.estimate(again) == found


@dataclass(frozen=True, kw_only=True)
class CountedDrift(Drift):
    """Tells how many rollouts were begun."""

    begun: list[int]

    def initial(self, *, count, start=None):
        self.begun.append(count)
        return super().initial(count=count, start=start)


@pytest.mark.parametrize("most", [1_200, 2_500, 6_000, 12_000])
@pytest.mark.parametrize(("limit_m", "needs"), [(1.0, 0), (2.5, 2_500), (5.5, 10_000)])
def test_a_limit_is_one_of_all_that_is_simulated(limit_m, needs, most):
    """Plain rollouts, chains, what is moved, and what proposals sample.

    Chains need so many, the rarer a violation is.
    """
    drift = CountedDrift(states=9, miss_m=0.3, begun=[])
    config = ExperimentConfig(
        method="auto", spec=drift.spec(limit_m), precision=0.01, max_rollouts=most
    )
    whole = build_experiment(config, simulator=drift, pem=ConstantPem(0.1))
    drift.begun.clear()
    state, _ = stepped_through(whole.method, whole.problem)
    found = whole.method.estimate(state)
    assert found.rollouts_simulated == sum(drift.begun) <= most
    assert found.rollouts_simulated > 0.95 * most  # the wanted precision is out of reach
    missed = any(one.kind == "not-searched" for one in found.diagnostics)
    assert missed == (found.method == "mixture" and most < needs)


def test_chains_that_are_few_a_level_search_where_rollouts_are_left():
    drift = Drift(states=9, miss_m=0.3)
    config = ExperimentConfig(method="auto", spec=drift.spec(2.5), chains=50, max_rollouts=20_000)
    found = run(build_experiment(config, simulator=drift, pem=ConstantPem(0.1))).estimate
    assert not found.diagnostics


def test_what_a_search_simulates_is_told_while_it_searches():
    """With stages' rollouts it is all that was simulated."""
    drift = Drift(states=9, miss_m=0.3)
    config = ExperimentConfig(method="auto", spec=drift.spec(2.5), max_rollouts=20_000)
    whole, searched = build_experiment(config, simulator=drift, pem=ConstantPem(0.1)), list[int]()
    state, results = stepped_through(whole.method, replace(whole.problem, searched=searched.append))
    found = whole.method.estimate(state)
    assert len(searched) > 5
    assert max(searched) < 0.5 * sum(searched)
    assert sum(searched) + sum(stage.count for stage in results) == found.rollouts_simulated


def test_a_limit_that_nothing_violates_within_is_spent_and_named():
    result = run(experiment(ToySimulator(initial_gap=30, states=9), RARE[1], max_rollouts=3_000))
    assert result.estimate.failures == 0
    assert result.estimate.rollouts_simulated == 3_000
    assert "and stopped by max_rollouts 3000" in summary_text(result)


@pytest.mark.parametrize("limit_m", [2.5, 60.0])
def test_what_chains_have_found_is_not_searched_for_again(limit_m):
    """A run that goes on simulates the violations that were found alone, or none."""
    drift = CountedDrift(states=9, miss_m=0.3, begun=[])
    config = ExperimentConfig(
        method="auto", spec=drift.spec(limit_m), precision=0.3, rollouts=20, final_rollouts=20
    )
    whole = build_experiment(config, simulator=drift, pem=ConstantPem(0.1))
    state, results = stepped_through(whole.method, whole.problem)
    stops = next(n for n, result in enumerate(results) if "explored.simulated" in result.kept) + 1
    kept, after = results[stops - 1].kept, results[stops:]
    drift.begun.clear()
    again, _ = stepped_through(whole.method, restoring(whole, results[:stops]))
    assert whole.method.estimate(again) == whole.method.estimate(state)
    found, moved = (len(kept.get(f"{name}.outcomes", ())) for name in ("explored", "moved"))
    assert sum(drift.begun) == simulated_in(after) + found + moved
    assert (found > 0) == (limit_m < 10.0)
    assert found < 0.2 * kept["explored.simulated"]


@pytest.mark.parametrize(("repetitions", "most"), [(1, 1_700), (4, 1_200)])
@pytest.mark.parametrize("system", [RARE, OFTEN])
def test_a_limit_is_one_of_all_repetitions(system, repetitions, most):
    small = {"stages": 3, "rollouts": 40, "final_rollouts": 40, "repetitions": repetitions}
    found = run(experiment(*system, precision=0.001, max_rollouts=most, **small)).estimate
    assert 0.95 * most < found.rollouts_simulated <= most


@pytest.mark.parametrize(
    ("begun", "wanted"),
    [
        ({"max_rollouts": 1_200}, {"max_rollouts": 2_000}),
        ({"max_rollouts": 1_200}, {"max_rollouts": 20_000}),
        ({"max_minutes": 3.0}, {"max_rollouts": 20_000}),
        ({}, {"max_rollouts": 2_000}),
        ({}, {"max_rollouts": 20_000}),
    ],
)
def test_plain_rollouts_are_looked_at_as_the_limits_of_their_time_had_it(
    begun, wanted, monkeypatch
):
    """Few of the first violate: whether more plain ones follow is a matter of the limits."""
    exact = toy_probability_by_recursion(*SELDOM)
    for seed in range(4):
        first, _ = slow(SELDOM, monkeypatch, precision=0.05, seed=seed, **begun)
        _, results = stepped_through(first.method, first.problem)
        second, _ = slow(SELDOM, monkeypatch, precision=0.05, seed=seed, **wanted)
        for stops in (len(results) // 2, len(results)):
            state, longer = stepped_through(second.method, restoring(second, results[:stops]))
            found = second.method.estimate(state)
            assert found.method == "mixture"
            assert found.probability == pytest.approx(exact, rel=0.25)
            sizes = [result.count for result in results[:stops]]
            assert [result.count for result in longer][:stops] == sizes
    assert {result.kind for result in longer[:2]} == {"pretrain"}


def test_a_count_that_proposals_follow_in_a_run_that_goes_on_is_no_last_stage():
    """Two stages were its answer; both are what comes before."""
    first = experiment(*OFTEN, seed=3, precision=0.05, max_rollouts=1_200)
    state, results = stepped_through(first.method, first.problem)
    assert first.method.estimate(state).method == "monte-carlo"
    assert [result.kind for result in results] == ["final", "final"]
    second = experiment(*OFTEN, seed=3, precision=0.05, max_rollouts=20_000)
    dear = replace(second.method, most_plain=1_000)
    state, longer = stepped_through(dear, restoring(second, results))
    assert dear.estimate(state).method == "mixture"
    kinds = [result.kind for result in longer]
    assert kinds[:3] == ["pretrain"] * 3
    assert kinds[3:] == ["learn"] * (len(kinds) - 4) + ["final"]


def test_a_count_after_which_more_is_looked_at_is_no_last_stage():
    """The limit left nothing to learn from; with a higher one, too few violate yet."""
    small = {"stages": 1, "rollouts": 50, "final_rollouts": 2, "precision": 0.05, "seed": 632}
    system = ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.0)
    first = experiment(*system, max_rollouts=102, **small)
    _, results = stepped_through(first.method, first.problem)
    assert [(result.kind, result.count) for result in results] == [("final", 20), ("final", 82)]
    second = experiment(*system, max_rollouts=1_020, **small)
    whole, longer = stepped_through(second.method, restoring(second, results))
    kinds = [result.kind for result in longer]
    assert kinds[-2:] == ["learn", "final"]
    assert "final" not in kinds[:-1]
    for stops in range(2, len(longer)):
        again, same = stepped_through(second.method, restoring(second, longer[:stops]))
        assert second.method.estimate(again) == second.method.estimate(whole)
        assert [result.kind for result in same] == kinds


def test_what_is_frequent_is_counted_up_to_a_limit_of_all():
    result = run(experiment(*OFTEN, seed=1, precision=0.03, max_rollouts=1_200))
    assert result.estimate.method == "monte-carlo"
    assert 0.03 < result.estimate.relative_half_width < 0.2
    assert result.estimate.rollouts_simulated == 1_200
    assert "3 % were requested, and stopped by max_rollouts 1200" in summary_text(result)


def test_time_that_is_over_before_anything_violates_leaves_the_counts_upper_bound(monkeypatch):
    slowly, clock = slow(RARE, monkeypatch, max_minutes=0.1)
    result = run(slowly)
    assert clock.now_s < 7.5  # looked at each twentieth of the first stage
    found = result.estimate
    assert found.method == "monte-carlo"
    assert "no interval, 20 % were requested, and stopped by max_minutes 0.1" in summary_text(
        result
    )
    assert found.failures == 0
    assert found.ci_high == pytest.approx(1.0 - 0.025 ** (1.0 / found.rollouts_simulated))


def test_the_rarest_rule_decides_whether_counting_pays():
    """One rule is broken by every second rollout, the other by one in a hundred thousand."""
    simulator, pem = RARE
    last = simulator.states - 1
    often, rare = f"always[0,{last}] (gap >= 3.5)", f"always[0,{last}] (gap >= 0.5)"
    chosen = {}
    for name, formulas in {"both": {"often": often, "rare": rare}, "one": {"often": often}}.items():
        config = ExperimentConfig(method="auto", seed=1).with_rules(formulas)
        result = run(build_experiment(config, simulator=simulator, pem=pem))
        chosen[name] = result.estimate.method
        exact = toy_probability_by_recursion(*RARE)
        if name == "both":
            assert result.rules[1].estimate.probability == pytest.approx(exact, rel=0.6)
    assert chosen == {"both": "mixture", "one": "monte-carlo"}


@pytest.mark.parametrize("seed", [0, 1])
def test_each_rule_that_is_broken_is_answered_as_precisely_as_was_asked(seed):
    """Of three, one is broken ten thousand times as rarely as another, and one never."""
    simulator, pem = RARE
    last = simulator.states - 1
    rules = {
        "near": f"always[0,{last}] (gap >= 2.5)",
        "deep": f"always[0,{last}] (gap >= -1.5)",
        "never": f"always[0,{last}] (gap >= -99)",
    }
    config = ExperimentConfig(method="auto", seed=seed, precision=0.03).with_rules(rules)
    result = run(build_experiment(config, simulator=simulator, pem=pem))
    near, deep, never = (rule.estimate for rule in result.rules)
    assert never.failures == 0
    assert 5_000 * deep.probability < near.probability
    assert near.relative_half_width < deep.relative_half_width < 1.1 * config.precision
    assert result.estimate.rollouts_simulated < 12_000
    assert "the widest interval, of deep, is +- " in summary_text(result)


def test_two_sides_of_random_starts_and_noise_are_both_found():
    """Misses apart, |distance| over a limit has two modes that are equally likely."""
    drift = Drift(states=9)
    limit = 4.5 * math.sqrt(0.5**2 + 8 * 0.2**2)
    exact = 2.0 * stats.norm.sf(4.5)
    last = drift.states - 1
    spec = f"eventually[{last},{last}] (distance <= {limit!r} and distance >= {-limit!r})"
    for seed in range(2):
        config = ExperimentConfig(method="auto", spec=spec, seed=seed)
        found = run(build_experiment(config, simulator=drift, pem=ConstantPem(0.5))).estimate
        assert found.probability == pytest.approx(exact, rel=0.5)


def test_an_answer_that_plain_rollouts_contradict_is_told():
    inside = {"low": 0.01, "high": 0.03, "failures": 20, "rollouts": 1_000}
    assert plain_disagreement(0.02, **inside) == ()
    (low,) = plain_disagreement(0.002, **inside)
    (high,) = plain_disagreement(0.2, **inside)
    assert low.kind == high.kind == "plain-disagrees"
    assert "20 of 1000 plain rollouts" in low.text


def test_a_closed_form_on_either_side_of_the_choice():
    """From a probability of 0.4 to one of 1e-7; 0.4 apart is 4 of the errors asked for."""
    for miss, chosen in ((0.25, "monte-carlo"), (0.001, "mixture")):
        exact = exact_failure_probability(steps=12, miss_probability=miss)
        simulator = MissCounter(states=13)
        config = ExperimentConfig(method="auto", spec="always[0,12] (gap >= 0)", seed=5)
        result = run(build_experiment(config, simulator=simulator, pem=ConstantPem(miss)))
        assert result.estimate.method == chosen
        assert result.estimate.probability == pytest.approx(exact, rel=0.4)


@pytest.mark.parametrize(("system", "chosen"), [(OFTEN, "monte-carlo"), (RARE, "mixture")])
def test_what_was_chosen_is_told(system, chosen):
    result = run(experiment(*system, seed=2))
    told = summary_text(result)
    assert f"auto, which chose {chosen}:" in told
    first, half = result.stages[0], result.estimate.relative_half_width
    assert f"{first.failures} of the first {first.rollouts} plain rollouts violate" in told
    assert f"+- {100 * half:.{1 if half < 0.1 else 0}f} %, 20 % were requested" in told
    assert f"method {chosen} " in _sampling_step(result).lower()


def test_a_count_that_falls_short_is_said_to_be_as_large_as_the_first_ones_asked_for():
    result = run(experiment(*OFTEN, seed=1, precision=0.03))
    assert result.estimate.relative_half_width > 0.03
    counted = f"{result.estimate.rollouts_in_estimate} plain rollouts were counted"
    assert f"3 % were requested; {counted}, as many as the first ones" in summary_text(result)


def test_a_completed_count_is_not_said_to_be_stopped_by_the_clock():
    result = run(experiment(*OFTEN, seed=1, precision=0.03, max_minutes=60.0))
    assert result.estimate.relative_half_width > 0.03
    assert "stopped by max_minutes" not in summary_text(result)
    assert "plain rollouts were counted, as many as the first ones" in summary_text(result)


def test_fewer_at_most_than_it_begins_with_are_refused():
    with pytest.raises(ConfigError, match=r"^max_rollouts = 100: must be at least the 1200 that"):
        experiment(*RARE, max_rollouts=100)


@pytest.mark.parametrize(
    ("settings", "by"),
    [
        ({"max_rollouts": 1_300}, "max_rollouts 1300"),
        ({"max_minutes": 1e-6}, "max_minutes 1e-06"),
    ],
)
def test_what_stopped_it_is_told(settings, by):
    often = {"precision": 0.001} if "max_minutes" in settings else {"precision": 0.02}
    system = OFTEN if "max_minutes" in settings else RARE
    result = run(experiment(*system, seed=1, **often, **settings))
    assert result.estimate.relative_half_width > often["precision"]
    assert f"and stopped by {by}" in summary_text(result)


def test_a_percentage_is_a_share():
    config = parse_arguments(ExperimentConfig, ["--precision", "7.5%"], command="record")
    assert config.precision == 0.075
