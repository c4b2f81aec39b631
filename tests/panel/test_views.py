"""Views: the right figures, units, and nothing of a stranger's text taken for markup."""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from pemviz.analysis.causes import BandMisses, Chain
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.model_uncertainty import ModelClassAnswer
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.charts.svg import Axis, Plot, nice_ticks
from pemviz.errors import InputError
from pemviz.panel import compare_page, learning_page, weights_page, why_page
from pemviz.panel.controller import PanelState
from pemviz.panel.pieces import drawn, number
from pemviz.panel.ranking import rank, row, shares
from pemviz.panel.rollout_charts import step_words, track, track_charts
from pemviz.panel.run_data import RunData
from pemviz.panel.run_summary import summary
from pemviz.panel.scene import brakes
from pemviz.panel.shared_state import status_words
from pemviz.reports.charts import models_chart
from pemviz.reports.estimate_words import short_probability
from pemviz.reports.html import sections_html
from pemviz.reports.run_document import run_document
from pemviz.runs.drawn_rollout import RIGHT
from pemviz.runs.forecast import Progress
from pemviz.runs.result import PemInfo, RunMemory
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Diagnostic
from tests.reports.runs import PLAN

CRAFTED = "<script>alert(1)</script>"


def well_formed(fragment: str) -> ET.Element:
    return ET.fromstring(f"<all>{fragment.replace('<br>', '<br/>')}</all>")  # noqa: S314  our own


def strip(run: RunData) -> str:
    """What stands above everything on the page of a run."""
    words = summary(run.result)
    return " | ".join(
        str(words[name]) for name in ("headline", "beside", "act_on", "target", "sampling")
    ) + " | ".join(words["warnings"])


def test_every_page_is_well_formed(live_run, loaded_run, naive_run):
    for run in (live_run, loaded_run, naive_run):
        for page in (
            learning_page.learning(run),
            why_page.why(run),
            compare_page.metrics_page(run),
            compare_page.runs_page([run, live_run, naive_run]),
            weights_page.weights_page(run),
        ):
            well_formed(page)


def test_a_metric_that_cannot_score_the_rollouts_is_told_and_the_others_stay(naive_run):
    scenario = replace(naive_run.config.scenario, gap_bound_m=10.0)
    run = with_result(naive_run, config=replace(naive_run.config, scenario=scenario))
    page = well_formed(compare_page.metrics_page(run))
    (alert,) = [words for words in page.itertext() if "left out" in words]
    assert "agm is left out: metric = 'agm': gap reaches" in alert
    assert [header.text for header in page.iter("th")][1:] == ["classical", "smooth-cumulative"]
    lines = compare_page.metric_chart(run).marks[1:]
    assert [line.label for line in lines] == ["classical", "smooth-cumulative"]


def test_rollouts_that_latents_carry_beyond_agms_bounds_are_ranked_all_the_same(naive_run):
    """As if they had stayed at the bound; without latents a gap beyond it is no such run's."""
    table = dict(naive_run.rollouts)
    safe = int(np.argmax(table["gap_m"].min(axis=1)))
    for name, gap_m in (("kept", 25.0), ("left", 25.2)):
        table[name] = np.array(table["gap_m"])
        table[name][safe, 3] = gap_m
    drawn = {f"latents.{name}": np.zeros((60, 1)) for name in ("start", "start_mean")}
    drawn["latents.start_log_weight"] = np.zeros(60)
    left = {**table, "gap_m": table["left"]}
    with pytest.raises(InputError, match="declared bounds"):
        rank(replace(naive_run, parts=(left,)), "agm")
    ranked = rank(replace(naive_run, parts=({**left, **drawn},)), "agm")
    kept = rank(replace(naive_run, parts=({**table, "gap_m": table["kept"]},)), "agm")
    np.testing.assert_array_equal(ranked.robustness, kept.robustness)


