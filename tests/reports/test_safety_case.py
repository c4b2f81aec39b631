"""The page for a safety case: what it claims, that it holds nothing but itself, and is whole."""

import re
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.latents import LatentCounts
from pemviz.reports.case_runs import CaseRun, read_case_run, run_folders
from pemviz.reports.safety_case import MOST_IN_FULL, claim_sentence, claims, safety_case_page
from pemviz.runs.reading import read_result
from pemviz.runs.result import OwnSystem, PemInfo, RunMemory
from pemviz.runs.result_file import write_result
from pemviz.sampling.bursts.curve import CurvePoint
from tests.reports.runs import PLAN, estimate, nasty_result, result, warned
from tests.runs.test_uncertainty import MODEL_CLASSES

SECTIONS = (
    "Claim",
    "Argument",
    "Evidence",
    "Assumptions",
    "What to measure next",
    "Data and model",
)
LOADS = re.compile(r"""(src|href|xlink:href|action|data|poster|srcset)\s*=\s*["'](?!#)""", re.I)
"""Attributes that make a browser fetch something, but for links within the page."""


def sound(one=None, **changes):
    """A result that nothing speaks against."""
    return result(one or estimate(method="mixture"), reference=None, **changes)


def case(one, *, name="run-1"):
    return CaseRun(name=name, result=one, card=None, digests={}, violations=None)


def page_of(*results, below=None):
    runs = [case(one, name=f"run-{index}") for index, one in enumerate(results, start=1)]
    return safety_case_page(runs, below=below)


def well_formed(page):
    """The page as a tree; HTML's unclosed elements closed first."""
    body = re.sub(r"<(meta|br)([^>]*)>", r"<\1\2/>", page.removeprefix("<!DOCTYPE html>"))
    return ET.fromstring(body)  # noqa: S314  our own


def verdicts(one, *, below):
    return {claim.kind: claim.verdict for claim in claims(one, below=below)}


def test_a_claim_is_judged_by_every_source():
    curve = tuple(
        CurvePoint(tau_s=tau_s, probability=p, low=0.9 * p, high=1.1 * p, ess=99.0)
        for tau_s, p in ((0.0, 2e-15), (1.0, 1e-3))
    )
    one = sound(model_classes=MODEL_CLASSES, memory=RunMemory(tau_s=0.0, curve=curve))
    assert verdicts(one, below=1e-9) == {
        "sampling": "shown", "refits": "shown", "model-classes": "not shown", "memory": "not shown",
        "data": "not shown",
    }  # fmt: skip
    assert verdicts(one, below=0.01)["data"] == "shown"
    assert verdicts(replace(one, memory=None), below=0.01)["memory"] == "not known"
    sentence = claim_sentence(one, below=1e-9)
    assert "Shown if the error model ml-nn and the simulation are right" in sentence
    assert "Not shown if any of the other shipped kinds" in sentence


def test_an_unreliable_estimate_shows_nothing():
    doubted = warned("one rollout carries 51% of the weight", kind="large-weight", value=0.51)
    one = sound(estimate(method="mixture", diagnostics=(doubted,)), model_classes=MODEL_CLASSES)
    found = verdicts(one, below=0.5)
    assert {found[kind] for kind in ("sampling", "refits", "model-classes")} == {"not known"}
    assert found["data"] == "shown"
    assert "Do not quote it" in page_of(one)
    assert verdicts(sound(estimate(method="adaptive")), below=0.5)["sampling"] == "not known"


def test_no_bound_is_claimed_of_rollouts_that_the_page_says_not_to_quote():
    doubted = warned("one rollout carries 51% of the weight", kind="large-weight", value=0.51)
    one = sound(estimate(method="mixture", diagnostics=(doubted,)), data_bound=None)
    assert [claim.bound for claim in claims(one, below=None)] == [None] * len(
        claims(one, below=None)
    )
    sentence = claim_sentence(one, below=None)
    assert sentence.startswith("No upper bound is known: one rollout carries 51%")
    assert not re.search(r"probability below [0-9]", page_of(one))


def test_without_a_claim_the_page_says_what_holds_under_the_least():
    sentence = claim_sentence(sound(model_classes=MODEL_CLASSES), below=None)
    assert "below 0.0042, if of the model no more is granted" in sentence


def test_every_section_has_its_content_and_the_page_is_well_formed():
    page = page_of(result(model_classes=MODEL_CLASSES, plan=PLAN), below=1e-9)
    tree = well_formed(page)
    text = "".join(tree.itertext())
    for section in SECTIONS:
        assert section in text
    for words in ("8.0e-16 to 5.0e-15", "label 1,249 more at 5 to 7 m", "ab" * 32, "pemviz 0.1.0"):
        assert words in text
    assert sum(element.tag.endswith("svg") for element in tree.iter()) >= 4
    assert all(len(list(table.iter("td"))) for table in tree.iter("table"))
    assert all(len("".join(item.itertext()).strip()) for item in tree.iter("li"))


def test_how_to_have_the_figures_again_is_a_command_only_where_one_does():
    """A simulator that a program put in place of the configuration's is had by that program."""
    own = OwnSystem(name="cart", states=31, dt_s=0.1, code="carts.Cart")
    registered = ExperimentConfig(simulator="cart")
    for one, by_command in (
        (sound(), True),
        (sound(simulator=own), False),
        (sound(simulator=own, config=registered), True),
    ):
        page = page_of(one)
        assert ("pemviz record --config config.toml" in page) == by_command
        assert (
            "run the program that put simulator cart (carts.Cart) together" in page
        ) != by_command


