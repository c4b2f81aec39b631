"""The sources of a made-up result: what bounds them, what they say, and where they stand."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pemviz.analysis.model_uncertainty import ModelClassAnswer
from pemviz.charts.chart import DOTTED
from pemviz.charts.svg import svg
from pemviz.config import METHODS, EncounterConfig
from pemviz.latents import LatentCounts
from pemviz.recording.text import answer_text
from pemviz.reports.answer_words import uncertainty_table
from pemviz.reports.charts import uncertainty_chart
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import MOST_WARNINGS, run_document
from pemviz.reports.terminal import plain_lines, print_summary
from pemviz.runs.result import MeasuredAnswer, MeasuredTau, RunMemory
from pemviz.runs.result_file import result_document
from pemviz.runs.uncertainty import SEVERAL_SLOTS, run_remedy, uncertainty_budget
from pemviz.sampling.bursts.curve import CurvePoint
from tests.reports.runs import NASTY, estimate, result, warned


def model_class(name, log10, *, effective=50.0):
    return ModelClassAnswer(
        name=name,
        probability=10.0**log10,
        log10_probability=log10,
        relative_std_error=0.2,
        effective_failures=effective,
    )


MODEL_CLASSES = (
    model_class("lr", -8.0),
    model_class("gb-raw", -17.0),
    model_class("b-nn", -10.0),
)


def sources(one):
    return {source.kind: source for source in uncertainty_budget(one)}


def test_each_source_has_the_ends_of_what_it_stands_for():
    one = result(model_classes=MODEL_CLASSES)
    found = sources(one)
    assert list(found) == ["sampling", "reference", "refits", "model-classes", "memory", "data"]
    assert (found["sampling"].low, found["sampling"].high) == (8e-16, 5e-15)
    assert found["reference"].low < one.reference.probability < found["reference"].high
    assert (found["refits"].low, found["refits"].high) == (
        one.pem_interval.low, one.pem_interval.high
    )  # fmt: skip
    assert (found["model-classes"].low, found["model-classes"].high) == (1e-17, 1e-8)
    assert "gb-raw to lr" in found["model-classes"].name
    assert (found["memory"].low, found["memory"].high) == (None, None)
    assert (found["data"].low, found["data"].high) == (0.0, one.data_bound.probability)


def test_what_is_not_known_is_said():
    bare = result(reference=None, pem_interval=None, data_bound=None)
    found = sources(bare)
    assert list(found) == ["sampling", "refits", "memory", "data"]
    for kind in ("refits", "data"):
        assert found[kind].low is found[kind].high is None
        assert found[kind].note
    assert uncertainty_budget(replace(bare, estimate=None)) == ()


def test_model_classes_that_few_rollouts_carry_are_named():
    vague = (model_class("lr", -8.0, effective=3.0), model_class("b-nn", -10.0))
    assert sources(result(model_classes=vague))["model-classes"].note == "lr only roughly"


def test_memory_tells_what_is_assumed_and_what_was_measured():
    assert "taken as none" in sources(result())["memory"].name
    measured = MeasuredTau(tau_s=0.24, low_s=0.18, high_s=0.32, confidence=0.95)
    own = sources(result(memory=RunMemory(tau_s=0.1, fitted=measured)))["memory"]
    assert "0.1 s assumed" in own.name
    ends = tuple(
        MeasuredAnswer("this error model", CurvePoint(tau_s, p, 0.9 * p, 1.1 * p, 50.0))
        for tau_s, p in ((0.18, 1e-4), (0.32, 4e-4))
    )
    over = RunMemory(tau_s=0.24, fitted=measured, measured=ends)
    own = sources(result(memory=over))["memory"]
    assert own.name == "memory of misses, its own, 0.18 to 0.32 s"
    assert (own.low, own.high) == pytest.approx((0.9e-4, 4.4e-4))


def test_memory_is_bounded_by_the_curve_over_memory_times():
    curve = tuple(
        CurvePoint(tau_s=tau_s, probability=p, low=0.9 * p, high=1.1 * p, ess=99.0)
        for tau_s, p in ((0.0, 2e-15), (0.2, 4.6e-3), (1.0, 1e-2))
    )
    source = sources(result(memory=RunMemory(tau_s=0.0, curve=curve)))["memory"]
    assert (source.low, source.high) == (0.9 * 2e-15, 1.1 * 1e-2)
    assert source.name.endswith(", 0 to 1 s")


@pytest.mark.parametrize("method", METHODS.names())
def test_an_interval_that_does_not_hold_comes_with_what_to_try(method, capsys):
    wrong = warned("one rollout carries 98% of the weight", kind="died-out")
    one = result(estimate(method=method, diagnostics=(wrong,)))
    sampling = sources(one)["sampling"]
    assert "not a 95 % interval" in sampling.name
    print_summary(one, Path("run"))
    assert f"try next: {sampling.narrowed_by}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "checks"),
    [
        ({}, "zero-variance or splitting"),
        ({"spec": "eventually[0,99] (gap >= 2.0)"}, "splitting"),
        ({"spec": NASTY}, "splitting"),
        ({"simulator": "own"}, "subset"),
        ({"simulator": "sumo"}, "subset"),
        ({"position_errors": "pointrcnn"}, "subset"),
        ({"encounter": EncounterConfig(logical_scenario="cut-in")}, "subset"),
        ({"lost": "none"}, "zero-variance"),
        ({"lost": "none", "simulator": "own"}, None),
    ],
)
def test_no_method_is_recommended_that_the_run_refuses(changes, checks):
    wrong = warned("the weights' tail is too heavy", kind="died-out")
    one = result(estimate(method="auto", diagnostics=(wrong,)))
    one = replace(one, config=replace(one.config, **changes))
    beside = f"; --method {checks} beside it" if checks else ""
    assert run_remedy(one) == f"a larger --max-rollouts, or --max-minutes{beside}"


@pytest.mark.parametrize(
    ("config", "memory", "option"),
    [
        ({}, {}, "--memory-curve"),
        ({"lost": "violation"}, {}, "a run with another --memory-s"),
        ({"lost": "none"}, {"tau_s": 0.25}, "a run with another --memory-s"),
        ({}, {"unmeasured": f"{SEVERAL_SLOTS}; why"}, "a run with another --memory-s"),
        ({}, {"hidden": ("rain",)}, "a run with other hidden properties"),
    ],
)
def test_no_look_at_other_memories_is_recommended_that_the_run_refuses(config, memory, option):
    memory = RunMemory(**{"tau_s": 0.0, **memory})
    one = result(estimate(method="mixture"), memory=memory)
    one = replace(one, config=replace(one.config, **config))
    assert sources(one)["memory"].narrowed_by == option
    sections = run_document(one).sections
    text = " ".join(plain_lines(b for part in sections for b in (*part.brief, *part.full)))
    assert f"not looked at in this run: {option} does" in text
    assert ("--memory-curve" in text) == (option == "--memory-curve")
    if memory.is_independent:
        assert f"an assumption, and {option} shows what it changes" in text


def test_no_method_that_runs_through_states_is_recommended_where_latents_leave_none(capsys):
    wrong = warned("the weights' tail is too heavy", kind="died-out")
    one = estimate(method="mixture", diagnostics=(wrong,))
    doubted = result(one, latents=LatentCounts(noise=1))
    assert sources(doubted)["sampling"].narrowed_by == "more rollouts; --method subset beside it"
    print_summary(doubted, Path("run"))
    assert "zero-variance" not in capsys.readouterr().out
    assert "zero-variance" in sources(replace(doubted, latents=None))["sampling"].narrowed_by


@pytest.mark.parametrize("tell", [summary_markdown, lambda one: answer_text(one, running=False)])
def test_every_report_has_every_source(tell):
    one = result(model_classes=MODEL_CLASSES)
    text = tell(one).replace("\\", "")
    for row in uncertainty_table(one).rows:
        assert row[0] in text


def test_the_uncertainty_budget_stands_in_result_json():
    one = result(model_classes=MODEL_CLASSES)
    entries = json.loads(json.dumps(result_document(one)))["uncertainty"]
    assert [entry["kind"] for entry in entries] == list(sources(one))
    assert entries[0]["high"] == one.estimate.ci_high


@pytest.mark.parametrize("low", [0.0, 5e-324, 1e-30, 0.3])
def test_the_drawing_stays_within_its_axis(low):
    one = result(estimate(ci_low=low, ci_high=1.2), model_classes=MODEL_CLASSES)
    drawn = svg(uncertainty_chart(one))
    assert "nan" not in drawn
    dotted = drawn.count(f"stroke-dasharray='{DOTTED}'")
    assert drawn.count("<rect") + dotted == sum(
        source.high is not None for source in uncertainty_budget(one)
    )
    assert uncertainty_chart(replace(one, estimate=None)) is None


def test_the_terminal_shows_at_most_five_warnings_and_all_if_asked(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    wrong = tuple(warned(f"wrong {number}") for number in range(9))
    data = tuple(f"{kind}: at {z} m" for kind in ("extrapolation", "thin data") for z in range(4))
    one = result(estimate(diagnostics=wrong), model_classes=MODEL_CLASSES, warnings=data)
    print_summary(one, Path("run"))
    brief = capsys.readouterr().out
    told = [line for line in brief.splitlines() if line.startswith("warning")]
    assert len(told) == MOST_WARNINGS
    assert "extrapolation (4), thin data (4)" in told[-1]
    assert len(brief.splitlines()) <= 25
    print_summary(one, Path("run"), verbose=True)
    whole = " ".join(capsys.readouterr().out.split())
    for text in (*data, *(one.text for one in wrong)):
        assert text in whole