def test_loaded_run_shows_what_the_live_one_showed(live_run, loaded_run):
    assert loaded_run.result == live_run.result
    assert len(loaded_run.curves) == len(live_run.curves)
    for live, loaded in zip(live_run.curves, loaded_run.curves, strict=True):
        np.testing.assert_allclose(loaded.detection, live.detection, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(loaded_run.pem_detection, live_run.pem_detection)


def test_headline_gives_the_estimate(naive_run):
    text = strip(naive_run)
    estimate = naive_run.result.estimate
    assert text.startswith("Failure probability in one run: 0.00")  # with a memory as measured
    assert f"{short_probability(estimate)} if misses are independent" in text
    assert "if error model ml-nn is right |" in text
    scenario = replace(naive_run.config.scenario, tracker="2/3,coast=0.5")
    config = replace(naive_run.config, scenario=scenario)
    memory = RunMemory(tau_s=0.2, frailty=0.7)
    errors = PemInfo(name="pointrcnn", digest="", data="")
    asked = strip(with_result(naive_run, config=config, memory=memory, position_errors=errors))
    assert (
        f"{short_probability(estimate)} with an assumed memory of misses (0.2 s, frailty 0.7)"
    ) in asked
    assert "right; with tracker 2/3,coast=0.5, position errors pointrcnn |" in asked


def test_headline_and_why_tell_of_a_disagreement_with_the_reference(naive_run):
    estimate = replace(naive_run.result.estimate, diagnostics=())
    known = Reference(0.01 * estimate.probability, 0.0, math.log10(0.01 * estimate.probability))
    run = with_result(naive_run, estimate=estimate, reference=known)
    for page in (strip(run), why_page.why(run)):
        assert "1e+02 times the reference" in page
        assert "trust the reference" in page


def test_headline_never_gives_a_bare_zero(naive_run):
    nothing = replace(naive_run.result.estimate, failures=0, probability=0.0, ci_high=0.03)
    text = strip(with_result(naive_run, estimate=nothing))
    assert "no violation was seen" in text
    assert "0.03" in text


def test_a_strangers_recording_cannot_smuggle_markup(naive_run):
    whole = naive_run.result
    warned = Diagnostic(kind="large-weight", value=0.5, limit=0.2, text=CRAFTED)
    sensitivity = tuple(replace(s, warning=CRAFTED) for s in whole.explanation.sensitivity)
    run = with_result(
        naive_run,
        run_id=CRAFTED,
        message=CRAFTED,
        config=replace(whole.config, pem=CRAFTED, spec=CRAFTED, simulator=CRAFTED, target=1e-18),
        pem=PemInfo(name=CRAFTED, digest=CRAFTED, data=CRAFTED),
        versions={CRAFTED: CRAFTED},
        assumptions=(CRAFTED,),
        warnings=(CRAFTED, f"{CRAFTED}, the reference"),
        estimate=replace(whole.estimate, method=CRAFTED, diagnostics=(warned,)),
        pem_interval=replace(whole.pem_interval, warnings=(CRAFTED,)),
        explanation=replace(whole.explanation, sensitivity=sensitivity),
        plan=replace(PLAN, reason=CRAFTED, labels=replace(PLAN.labels, obstacle=CRAFTED)),
        timings_s={CRAFTED: 1.0},
    )
    for page in (
        learning_page.learning(run),
        why_page.why(run),
        compare_page.runs_page([run, naive_run]),
        weights_page.weights_page(run),
        compare_page.metrics_page(
            with_result(run, config=replace(run.config, spec=whole.config.spec))
        ),
    ):
        assert "<script" not in page
        well_formed(page)


def test_status_tells_stage_rollouts_and_time_left():
    at = Progress(began_s=0.0, now_s=10.0, stage=4, stages=12, before=500, planned=1200)
    at = replace(at, share=500 / 1200, sampled=500, sampled_s=10.0)
    text = status_words(PanelState(running=True, progress=at))
    assert "Stage 4 of 11: 500 of 1,200 rollouts, about 14 s left" in text
    levels = status_words(PanelState(running=True, progress=replace(at, by_level=True)))
    assert "Stage 4 of 11: 42% of the way to violations, about 14 s left" in levels
    grows = replace(at, goes_on=True, may_grow=True)
    open_end = status_words(PanelState(running=True, progress=grows))
    assert open_end == "Stage 4: 500 of 1,200 rollouts, about 14 s left, or more"
    unknown = status_words(PanelState(running=True, progress=replace(grows, planned=0)))
    assert unknown == "Stage 4: 500 rollouts"
    by_workers = replace(at, now_s=60.0, sampled_s=60.0, workers="by 4 processes")
    slow = status_words(PanelState(running=True, progress=by_workers))
    assert "500 of 1,200 rollouts by 4 processes, 500 a minute, about 87 s left" in slow
    assert "Stopping" in status_words(PanelState(running=True, stopping=True))
    assert "Ready" in status_words(PanelState())


def test_causes_are_told_in_words_with_units(naive_run):
    explanation = Explanation(
        repetition=0,
        misses_by_distance=(
            BandMisses(low=4.0, high=6.0, misses=1.6999, share=0.16145),
            BandMisses(low=6.0, high=8.0, misses=8.83, share=0.83855),
            BandMisses(low=8.0, high=10.0, misses=0.0, share=0.0),
        ),
        miss_probability_by_step=(),
        chains=(Chain(missed_steps=(39, 41, 42), share=0.2688, rollouts=1, nll=45.7),),
        sensitivity=(
            BandSensitivity(None, None, elasticity=9.93, target_factor=0.25, target_ess=20.0),
            BandSensitivity(4.0, 6.0, elasticity=None, target_factor=None, target_ess=None),
            BandSensitivity(6.0, 8.0, elasticity=-0.123, target_factor=None, target_ess=None),
            BandSensitivity(8.0, 10.0, elasticity=0.0, target_factor=1.0, target_ess=20.0),
        ),
    )
    run = with_result(
        naive_run,
        config=replace(naive_run.config, target=1e-18),
        explanation=explanation,
    )
    far = Reference(probability=1e-9, std_error=0.0, log10_probability=-9.0)
    run = with_result(run, reference=far)
    *_, disagreement = run_diagnostics(run.result)
    run = with_result(run, warnings=("thin data", disagreement.text))
    page = why_page.why(run)
    words = ["".join(cell.itertext()) for cell in well_formed(page).iter("td")]
    assert words[:5] == ["4 to 6", "1.70", "16 %", "-", "not enough alone"]
    assert words[5:10] == ["6 to 8", "8.83", "84 %", "-0.12 (error not known)", "not enough alone"]
    assert words[10:15] == ["all", "10.53", "100 %", "9.93 (error not known)", "25 %"]
    assert "8 to 10" not in words
    assert words[15:17] == ["27 %", "3"]
    assert "1.95, 2.05 to 2.10" in page
    for raw in ("misses_by_distance", "elasticity", "repetition", "nll", "target_factor"):
        assert raw not in page
    trust, data = page.index(">Warnings<"), page.index(">Extrapolated")
    assert trust < page.index("trust the reference") < data < page.index("thin data")


def test_learning_does_not_speak_of_what_a_method_has_not(naive_run):
    def page(method):
        run = with_result(naive_run, config=replace(naive_run.config, method=method))
        text = learning_page.learning(run)
        well_formed(text)
        return text + " ".join(line.label for line in learning_page.proposal_chart(run).marks)

    assert "older stages fade" in page("adaptive")
    for method in ("splitting", "subset", "monte-carlo", "naive", "zero-variance"):
        assert "proposal after stage" not in page(method)
        assert "a stage alone" not in page(method)
    assert "cut and continued" in page("splitting")
    assert "Threshold" not in page("splitting")
    assert "some of their random numbers changed" in page("subset")
    assert "optimal proposal" in page("zero-variance")


def test_a_method_that_chose_another_is_shown_as_that(naive_run):
    config = replace(naive_run.config, method="auto")
    for chosen, learns in (("monte-carlo", False), ("mixture", True)):
        estimate = replace(naive_run.result.estimate, method=chosen)
        run = with_result(naive_run, config=config, estimate=estimate)
        assert ("older stages fade" in learning_page.learning(run)) == learns
        names = [line.label for line in learning_page.proposal_chart(run).marks]
        assert any("proposal after stage" in name for name in names) == learns


def test_without_a_violation_the_upper_bound_is_drawn(naive_run):
    nothing = replace(
        naive_run.result.estimate, failures=0, probability=0.0, ci_low=0.0, ci_high=0.03
    )
    run = with_result(naive_run, reference=None, estimate=nothing)
    assert "95 % upper bound" in learning_page.learning(run)


def test_track_holds_the_rollout_its_limits_and_its_probabilities(naive_run):
    entry = row(naive_run, rank(naive_run, "classical"), 0)
    chosen = track(naive_run, entry)
    np.testing.assert_array_equal(chosen.values, naive_run.rollouts["gap_m"][entry.index])
    by_name = {signal.name: limits for signal, limits in chosen.limits.items()}
    assert by_name == {"gap": (2.0,), "ego_speed": (), "lead_speed": ()}
    pem, proposal = chosen.detection
    np.testing.assert_allclose(proposal, 0.5, rtol=1e-12)
    assert np.all((pem > 0.5) & (pem < 1.0))
    step = chosen.interesting_step
    assert chosen.values[step] < 2.0
    assert np.all(chosen.values[:step] >= 2.0)
    np.testing.assert_array_equal(
        chosen.answers[:, 0] == RIGHT, naive_run.rollouts["detected"][entry.index]
    )


def test_words_of_a_step_end_with_contact(naive_run):
    chosen = track(naive_run, row(naive_run, rank(naive_run, "classical"), 0))
    for chart in track_charts(chosen, width=400):
        well_formed(drawn(chart))
    contact = chosen.contact_step
    assert step_words(chosen, contact - 1) in {"detected", "MISSED"}
    assert step_words(chosen, contact) == "after contact"
    assert step_words(chosen, 99) == "after contact"


def test_a_full_overlap_is_a_hundred_per_cent():
    one, two = np.array([True, True, False]), np.array([True, False, True])
    assert compare_page.overlap_text(one, one) == "2 (100 %)"
    assert compare_page.overlap_text(one, two) == "1 (33 %)"
    assert compare_page.overlap_text(~(one | two), ~(one | two)) == "0"


def test_numbers():
    assert number(1.824e-15) == "1.82 × 10⁻¹⁵"
    assert number(0.0) == "0"
    assert number(None) == number(math.nan) == "–"
    assert number(-3.25, 3) == "−3.25"


def test_ticks_are_round_and_inside():
    assert nice_ticks(0.0, 20.0, count=4) == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert nice_ticks(-16.0, -13.0, count=4, whole=True) == [-16.0, -15.0, -14.0, -13.0]
    assert nice_ticks(1.0, 1.0, count=4) == [1.0]


def test_plot_maps_values_to_pixels_and_breaks_lines_at_nan():
    plot = Plot(x=Axis(0.0, 10.0, "x [m]"), y=Axis(0.0, 1.0, "y"), width=200, height=100)
    assert plot.px(0.0) == plot.left
    assert plot.px(10.0) == plot.right
    assert plot.py(1.0) == plot.top
    plot.line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 1.0, np.nan, 1.0]), color="#000")
    text = plot.text()
    assert "x [m]" in text
    path = next(p for p in well_formed(text).iter() if p.get("fill") == "none").get("d")
    assert path is not None
    assert path.count("M") == 2