def test_a_model_that_python_names_is_allowed_in_the_command():
    page = page_of(sound(config=ExperimentConfig(simulator="cart", pem="carts:CAMERA")))
    assert "pemviz record --config config.toml --allow-python" in page


def test_what_is_random_beside_perception_is_said():
    deterministic = "Everything but perception is deterministic in it"
    assert deterministic in page_of(sound())
    page = page_of(sound(latents=LatentCounts(seeds=1)))
    assert deterministic not in page
    assert "Random in it beside perception: 1 for seeds (assumptions below)." in page


def test_a_model_without_data_is_not_said_to_have_learned():
    stated = PemInfo(name="Camera", digest="ab", data="data that it does not name (a model)")
    page = page_of(sound(pem=stated))
    assert "given what it looks at, stated. How far" in page
    assert "learned from data that it does not name" not in page


def test_the_page_holds_nothing_but_itself():
    """No element or style fetches anything, no script stands there, and a policy forbids both."""
    page = page_of(result(model_classes=MODEL_CLASSES, plan=PLAN), nasty_result(), below=1e-9)
    assert "default-src 'none'" in page
    assert LOADS.findall(page) == []
    tree = well_formed(page)
    names = {element.tag for element in tree.iter()}
    assert not names & {"script", "link", "img", "iframe", "object", "embed", "base", "form"}
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    assert not [a for e in tree.iter() for a in e.attrib if a.lower().startswith("on")]


def test_what_strangers_wrote_is_text():
    page = page_of(nasty_result(), below=1e-9)
    well_formed(page)
    assert "<script>alert" not in page
    assert "alert(1)" in page
    assert "\x1b" not in page


@pytest.mark.parametrize("status", ["stopped", "failed"])
def test_a_run_without_an_estimate_claims_nothing(status):
    one = result(
        None, estimate=None, repetitions=0, status=status, pem_interval=None, data_bound=None,
        reference=None, least_robust=(),
    )  # fmt: skip
    page = page_of(one, below=1e-9)
    well_formed(page)
    assert "nothing can be claimed" in page


def test_several_runs_stand_side_by_side():
    other = result(
        estimate(probability=3e-12, ci_low=1e-12, ci_high=8e-12),
        config=ExperimentConfig(seed=7), model_classes=MODEL_CLASSES,
    )  # fmt: skip
    page = page_of(result(model_classes=MODEL_CLASSES), other, below=1e-9)
    text = "".join(well_formed(page).itertext())
    assert "Claims of less than 1e-09" in text
    assert "Run 2: run-2" in text
    assert "seed07" in text  # the setting that differs, and its values
    many = page_of(*[result()] * (MOST_IN_FULL + 2))
    assert "The other 2 runs stand in the table above only." in many
    assert "The runs have the same settings." in many


def test_the_sample_run_and_a_sweep_become_pages(tmp_path, capsys):
    out, sweep = tmp_path / "report.html", tmp_path / "sweep"
    assert main(["report", str(sample_run()), "--out", str(out), "--claim-below", "1e-9"]) == 0
    text = "".join(well_formed(out.read_text(encoding="utf-8")).itertext())
    assert "Gap in the likeliest violations" in text
    assert "result.json (SHA-256)" in text
    assert "37,498 training obstacles" in text
    shutil.copytree(sample_run(), sweep / "runs" / "a")
    shutil.copytree(sample_run(), sweep / "runs" / "b")
    assert main(["report", str(sweep), "--out", str(out)]) == 0
    assert "2 runs" in out.read_text(encoding="utf-8")
    assert "report: " in capsys.readouterr().out


def test_a_card_of_another_model_is_not_shown(tmp_path):
    shutil.copytree(sample_run(), tmp_path / "run")
    one = read_result(tmp_path / "run")
    assert read_case_run(tmp_path / "run").card is not None
    write_result(tmp_path / "run", replace(one, pem=replace(one.pem, digest="00" * 32)))
    assert read_case_run(tmp_path / "run").card is None


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "name at least one run folder"),
        (["nowhere"], "run nowhere: there is no such folder"),
        (["{sample}", "{sample}"], "is named twice"),
        (["{sample}", "--claim-below", "0"], "claim-below = 0.0: must be a number, above 0"),
        (["{sample}", "--out", "{tmp}"], "must be a file, is a folder"),
        (["{sample}", "--out", "{tmp}/no/x.html"], "must lie in a folder that exists"),
        (["{tmp}"], "cannot be read"),
        (["{tmp}/damaged"], "do not"),
        (["{sample}", "--nonsense"], "Unrecognized options: --nonsense"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(words, complaint, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sample_run(), tmp_path / "damaged")
    (tmp_path / "damaged" / "rollouts.npz").write_bytes(b"PK\x03\x04 no archive")
    named = [word.format(sample=sample_run(), tmp=tmp_path) for word in words]
    assert main(["report", *named]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert complaint in told or "cannot be read" in told
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


def test_a_page_that_cannot_be_made_leaves_the_old_one(tmp_path, monkeypatch):
    out = tmp_path / "report.html"
    out.write_text("old")
    monkeypatch.setattr("pathlib.Path.replace", _refuse)
    assert main(["report", str(sample_run()), "--out", str(out)]) == 2
    assert out.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def _refuse(*_):
    raise OSError(28, "No space left on device")


def test_a_sweep_without_runs_is_named(tmp_path):
    (tmp_path / "runs").mkdir()
    with pytest.raises(InputError, match="holds no run"):
        run_folders([tmp_path])
