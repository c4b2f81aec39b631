"""What a run answers: two numbers first, the range to act on and what decides it, a row a rule."""

from dataclasses import replace

import pytest

from pemviz.config import ExperimentConfig
from pemviz.config.encounters import EncounterConfig
from pemviz.pem import load_pem
from pemviz.reports.headline_words import IMPOSSIBLE, answers_table
from pemviz.reports.html import sections_html
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines, summary_text
from pemviz.runs.answers import answers, rules_in_order
from pemviz.runs.engine import run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result import MeasuredAnswer, MeasuredTau, RuleAnswer, RunMemory
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.runs.supplements import measured_memories
from pemviz.sampling.bursts.curve import MEASURED, CurvePoint, memory_points
from tests.reports.runs import estimate, result, warned

RRC, POINTRCNN = MEASURED
BY_ZERO_VARIANCE = {RRC: 8.445e-3, POINTRCNN: 4.164e-3}
"""P(violation) of ``paper`` with these memories, by zero-variance: 0.2 % standard error."""


def measured(name: str, probability: float) -> MeasuredAnswer:
    memory = MEASURED[name]
    low, high = 0.8 * probability, 1.25 * probability
    point = CurvePoint(memory.tau_s, probability, low, high, 90.0, (), memory.frailty)
    return MeasuredAnswer(name, point)


LOOKED_AT = RunMemory(tau_s=0.0, measured=(measured(RRC, 8e-3), measured(POINTRCNN, 4e-3)))


def test_two_numbers_come_first_on_every_way_in():
    run = result(
        estimate=estimate(method="mixture", diagnostics=()), reference=None, memory=LOOKED_AT
    )
    first = "0.0040 to 0.0080 with the memory of measured detectors, 2.0e-15 if misses are ind"
    document = run_document(run)
    pages = (
        plain_lines(document.blocks("answer", brief=True))[0],
        summary_text(run).splitlines()[0],
        summary_markdown(run).splitlines()[0],
        sections_html(document.choose(("answer",))),
        run._repr_html_(),
    )
    for page in pages:
        assert first in page
    lines = plain_lines(document.blocks("answer", brief=True))
    assert lines[1] == (
        "To act on: at most 0.010, at least 1.0e-17, decided by memory of misses, as measured on "
        "video"
    )
    assert lines[2].startswith(f"with the memory of {RRC} (0.25 s, frailty 0.68): 0.0080, 0.0064")


def test_where_nobody_looked_it_is_not_known_and_why():
    memory = RunMemory(tau_s=0.0, unmeasured="not with several slots")
    run = result(estimate=estimate(method="mixture", diagnostics=()), reference=None, memory=memory)
    lines = plain_lines(run_document(run).blocks("answer", brief=True))
    assert "if misses are independent, not known with a memory, if error model" in lines[0]
    assert lines[1].startswith(
        "To act on: at least 1.0e-17, how high is not known, decided by memory"
    )
    assert lines[1].endswith("not looked at (not with several slots)")
    assert sum("several slots" in line for line in lines) == 1


def test_why_it_is_not_known_is_told_though_the_sampling_decides():
    memory = RunMemory(tau_s=0.0, unmeasured="not with several slots")
    lines = plain_lines(
        run_document(result(memory=memory, reference=None)).blocks("answer", brief=True)
    )
    assert "the sampling does not hold" in lines[1]
    assert lines[2] == "with a memory of misses: not known, not with several slots"


def test_sampling_that_does_not_hold_decides_alone():
    run = result(
        estimate=estimate(method="mixture", diagnostics=(warned("the weights tie"),)),
        memory=LOOKED_AT,
    )
    first = answers(run)[0]
    assert first.open.decided_by.kind == "sampling"
    assert "To act on: nothing yet, the sampling does not hold" in summary_text(run)