def test_lamps_are_lit_while_a_car_brakes():
    speeds = np.array([20.0, 20.0, 19.6, 19.6])
    assert brakes(speeds, dt_s=0.05).tolist() == [False, True, False, False]


def with_result(run: RunData, **changes) -> RunData:
    return replace(run, result=replace(run.result, **changes))


def test_the_why_tab_gives_one_total_of_misses(naive_run):
    """The sentence and the table's last line speak of the same misses."""
    page = why_page.why(naive_run)
    (said,) = re.findall(r"takes ([\d.]+) misses where perception decides", page)
    cells = ["".join(cell.itertext()) for cell in well_formed(page).iter("td")]
    assert float(cells[cells.index("all") + 1]) == pytest.approx(float(said), abs=0.06)


def test_the_least_gap_is_below_two_metres_with_the_probability_of_the_answer(naive_run):
    """Where the specification is gap >= 2.0, a least gap below 2 m is a violation."""
    gaps = weights_page.least_gaps(naive_run)
    below = np.searchsorted(gaps.gap_m, 2.0)
    estimate = naive_run.result.estimate
    assert 10.0 ** gaps.log10_probability[below - 1] == pytest.approx(
        estimate.probability, rel=1e-9
    )
    assert gaps.sampled[below - 1] == pytest.approx(estimate.failures / 60)
    assert gaps.sampled[-1] == pytest.approx(1.0)


