"""Views: the right figures, units, and nothing of a stranger's text taken for markup."""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from pemviz.analysis.causes import BandMisses, Chain
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.charts.svg import Axis, Plot, nice_ticks
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.panel import (
    compare_tab,
    experiment_tab,
    headline,
    learning_tab,
    recordings_tab,
    weights_tab,
    why_tab,
)
from pemviz.panel.controller import PanelState, Progress
from pemviz.panel.experiment_controls import field_docs, hint, limits
from pemviz.panel.page import number
from pemviz.panel.ranking import rank, row
from pemviz.panel.rollout_player import track, track_plots, with_cursor
from pemviz.panel.run_data import RunData
from pemviz.panel.scene import brakes
from pemviz.panel.trajectories_tab import ranking_table
from pemviz.reports.estimate_words import short_probability
from pemviz.runs.drawn_rollout import RIGHT
from pemviz.runs.result import PemInfo
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Diagnostic
from tests.reports.runs import PLAN

CRAFTED = "<script>alert(1)</script>"


def well_formed(fragment: str) -> ET.Element:
    return ET.fromstring(f"<all>{fragment.replace('<br>', '<br/>')}</all>")  # noqa: S314  our own


def test_every_page_is_well_formed(live_run, loaded_run, naive_run):
    for run in (live_run, loaded_run, naive_run):
        for page in (
            headline.headline(run),
            learning_tab.learning(run),
            why_tab.why(run),
            compare_tab.metrics_page(run),
            compare_tab.runs_page([run, live_run, naive_run]),
            weights_tab.weights_page(run, target="x", selected=3),
            ranking_table(run, rank(run, "classical"), selected=0, target="x"),
        ):
            well_formed(page)


def test_pages_without_a_run_say_so():
    assert "Nothing has run yet" in headline.headline(None)
    assert "Nothing has run yet" in learning_tab.learning(None)
    assert "Nothing has run yet" in why_tab.why(None)
    assert "No rollouts yet" in compare_tab.metrics_page(None)


def test_a_metric_that_cannot_score_the_rollouts_is_told_and_the_others_stay(naive_run):
    scenario = replace(naive_run.config.scenario, gap_bound_m=10.0)
    run = with_result(naive_run, config=replace(naive_run.config, scenario=scenario))
    page = well_formed(compare_tab.metrics_page(run))
    (alert,) = [words for words in page.itertext() if "left out" in words]
    assert "agm is left out: metric = 'agm': gap reaches" in alert
    assert [header.text for header in page.iter("th")][1:] == ["classical", "smooth-cumulative"]
    curves = compare_tab.metric_curves(run)
    assert [line.name for line in curves.lines if "," in line.name] == [
        "classical, gap [m]", "smooth-cumulative, gap [m]",
    ]  # fmt: skip


def test_rollouts_that_latents_carry_beyond_agms_bounds_are_ranked_all_the_same(naive_run):
    """As if they had stayed at the bound; without latents a gap beyond it is no such run's."""
    table = dict(naive_run.rollouts)
    safe = int(np.argmax(table["gap_m"].min(axis=1)))
    for name, gap_m in (("kept", 25.0), ("left", 25.2)):
        table[name] = np.array(table["gap_m"])
        table[name][safe, 3] = gap_m
    drawn = {"latents.start": np.zeros((60, 1)), "latents.start_mean": np.zeros((60, 1))}
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
    text = headline.headline(naive_run)
    estimate = naive_run.result.estimate
    assert f"Failure probability {short_probability(estimate)}<" in text
    assert "in one run, if error model ml-nn is right.<" in text
    assert f"{estimate.failures} of 60" in text
    scenario = replace(naive_run.config.scenario, tracker="2/3,coast=0.5")
    config = replace(naive_run.config, memory_s=0.2, frailty=0.7, scenario=scenario)
    errors = PemInfo(name="pointrcnn", digest="", data="")
    asked = headline.headline(with_result(naive_run, config=config, position_errors=errors))
    assert (
        "right; with memory time 0.2 s, frailty 0.7, tracker 2/3,coast=0.5, "
        "position errors pointrcnn.<"
    ) in asked


def test_headline_and_why_tell_of_a_disagreement_with_the_reference(naive_run):
    estimate = replace(naive_run.result.estimate, diagnostics=())
    known = Reference(0.01 * estimate.probability, 0.0, math.log10(0.01 * estimate.probability))
    run = with_result(naive_run, estimate=estimate, reference=known)
    for page in (headline.headline(run), why_tab.why(run)):
        assert "1e+02 times the reference" in page
        assert "trust the reference" in page


def test_headline_never_gives_a_bare_zero(naive_run):
    nothing = replace(naive_run.result.estimate, failures=0, probability=0.0, ci_high=0.03)
    text = headline.headline(with_result(naive_run, estimate=nothing))
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
    entry = recordings_tab.RunEntry(
        CRAFTED, CRAFTED, CRAFTED, CRAFTED, 0, 0.1, (CRAFTED,), has_recording=False, notes=CRAFTED
    )
    for page in (
        headline.headline(run),
        learning_tab.learning(run),
        why_tab.why(run),
        compare_tab.runs_page([run, naive_run]),
        weights_tab.weights_page(run, target="x", selected=0),
        compare_tab.metrics_page(
            with_result(run, config=replace(run.config, spec=whole.config.spec))
        ),
        recordings_tab.recordings_table([entry], folder=CRAFTED),
        recordings_tab.delete_question(CRAFTED),
        recordings_tab.viewer_link("http://127.0.0.1:1/", name=CRAFTED),
        headline.status(PanelState(error=CRAFTED)),
        experiment_tab.verdict([CRAFTED]),
    ):
        assert "<script" not in page
        well_formed(page)