def test_collisions_come_first_and_what_cannot_be_broken_says_so():
    one = estimate(method="mixture", diagnostics=())
    none = replace(one, failures=0, probability=0.0, log10_probability=None, ci_low=None)
    none = replace(none, ci_high=None, std_error=None)
    needless = "always[0,90] (needless_deceleration <= 6.0)"
    rules = (
        RuleAnswer("safe-distance", "always[0,90] (safe_distance >= 0.0)", one),
        RuleAnswer("no-collision", "always[0,90] (clearance >= 0.0)", one),
        RuleAnswer("no-unnecessary-braking", needless, none),
    )
    assert next(rule.name for rule in rules_in_order(rules)) == "no-collision"
    config = ExperimentConfig(encounter=EncounterConfig(logical_scenario="cut-in"))
    config = config.with_rules({rule.name: rule.formula for rule in rules})
    run = result(estimate=one, rules=rules, config=config)
    rows = answers_table(run).rows
    assert [row[0] for row in rows] == [
        "no-collision", "safe-distance", "no-unnecessary-braking", "any of them",
    ]  # fmt: skip
    assert rows[2][1] == IMPOSSIBLE
    assert "rule no-collision is broken in one encounter of cut-in" in summary_text(run)
    ghosts = replace(config.encounter, ghost_probability=0.1)
    open_rows = answers_table(replace(run, config=replace(config, encounter=ghosts))).rows
    assert open_rows[2][1].startswith("0: no violation was seen")


def test_what_was_measured_is_kept_in_the_result_file():
    run = result(memory=LOOKED_AT)
    assert result_from_document(result_document(run)).memory == LOOKED_AT


def test_which_memories_are_looked_at():
    own = MeasuredTau(0.25, 0.17, 0.38, 0.95, 0.7, 0.3, 1.2)
    assert dict(measured_memories(RunMemory(0.0))) == MEASURED
    ((_, only),) = measured_memories(RunMemory(0.0, fitted=own))
    assert (only.tau_s, only.frailty) == (0.25, 0.7)
    ends = [memory for _, memory in measured_memories(RunMemory(0.25, own, frailty=0.7))]
    assert [(end.tau_s, end.frailty) for end in ends] == [
        (0.17, 0.7), (0.38, 0.7), (0.25, 0.3), (0.25, 1.2),
    ]  # fmt: skip


def test_answers_with_measured_memories_are_right():
    """600 rollouts, 4 seeds: 8 intervals, two of which may fail at 95 % each with odds of 1 in 20.

    Each estimate lies within 40 % of the truth; the error of one is 15 % or less.
    """
    experiment = build_experiment(ExperimentConfig())
    assert experiment.twin is not None
    problem = replace(experiment.problem, simulator=experiment.twin)
    held = 0
    for seed in range(4):
        points = memory_points(
            problem, pem=load_pem("ml-nn"), features=experiment.features, seed=seed,
            memories=tuple(MEASURED.values()), rollouts=600,
        )  # fmt: skip
        for (name, memory), point in zip(MEASURED.items(), points, strict=True):
            truth = BY_ZERO_VARIANCE[name]
            assert (point.tau_s, point.frailty) == (memory.tau_s, memory.frailty)
            assert point.probability == pytest.approx(truth, rel=0.4)
            held += point.low <= truth <= point.high
    assert held >= 6


@pytest.mark.parametrize("looked_at", [True, False])
def test_a_run_looks_unless_it_is_told_not_to(looked_at):
    """However few rollouts the run has, what it says of other memories is right within 40 %."""
    config = ExperimentConfig(
        method="monte-carlo", final_rollouts=50, measured_memory=looked_at
    ).with_rules({"contact": "always[0,99] (gap >= 0.0)", "gap": "always[0,99] (gap >= 2.0)"})
    memory = run_experiment(config).memory
    assert bool(memory.measured) == looked_at
    assert memory.unmeasured == ("" if looked_at else "measured_memory is switched off")
    for one in memory.measured:
        assert one.point.probability == pytest.approx(BY_ZERO_VARIANCE[one.name], rel=0.4)


def test_refits_answer_every_rule():
    """Contact is a gap below 2 m too: refits of the wider rule are those of any of both."""
    config = ExperimentConfig(
        method="mixture", rollouts=20, stages=3, final_rollouts=200, measured_memory=False
    ).with_rules(
        {"contact": "always[0,99] (gap >= 0.0)", "gap": "always[0,99] (gap >= 2.0)",
         "far": "always[0,99] (gap >= -1000.0)"}
    )  # fmt: skip
    run = run_experiment(config)
    contact, gap, far = run.rules
    assert gap.refits == run.pem_interval
    assert far.refits is None
    for one, any_rule in zip(contact.refits.log10_answers, gap.refits.log10_answers, strict=True):
        assert one <= any_rule
    assert contact.refits.high < gap.refits.high
    assert result_from_document(result_document(run)) == run
    answer = next(one for one in answers(run) if one.rule is contact)
    assert answer.open.low <= contact.refits.low