def test_least_gaps_against_a_sum_over_rollouts(naive_run):
    gaps = weights_page.least_gaps(naive_run)
    least = naive_run.rollouts["gap_m"].min(axis=1)
    for place in (0, 10, 59):
        inside = least <= gaps.gap_m[place]
        total = math.fsum(np.exp(naive_run.log_weight[inside])) / 60
        assert gaps.log10_probability[place] == pytest.approx(math.log10(total), abs=1e-9)


def test_only_final_stages_tell_of_the_least_gap(loaded_run):
    gaps = weights_page.least_gaps(loaded_run)
    assert gaps.gap_m.size == loaded_run.config.final_rollouts
    assert loaded_run.kept > gaps.gap_m.size


def test_the_points_drawn_hold_those_that_carry_the_answer(loaded_run):
    share = shares(loaded_run)
    few = weights_page.drawn_points(loaded_run, most=20)
    assert few.size == 20
    heaviest = np.argsort(-share, kind="stable")[:10]
    assert set(heaviest.tolist()) <= set(few.tolist())
    robustness = loaded_run.rollouts["robustness"]
    assert robustness[few].max() == robustness.max()
    np.testing.assert_array_equal(weights_page.drawn_points(loaded_run), np.arange(loaded_run.kept))


def test_every_point_bears_the_number_of_its_rollout(loaded_run):
    drawn = weights_page.weights_page(loaded_run)
    numbers = re.findall(r"data-number='(\d+)'", drawn)
    assert sorted(map(int, numbers)) == list(range(loaded_run.kept))
    assert drawn.count("data-target='point'") == 2  # those that violate, and the others


