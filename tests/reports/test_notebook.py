"""What a notebook shows of a result: the answer and its doubts, and what others wrote escaped."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pemviz import figures
from pemviz.analysis.causes import BandMisses
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.colors import MISSED, PROPOSAL
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.runs.engine import run_experiment
from pemviz.runs.observers import KeptStages, Rollout
from pemviz.runs.result import RunMemory
from pemviz.sampling.bursts.curve import CurvePoint
from tests.reports.runs import EXPLANATION, NASTY, PLAN, estimate, nasty_result, result, warned


def tags(page):
    return set(re.findall(r"<\s*/?\s*([a-zA-Z!][a-zA-Z0-9]*)", page))


HARMLESS = {"div", "b", "svg", "g", "path", "rect", "line", "text", "tspan", "title", "circle",
            "details", "summary", "ul", "li", "clipPath", "style", "h3", "h4", "p", "figure",
            "figcaption",
            "code", "i"}  # fmt: skip


def test_a_result_shows_answer_interval_uncertainty_and_what_next():
    page = result(plan=PLAN)._repr_html_()
    for words in (
        "Failure probability in one run: 2.0e-15",
        "if error model ml-nn is right",
        "not a 95 % interval",
        "How far the answer is open",
        "refits of ml-nn",
        "label 1,249 more at 5 to 7 m",
        "no obstacle closer than 7 m",
    ):
        assert words in page
    assert tags(page) <= HARMLESS


def test_at_a_prompt_a_result_is_a_line():
    shown = repr(result(plan=PLAN))
    assert shown.startswith("RunResult(run_id=")
    assert f"probability={result().estimate.probability!r}" in shown
    assert "\n" not in shown
    assert len(shown) < 250
    assert "probability" not in repr(replace(result(), estimate=None))


def test_without_an_estimate_the_reason_is_shown():
    page = replace(result(), estimate=None, status="failed", message="the <b>disk</b> is full")
    shown = page._repr_html_()
    assert "No estimate: the run failed" in shown
    assert "the &lt;b&gt;disk&lt;/b&gt; is full" in shown


def test_nothing_that_others_wrote_becomes_markup():
    nasty = nasty_result()
    one = estimate(method=NASTY, diagnostics=(warned(NASTY),))
    rollout = Rollout(
        repetition=0, stage=1, robustness=-1.0, violated=True, nll=3.0,
        time_s=np.arange(3.0), signals={NASTY: np.array([1.0, 2.0, 0.5])},
        detected=np.array([True, False]),
    )  # fmt: skip
    for shown in (nasty, one, rollout, replace(nasty, estimate=None)):
        page = shown._repr_html_()
        assert tags(page) <= HARMLESS
        assert "<script" not in page


def test_a_rollout_marks_where_perception_missed():
    rollout = Rollout(
        repetition=0, stage=1, robustness=-1.0, violated=True, nll=3.0,
        time_s=np.arange(4.0), signals={"gap": np.array([9.0, 7.0, 4.0, 1.0])},
        detected=np.array([True, False, False]),
    )  # fmt: skip
    page = rollout._repr_html_()
    assert "misses 2 of 3 steps (1-2)" in page
    assert page.count(f"r='2.0' fill='{MISSED}'") == 2


def bars(axes):
    """Ends of horizontal lines, by row."""
    lines = [line for line in axes.lines if len(set(line.get_ydata())) == 1]
    return {round(float(line.get_ydata()[0])): line.get_xdata().tolist() for line in lines}


def test_the_uncertainty_budget_has_a_bar_from_end_to_end_for_each_doubt():
    figure = figures.uncertainty(result=result())
    (axes,) = figure.axes
    drawn = bars(axes)
    names = [label.get_text() for label in axes.get_yticklabels()]
    refits, data = (names.index(name) for name in names if name.startswith(("refits", "the tr")))
    assert drawn[refits] == [1e-17, 1e-13]
    assert drawn[data][1] == 0.0042
    assert figure._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="no estimate"):
        figures.uncertainty(result=replace(result(), estimate=None))


def test_causes_are_drawn_by_band_with_two_standard_errors():
    explanation = replace(
        EXPLANATION,
        misses_by_distance=(BandMisses(6.0, 8.0, 4.0, 0.5), BandMisses(8.0, 10.0, 3.0, 0.5)),
        sensitivity=tuple(
            BandSensitivity(None, None, elasticity, None, None, None, error)
            for elasticity, error in ((7.0, 0.1), (4.0, 0.25), (None, None))
        ),
    )
    misses, sensitivity = figures.causes(result=result(explanation=explanation)).axes
    assert [patch.get_height() for patch in misses.patches] == [4.0, 3.0]
    (bar,) = sensitivity.collections
    np.testing.assert_allclose(bar.get_segments()[0], [[7.0, 3.5], [7.0, 4.5]])
    with pytest.raises(InputError, match="causes"):
        figures.causes(result=replace(result(), explanation=None))


@pytest.mark.parametrize(
    ("draw", "points", "curve"),
    [
        (figures.memory_curve, [{"tau_s": 0.0}, {"tau_s": 0.2}], "curve"),
        (figures.frailty_curve, [{"frailty": 0.0}, {"frailty": 0.2}], "frailty_curve"),
    ],
)
def test_a_curve_is_drawn_through_its_points(draw, points, curve):
    told = tuple(
        CurvePoint(**{"tau_s": 0.0, **place}, probability=p, low=p / 2, high=2 * p, ess=50.0)
        for place, p in zip(points, (1e-9, 1e-4), strict=True)
    )
    figure = draw(result=result(memory=RunMemory(**{"tau_s": 0.0, curve: told})))
    line, *whiskers = (one for one in figure.axes[0].lines if one.get_color() == PROPOSAL)
    assert list(line.get_xdata()) == [0.0, 0.2]
    assert list(line.get_ydata()) == [1e-9, 1e-4]
    assert [list(w.get_ydata()) for w in whiskers] == [[5e-10, 2e-9], [5e-5, 2e-4]]
    with pytest.raises(InputError, match="memory_curve=True"):
        draw(result=result())


def test_rollouts_and_proposals_are_drawn_of_the_stages_that_were_kept():
    kept = KeptStages()
    config = ExperimentConfig(method="naive", final_rollouts=40, seed=2, measured_memory=False)
    run_experiment(config, observers=[kept])
    (stage,) = kept.stages
    (axes,) = figures.robustness_distribution(stages=kept.stages).axes
    counted = sum(patch.get_height() for patch in axes.patches)
    assert counted == 40
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[1] == f"violated ({stage.failures})"
    (axes,) = figures.proposal_curves(kept=kept).axes
    pem, proposal = axes.lines
    assert set(proposal.get_ydata()) == {0.5}
    assert pem.get_ydata().max() > 0.9
    for broken in (lambda: figures.proposal_curves(kept=KeptStages()),
                   lambda: figures.proposal_curves(kept=kept, repetition=1),
                   lambda: figures.robustness_distribution(stages=[])):  # fmt: skip
        with pytest.raises(InputError) as caught:
            broken()
        assert "\n" not in str(caught.value)
