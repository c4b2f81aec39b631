"""Bursts in words: the same figures in every view."""

from dataclasses import replace

from pemviz.analysis.causes import BandMisses, Bursts, Spread
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity, MemorySensitivity
from pemviz.config import ExperimentConfig
from pemviz.recording.text import answer_text
from pemviz.reports.causes_words import burst_lines, burst_table, elasticity_text
from pemviz.reports.html import sections_html
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import run_document
from tests.reports.runs import result

BURSTS = Bursts(
    dt_s=0.05,
    count=1.1,
    misses=16.3,
    frames=Spread(15.0, 10.0, 23.0),
    begins_s=Spread(2.05, 1.6, 2.55),
    begins_gap_m=Spread(9.0, 7.06, 11.44),
    start=0.0026,
    again=0.78,
    whole=4.7e-10,
)
EXPLANATION = Explanation(
    repetition=0,
    misses_by_distance=(BandMisses(8.0, 10.0, 4.06, 1.0),),
    miss_probability_by_step=(),
    chains=(),
    sensitivity=(BandSensitivity(None, None, 1.08, 0.024, 900.0, None, 0.011),) * 2,
    memory=MemorySensitivity(0.2, 1.94, 0.0671, 250.0, None, 0.03),
    bursts=BURSTS,
)
LENGTH = "0.75 s (15 frames; four of five violations: 10 to 23)"
BEGINS = "at 9.0 (7.1 to 11.4) m, 2.05 (1.60 to 2.55) s after the start"


def test_a_sentence_each_on_bursts_and_on_what_would_help():
    bursts, help_ = burst_lines(EXPLANATION)
    assert bursts == (
        "Bursts (misses in a row) in a violation: 1.1; the decisive one: 15 frames (0.75 s) from "
        "9.0 m on, probability 4.7e-10"
    )
    assert help_ == (
        "A memory 1 % shorter would bring 1.9 +- 0.03 % fewer violations; 1 % fewer misses, the "
        "memory as it is, 1.1 +- 0.01 % fewer violations"
    )
    independent = replace(EXPLANATION, memory=None)
    assert burst_lines(independent) == [bursts]
    assert burst_lines(replace(independent, bursts=None)) == []
    hardly = replace(EXPLANATION, memory=replace(EXPLANATION.memory, elasticity=-3e-18))
    assert "shorter would bring hardly any fewer violations" in burst_lines(hardly)[1]
    assert elasticity_text(hardly.memory) == "0.00 +- 0.03"


def test_every_view_has_the_rows():
    rows = burst_table(EXPLANATION, target=1e-4).rows
    assert dict(rows)["memory time for 0.0001"] == "0.067 s instead of 0.2 s"
    run = result(explanation=EXPLANATION, config=ExperimentConfig(memory_s=0.2, target=1e-4))
    page, recorded = summary_markdown(run), answer_text(run, running=False)
    panel = sections_html(run_document(run).choose(["causes"]))
    for name, words in rows:
        assert f"| {name} | {words} |" in page
        assert f"| {name} | {words} |" in recorded
        assert f">{name}</td>" in panel
        assert f">{words}</td>" in panel


def test_requirements_in_words():
    def told(**changes):
        changed = replace(EXPLANATION, memory=replace(EXPLANATION.memory, **changes))
        return burst_table(changed, target=1e-4).rows[-1][1]

    assert told(target_tau_s=None) == "not enough alone"
    assert told(target_tau_s=0.2) == "met already"
    assert told(warning="few") == "0.067 s instead of 0.2 s (extrapolated)"
    one = replace(EXPLANATION, bursts=replace(BURSTS, again=None, begins_gap_m=None))
    rows = dict(burst_table(one, target=None).rows)
    assert rows["how likely that is"] == "starting it has a probability of 0.0026"
    assert rows["it begins"] == "2.05 (1.60 to 2.55) s after the start"