def test_the_gaps_drawn_are_those_of_the_heaviest(loaded_run):
    _, line, *_ = weights_page.heaviest_chart(loaded_run).marks
    heaviest = int(np.argmax(shares(loaded_run)))
    np.testing.assert_array_equal(line.y, loaded_run.rollouts["gap_m"][heaviest])
    assert weights_page.heaviest_chart(replace(loaded_run, running=True)) is None


def test_every_refit_and_model_class_has_a_mark(naive_run):
    interval = replace(naive_run.result.pem_interval, log10_answers=(-9.0, -8.5, None, -3.0))
    model_class = ModelClassAnswer("lr", 1e-6, -6.0, 0.1, effective_failures=2.0)
    result = replace(naive_run.result, pem_interval=interval, model_classes=(model_class,))
    _, refits, other, *_ = models_chart(result).rows
    assert [math.log10(value) for value in refits.values] == pytest.approx([-9.0, -8.5, -3.0])
    assert (other.name, other.values) == ("lr (rough)", (1e-6,))
    assert "lr (rough)" in why_page.why(with_result(naive_run, model_classes=(model_class,)))
    assert models_chart(replace(result, model_classes=(), pem_interval=None)) is None


def test_a_run_keeps_the_answers_of_its_refits(naive_run):
    interval = naive_run.result.pem_interval
    answers = interval.log10_answers
    assert len(answers) == interval.members
    assert list(answers) == sorted(answers)
    # the interval that is told interpolates between them
    assert answers[0] <= math.log10(interval.low) <= answers[1]
    assert answers[-2] <= math.log10(interval.high) <= answers[-1]


def test_runs_side_by_side_show_every_setting_that_differs(live_run, naive_run):
    rules = {"near": "gap > 2"}
    other = replace(live_run.config.with_rules(rules), position_errors="pointrcnn")
    third = replace(naive_run, result=replace(naive_run.result, config=other))
    runs = [naive_run, live_run, third]
    settings, estimates = well_formed(compare_page.runs_page(runs)).iter("table")
    cells = {row[0].text: [cell.text for cell in row[1:]] for row in settings.iter("tr")}
    assert cells["method"] == ["naive", "adaptive", "adaptive"]
    assert cells["final_rollouts"] == ["60", "40", "40"]
    assert cells["rules.near"] == ["–", "–", "gap > 2"]
    assert cells["position_errors"] == ["–", "–", "pointrcnn"]
    assert not {"seed", "alpha"} & cells.keys()
    assert len(list(estimates.iter("tr"))) == 4
    names = [line.label for line in compare_page.proposals_chart(runs).marks]
    assert names.count("error model ml-nn") == 1
    assert compare_page.proposals_chart(runs[:1]) is None
    assert "2 to 6 runs" in compare_page.runs_page(runs[:1])


def test_proposals_drawn_are_the_first_the_newest_and_some_between(loaded_run):
    names = [line.label for line in learning_page.proposal_chart(loaded_run).marks]
    assert names[0] == f"proposal after stage {loaded_run.final_curves[-1].stage}"
    assert names[-1] == "error model (ml-nn)"
    many = replace(
        loaded_run, curves=tuple(replace(loaded_run.curves[0], stage=s) for s in range(40))
    )
    stages = [
        line.label.rsplit(" ", 1)[-1] for line in learning_page.proposal_chart(many).marks[:-1]
    ]
    assert len(stages) == 6
    assert (stages[0], stages[-1]) == ("39", "0")


def test_counts_are_whole_numbers_however_large(naive_run):
    large = {"rollouts_in_estimate": 1_000_000, "rollouts_simulated": 12_000_000, "failures": 3}
    run = with_result(naive_run, estimate=replace(naive_run.result.estimate, **large))
    shown = sections_html(run_document(run.result).choose(("answer",)))
    assert "3 of 1000000 rollouts" in shown
    assert "12000000 simulated" in shown


def test_the_answer_is_judged_by_a_target(naive_run):
    def judged(run, target):
        return strip(with_result(run, config=replace(run.config, target=target)))

    assert "target" not in strip(naive_run)
    assert "target 1e-300: " in judged(naive_run, 1e-300)
    assert "passed" not in judged(naive_run, 1e-300)
    estimate = replace(naive_run.result.estimate, diagnostics=(), ci_high=1e-6)
    run = with_result(naive_run, estimate=estimate, reference=None)
    assert "target 1e-05: passed" in judged(run, 1e-5)
    assert "target 1e-07: tripped" in judged(run, 1e-7)
