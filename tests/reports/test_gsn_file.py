"""Arguments as data: valid by gsn2x's rules, and judged again when what they rest on changes."""

import shutil
from dataclasses import replace

import pytest
import yaml

from pemviz.cli.main import main
from pemviz.files.shipped import sample_run
from pemviz.reports.argument import TOP, Element, argument_of_runs, undeveloped
from pemviz.reports.argument_picture import argument_svg
from pemviz.reports.case_runs import CaseRun, read_case_run
from pemviz.reports.gsn_file import check_gsn, write_gsn
from tests.budgets import COUNTED, hazard, make_run, write_budget
from tests.gsn_rules import complaints, kind_of, load
from tests.reports.runs import estimate, nasty_result, result
from tests.reports.test_safety_case import well_formed
from tests.runs.test_uncertainty import MODEL_CLASSES

SAMPLING = "uncertainty = 'sampling'"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a run, a budget that is met by it, and both arguments."""
    folder = tmp_path_factory.mktemp("made")
    make_run(folder / "run", COUNTED)
    budget = write_budget(
        folder / "budget.toml", hazard(runs=("run",), extra=SAMPLING), hazard(name="other"),
        accepted=1.0,
    )  # fmt: skip
    argument = folder / "case.gsn.yaml"
    assert main(["report", "--budget", str(budget), "--gsn", str(argument)]) == 0
    return folder


@pytest.fixture
def case(made, tmp_path):
    """A copy that may be changed."""
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


def check(folder, *words):
    return main(["report", "--check", str(folder / "case.gsn.yaml"), *words])


def unchecked(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_checker_of_the_tests_finds_what_gsn2x_names():
    good = {"G1": {"text": "t", "supportedBy": ["S1"]}, "S1": {"text": "t", "undeveloped": True}}
    assert list(complaints(good)) == []
    broken = {
        "X1": "V01", "G2": "V02 G2", "C2": "C01",
    }  # fmt: skip
    for name, words in broken.items():
        assert any(words in one for one in complaints({**good, name: {"text": "t"}}))
    for change, words in (
        ({"undeveloped": True}, "V03"),
        ({"supportedBy": ["S1", "S1"]}, "V05"),
        ({"supportedBy": ["G1", "S1"]}, "V06"),
        ({"supportedBy": ["S1", "G9"]}, "C03"),
        ({"inContextOf": ["S1"]}, "V04"),
    ):
        assert any(words in one for one in complaints({**good, "G1": {**good["G1"], **change}}))
    circle = {"text": "t", "supportedBy": ["G1"]}
    assert any("C0" in one for one in complaints({"G1": {**good["G1"]}, "S1": circle}))


@pytest.mark.parametrize("below", [None, 1e-9, 0.9])
def test_the_argument_of_a_run_is_valid(below, tmp_path):
    path = tmp_path / "run.gsn.yaml"
    runs = [read_case_run(sample_run())]
    write_gsn(path, argument_of_runs(runs, below=below))
    document = load(path)
    assert list(complaints(document)) == []
    assert {kind_of(name) for name in document} >= {"Goal", "Strategy", "Context", "Assumption"}


def test_strangers_words_make_no_other_argument(tmp_path):
    path = tmp_path / "run.gsn.yaml"
    one = CaseRun("nasty", nasty_result(), None, {}, None, tmp_path)
    argument = argument_of_runs([one], below=1e-9)
    write_gsn(path, argument)
    assert list(complaints(load(path))) == []
    well_formed(argument_svg(argument, title="nasty"))


def test_a_claim_that_is_not_shown_is_an_undeveloped_goal(tmp_path):
    one = result(estimate(method="mixture"), reference=None, model_classes=MODEL_CLASSES)
    case = CaseRun("one", one, None, {"result.json": "ab" * 32}, None, tmp_path)
    found = {e.name: e for e in argument_of_runs([case], below=1e-9)}
    assert not found["G-run1-sampling"].undeveloped
    assert found["G-run1-sampling"].supported_by == ("Sn-run1-result",)
    assert found["G-run1-model-classes"].undeveloped
    assert found["G-run1-data"].undeveloped
    assert found[TOP].supported_by == ("S-run1",)


def test_several_runs_are_one_argument(tmp_path):
    runs = [replace(read_case_run(sample_run()), name=f"run {n}") for n in (1, 2)]
    path = tmp_path / "runs.gsn.yaml"
    write_gsn(path, argument_of_runs(runs, below=0.5))
    document = load(path)
    assert list(complaints(document)) == []
    assert document[TOP]["supportedBy"] == ["S-runs"]
    assert document["S-runs"]["supportedBy"] == ["G-run1", "G-run2"]


def test_a_budget_s_argument_is_valid_and_names_files_by_digest(case):
    document = load(case / "case.gsn.yaml")
    assert list(complaints(document)) == []
    assert document["S-hazards"]["supportedBy"] == ["G-sum", "G-h1", "G-h2"]
    assert document["Sn-run1-result"]["file"] == "run/result.json"
    assert len(document["Sn-run1-result"]["sha256"]) == 64
    assert "undeveloped" not in document["G-sum"]


def test_an_argument_that_holds_is_said_to_and_is_not_touched(case, capsys):
    before = (case / "case.gsn.yaml").read_bytes()
    assert check(case) == 0
    assert "every claim holds" in capsys.readouterr().out
    assert (case / "case.gsn.yaml").read_bytes() == before


def test_it_may_be_moved_with_what_it_names(case, tmp_path_factory):
    there = tmp_path_factory.mktemp("elsewhere") / "case"
    shutil.move(case, there)
    assert check(there) == 0


def test_a_claim_that_no_longer_holds_makes_its_goal_undeveloped(case, capsys):
    budget = case / "budget.toml"
    budget.write_text(budget.read_text().replace("_hour = 1.0", "_hour = 1e-9"))
    before = (case / "case.gsn.yaml").read_bytes()
    assert check(case) == 1
    assert "G-sum: no longer holds" in capsys.readouterr().out
    assert (case / "case.gsn.yaml").read_bytes() == before
    assert check(case, "--update") == 1
    document = load(case / "case.gsn.yaml")
    assert document["G-sum"]["undeveloped"] is True
    assert list(complaints(document)) == []
    assert check(case) == 1, "what is undeveloped does not hold either"
    assert "G-sum: is undeveloped" in capsys.readouterr().out


def test_a_run_that_is_made_anew_is_another_run(case, capsys):
    shutil.rmtree(case / "run")
    make_run(case / "run", replace(COUNTED, seed=7))
    assert check(case, "--update") == 1
    told = capsys.readouterr().out
    assert "G-h1-violation: no longer holds: Sn-run1-result" in told
    assert "has changed" in told
    document = load(case / "case.gsn.yaml")
    assert document["G-h1-violation"]["undeveloped"] is True
    assert "Sn-run1-result" not in document
    assert "undeveloped" not in document["G-h2-harm"]
    assert list(complaints(document)) == []


def test_a_run_that_is_gone_carries_nothing(case, capsys):
    shutil.rmtree(case / "run")
    assert check(case) == 1
    assert "cannot be read" in capsys.readouterr().out


EDITS = {
    "text": (lambda d: d["G-sum"].update(text="All is well"), "G-sum: no longer holds: it reads"),
    "bound": (
        lambda d: d["G-h1-harm"].update(text=d["G-h1-harm"]["text"].replace("0.10", "0.010")),
        "G-h1-harm: no longer holds: it reads",
    ),
    "goal left out": (
        lambda d: (d.pop("G-h2-harm"), d["S-h2"]["supportedBy"].remove("G-h2-harm")),
        "G-h2-harm: is left out of the file",
    ),
    "evidence left out": (
        lambda d: d["G-h1-violation"].update(supportedBy=["Sn-budget"]),
        "does not name Sn-run1-result",
    ),
    "digest left out": (lambda d: d["Sn-run1-result"].pop("sha256"), "names no file with its"),
    "another file": (
        lambda d: d["Sn-run1-result"].update(
            file=d["Sn-budget"]["file"], sha256=d["Sn-budget"]["sha256"]
        ),
        "names another file than the evidence is in",
    ),
    "made developed": (
        lambda d: d["G-sum"].update(supportedBy=[], undeveloped=False), "G-sum: is undeveloped",
    ),
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_a_file_that_was_edited_by_hand_deceives_nobody(edit, case, capsys):
    change, words = EDITS[edit]
    path = case / "case.gsn.yaml"
    document = unchecked(path)
    change(document)
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    assert check(case) == 1
    assert words in capsys.readouterr().out


def test_what_somebody_added_stays(case):
    path = case / "case.gsn.yaml"
    document = unchecked(path)
    document["S-hazards"]["supportedBy"].append("G9")
    document["G9"] = {"text": "Others are looked at elsewhere", "supportedBy": "Sn9"}
    document["Sn9"] = {"text": "A report", "url": "reports/9"}
    document["module"] = {"name": "ours"}
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    assert check(case) == 0
    budget = case / "budget.toml"
    budget.write_text(budget.read_text().replace("_hour = 1.0", "_hour = 1e-9"))
    assert check(case, "--update") == 1
    after = load(path)
    assert after["G9"] == {"text": "Others are looked at elsewhere", "supportedBy": ["Sn9"]}
    assert after["module"] == {"name": "ours"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "no YAML"),
        ("- a\n- b\n", "must be a table of elements"),
        ("G1: {text: one}\n", "has no goal G-top"),
        ("G-top: {text: a}\nG-top: {text: b}\n", "is there twice"),
        ("G-top: &a {text: a}\nG-b: *a\n", "an alias in line 2"),
        ("G-top: yes\n", "must be a table with a text"),
        ("G-top: {text: a, supportedBy: 3}\n", "must be a list of names"),
        ("G-top: {text: a, supportedBy: [{}]}\n", "must be a list of names"),
        ("[" * 5000, "no YAML"),
        ("!!python/object/apply:os.system ['true']", "no YAML"),
        ("\x00", "no YAML"),
    ],
)
def test_a_damaged_argument_is_one_line(text, words, tmp_path, capsys):
    path = tmp_path / "case.gsn.yaml"
    path.write_text(text)
    assert main(["report", "--check", str(path)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert words in told


def test_undeveloping_leaves_no_element_that_nothing_names():
    argument = (
        Element("G-top", "t", supported_by=("G-a", "G-b")),
        Element("G-a", "t", supported_by=("Sn-a", "Sn-both"), in_context_of=("C-a",)),
        Element("G-b", "t", supported_by=("Sn-both",)),
        Element("Sn-a", "t"), Element("Sn-both", "t"), Element("C-a", "t"),
    )  # fmt: skip
    left = {one.name: one for one in undeveloped(argument, {"G-a"})}
    assert set(left) == {"G-top", "G-a", "G-b", "Sn-both", "C-a"}
    assert left["G-a"].undeveloped


def test_the_picture_has_every_goal_and_its_text(case):
    from pemviz.reports.argument import argument_of_budget  # noqa: PLC0415
    from pemviz.runs.risk_budget import judge_budget  # noqa: PLC0415

    argument = argument_of_budget(judge_budget(case / "budget.toml"))
    tree = well_formed(argument_svg(argument, title="argument"))
    words = " ".join("".join(tree.itertext()).split())
    for one in argument:
        if one.kind in ("Goal", "Strategy", "Solution"):
            assert one.name in words
        assert one.text in words or one.kind in ("Context", "Assumption")


def test_checking_again_needs_nothing_else():
    assert main(["report", "run", "--check", "case.gsn.yaml"]) == 2
    assert main(["report", "--update"]) == 2


def test_a_finding_names_its_goal(case):
    (case / "budget.toml").unlink()
    assert {one.goal for one in check_gsn(case / "case.gsn.yaml")} >= {"G-sum", "G-h1-violation"}
