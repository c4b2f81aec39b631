"""The reference beside the answer, wherever results are told in words."""

from pathlib import Path

import pytest

from pemviz.reports.estimate_words import reference_text
from pemviz.reports.gate import decide_run
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.terminal import print_summary, summary_text
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sampling.zero_variance.reference import Reference
from tests.reports.runs import estimate, result

AGREEING = Reference(probability=2.1e-15, std_error=1e-18, log10_probability=-14.678)
FAR = Reference(probability=8e-14, std_error=2e-17, log10_probability=-13.097)


def terminal(one, capsys):
    print_summary(one, Path("run"))
    return " ".join(capsys.readouterr().out.split())


def beside(known):
    """A finished run as the engine leaves it: the diagnostics' words among the warnings."""
    answer = estimate(method="mixture")
    one = result(answer, reference=known, warnings=())
    return result(
        answer,
        reference=known,
        warnings=tuple(diagnostic.text for diagnostic in run_diagnostics(one)),
    )


def test_the_reference_and_the_ratio_to_it():
    assert reference_text(FAR, estimate()) == "8e-14 +- 2e-17; the estimate is 0.025 times that"
    nothing = Reference(probability=0.0, std_error=0.0, log10_probability=None)
    assert reference_text(nothing, estimate()) == "0 +- 0"


@pytest.mark.parametrize("known", [AGREEING, FAR])
def test_every_report_shows_the_reference(known, capsys):
    one, words = beside(known), reference_text(known, estimate())
    assert f"reference {words}" in summary_text(one)
    assert words in summary_markdown(one).replace("\\", "")
    shown = terminal(one, capsys)
    assert f"{known.probability:.4g} +- {known.std_error:.1g}" in shown


def test_every_report_tells_of_a_disagreement_and_the_gate_cannot_be_decided(capsys):
    one = beside(FAR)
    words = "0.025 times the reference 8e-14"
    for text in (summary_text(one), terminal(one, capsys), summary_markdown(one)):
        assert words in text
        assert "trust the reference" in text
    decision = decide_run(one, limit=1e-10)
    assert (decision.outcome, decision.exit_code) == ("undecided", 4)
    assert words in decision.reason
    agreeing = beside(AGREEING)
    assert "trust the reference" not in summary_text(agreeing)
    assert decide_run(agreeing, limit=1e-10).outcome == "passed"