def test_status_tells_stage_rollouts_and_time_left():
    progress = Progress(0, 1, 4, 12, 500, 1200, 10.0)
    text = headline.status(PanelState(running=True, progress=progress))
    assert "Stage 4 of 11: 500 of 1,200 rollouts, about 14 s left" in text
    levels = headline.status(PanelState(running=True, progress=replace(progress, by_level=True)))
    assert "Stage 4 of 11: 42% of the way to violations, about 14 s left" in levels
    assert "Stopping" in headline.status(PanelState(running=True, stopping=True))
    assert "Ready" in headline.status(PanelState())
    assert "gap is no signal" in headline.status(PanelState(error="gap is no signal"))


def test_everything_that_is_wrong_with_what_was_typed_is_told():
    text = experiment_tab.verdict(["column 21: a number is missing", "target = 'x': must be"])
    assert text.index("column 21") < text.index("target = ")
    assert "understood" not in text
    assert "understood" in experiment_tab.verdict([])


def test_every_control_has_a_hint_with_what_the_field_says():
    docs = field_docs(ExperimentConfig)
    for name in (
        "method", "metric", "alpha", "sigma", "stages", "rollouts", "final_rollouts", "seed",
        "pem", "simulator", "reference", "spec",
    ):  # fmt: skip
        assert len(hint(name)) > 20
        assert hint(name) == docs[name]
    assert limits("alpha", step=0.01) == (0.0, 1.0)
    low, high = limits("sigma", step=0.005)
    assert low == 0.95
    assert high == pytest.approx(0.995)
    with pytest.raises(ValueError, match="declares no bounds"):
        limits("spec", step=1)


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
    page = why_tab.why(run)
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
        text = learning_tab.learning_words(run) + learning_tab.learning(run)
        well_formed(text)
        return text + " ".join(line.name for line in learning_tab.proposal_curves(run).lines)

    assert "older stages fade" in page("adaptive")
    for method in ("splitting", "monte-carlo", "naive", "zero-variance"):
        assert "proposal after stage" not in page(method)
        assert "a stage alone" not in page(method)
    assert "cut and continued" in page("splitting")
    assert "Threshold" not in page("splitting")
    assert "optimal proposal" in page("zero-variance")


def test_without_a_violation_the_upper_bound_is_drawn(naive_run):
    nothing = replace(
        naive_run.result.estimate, failures=0, probability=0.0, ci_low=0.0, ci_high=0.03
    )
    run = with_result(naive_run, reference=None, estimate=nothing)
    assert "95 % upper bound" in learning_tab.learning(run)


def test_track_holds_the_rollout_its_limits_and_its_probabilities(naive_run):
    entry = row(naive_run, rank(naive_run, "classical"), 0)
    chosen = track(naive_run, entry)
    np.testing.assert_array_equal(chosen.values, naive_run.rollouts["gap_m"][entry.index])
    assert chosen.limits == (2.0,)
    pem, proposal = chosen.detection
    np.testing.assert_allclose(proposal, 0.5, rtol=1e-12)
    assert np.all((pem > 0.5) & (pem < 1.0))
    step = chosen.interesting_step
    assert chosen.values[step] < 2.0
    assert np.all(chosen.values[:step] >= 2.0)
    np.testing.assert_array_equal(
        chosen.drawn.answers[:, 0] == RIGHT, naive_run.rollouts["detected"][entry.index]
    )


def test_cursor_stands_at_its_step(naive_run):
    chosen = track(naive_run, row(naive_run, rank(naive_run, "classical"), 0))
    pieces = track_plots(chosen)
    for step in (0, chosen.drawn.contact_step - 1, chosen.drawn.contact_step, 99):
        page = with_cursor(pieces, chosen, step, speed=1.0)
        well_formed(page)
        assert f"data-cursor='{step}'" in page
        assert f"{chosen.values[step]:.2f} m at {step * 0.05:.2f} s" in page
        assert ("after contact" in page) == (step >= chosen.drawn.contact_step)


def test_ranking_table_marks_the_selected_row(naive_run):
    page = ranking_table(naive_run, rank(naive_run, "classical"), selected=30, target="abc")
    rows = [r for r in well_formed(page).iter("tr") if r.get("data-rank")]
    assert [r.get("data-rank") for r in rows if r.get("aria-selected") == "true"] == ["31"]
    assert len(rows) == 12
    for selected, count, first in ((59, 60, "49"), (3, 5, "1")):
        ranking = rank(naive_run, "classical")
        few = replace(ranking, order=ranking.order[:count])
        page = ranking_table(naive_run, few, selected=selected, target="abc")
        assert page.index("data-rank=") == page.index(f"data-rank='{first}'")


def test_a_full_overlap_is_a_hundred_per_cent():
    one, two = np.array([True, True, False]), np.array([True, False, True])
    assert compare_tab.overlap_text(one, one) == "2 (100 %)"
    assert compare_tab.overlap_text(one, two) == "1 (33 %)"
    assert compare_tab.overlap_text(~(one | two), ~(one | two)) == "0"


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
    page = why_tab.why(naive_run)
    (said,) = re.findall(r"takes ([\d.]+) misses where perception decides", page)
    cells = ["".join(cell.itertext()) for cell in well_formed(page).iter("td")]
    assert float(cells[cells.index("all") + 1]) == pytest.approx(float(said), abs=0.06)
