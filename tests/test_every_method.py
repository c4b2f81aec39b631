"""Every method in every report, in a recording and on every page of the panel."""

import contextlib
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from pemviz.cli.main import main
from pemviz.panel import compare_page, learning_page, weights_page, why_page
from pemviz.panel.loading import load_run
from pemviz.panel.ranking import rank
from pemviz.panel.run_data import RunData
from pemviz.panel.run_summary import summary
from pemviz.sampling.registry import SHIPPED
from tests.recording.read_back import read_stages

EVERY = pytest.mark.parametrize("method", SHIPPED, ids=lambda method: method.name)
CONFIG = """
pem = "ml-nn"
spec = "always[0,59] (gap >= 6.0)"
stages = 2
rollouts = 40
final_rollouts = 60
measured_memory = false
epochs = 50
seed = 3
[scenario]
states = 60
"""


@dataclass(frozen=True)
class Shown:
    """What a run told in each place."""

    terminal: str
    page: str
    tests: str
    folder: Path
    loaded: RunData


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Method to what a run of it told, run once."""

    @cache
    def run(name):
        folder = tmp_path_factory.mktemp(name)
        (folder / "config.toml").write_text(CONFIG, encoding="utf-8")
        out = io.StringIO()
        words = ["record", "--verbose", "--config", str(folder / "config.toml"), "--method", name]
        words += ["--out", str(folder / "runs"), "--summary", str(folder / "page.md")]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
            assert main([*words, "--junit", str(folder / "tests.xml")]) == 0
        (kept,) = (folder / "runs").iterdir()
        return Shown(
            terminal=out.getvalue(),
            page=(folder / "page.md").read_text(encoding="utf-8"),
            tests=(folder / "tests.xml").read_text(encoding="utf-8"),
            folder=kept,
            loaded=load_run(kept),
        )

    return run


@EVERY
def test_reports_speak_of_weights_where_the_answer_rests_on_them(method, shown):
    for text in (shown(method.name).terminal, shown(method.name).page):
        assert method.name in text
        for words in ("effective sample size", "Pareto k-hat", "largest weight's share"):
            assert (words in text) == method.rests_on_weights, words


@EVERY
def test_a_pipelines_test_case_names_the_method(method, shown):
    properties = ET.fromstring(shown(method.name).tests).iter("property")  # noqa: S314  our own
    assert ("method", method.name) in {(p.get("name"), p.get("value")) for p in properties}


@EVERY
def test_the_page_gives_the_methods_budget(method, shown):
    run = shown(method.name)
    (row,) = re.findall(r"^\| budget \| (.*) \|$", run.page, flags=re.MULTILINE)
    assert row.startswith(method.budget(run.loaded.config).words)


@EVERY
def test_a_recording_holds_every_stage(method, shown):
    run = shown(method.name)
    stages = [stage.stage for stage in run.loaded.result.stages]
    assert sorted(read_stages(run.folder / "run.rrd")) == stages


@EVERY
def test_every_page_of_the_panel_fits_the_method(method, shown):
    run = shown(method.name).loaded
    learned, explained = learning_page.learning(run), why_page.why(run)
    assert rank(run, "classical").order.size == run.kept
    for page in (
        learned, explained,
        compare_page.metrics_page(run), compare_page.runs_page([run, run]),
        weights_page.weights_page(run),
    ):  # fmt: skip
        ET.fromstring(f"<all>{page.replace('<br>', '<br/>')}</all>")  # noqa: S314  our own
    assert summary(run.result)["method"] == method.name
    assert ("Threshold" in learned) == (method.stages == "learning")
    assert ("a run alone" in learned) == (method.stages == "runs")
    assert ("a stage alone" in learned) == (method.stages == "learning")
    names = [mark.label for mark in learning_page.proposal_chart(run).marks]
    assert any(name.startswith("proposal after stage") for name in names) == (
        not method.follows_model and method.curve_name is None
    )
    assert method.learning_words.split(".")[0] in learned
    violated = run.result.estimate.failures > 0
    assert ("Pareto k-hat" in explained) == (method.rests_on_weights and violated)
    assert ("carry no weights" in explained) == (not method.has_likelihood_ratios)
