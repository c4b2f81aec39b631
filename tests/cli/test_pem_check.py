"""`pemviz pem check` end to end on made-up tracks, its refusals, and its verdict in an answer."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig
from pemviz.pem import load_pem, save_pem
from pemviz.pem.models.cards import PemCard
from pemviz.pem.models.predictive_check import (
    CheckedQuantity,
    CheckedVariant,
    ModelCheck,
    check_from_mapping,
    check_table,
)
from pemviz.pem.models.protocol import SALIENT_COLUMNS
from pemviz.reports.html import sections_html
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.memory_words import memory_text
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import summary_text
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result import RunMemory, memory_of
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.runs.uncertainty import SEVERAL_SLOTS
from tests.reports.runs import result as made_up_result


def write_tracks(path, *, missed=0.3, stays=0.8, errors=False, state=True, sequences=6, seed=0):
    """Tracks that come nearer; each miss is followed by one with probability ``stays``."""
    random = np.random.default_rng(seed)
    columns = SALIENT_COLUMNS if state else ()
    header = ["sequence", "frame", "track", "rate_hz", *columns, "detected"]
    lines = [",".join([*header, *(["x_error_m", "z_error_m"] if errors else [])])]
    for sequence in range(sequences):
        for track in range(8):
            start_m, before = random.uniform(25.0, 60.0), random.random() < missed
            for frame in range(20):
                before = random.random() < (stays if before else missed * (1 - stays))
                z_m = start_m - frame
                salient = dict.fromkeys(SALIENT_COLUMNS, 0.0) | {"z_m": z_m, "y_m": 1.6}
                cells = [sequence, frame, track, 10.0, *(salient[name] for name in columns)]
                cells += [int(not before)]
                if errors:
                    cells += [
                        "" if before else f"{e:.4f}" for e in random.normal(0.0, 0.01 * z_m, 2)
                    ]
                lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines) + "\n")
    return path


def check(*words):
    return main(["pem", "check", *map(str, words)])


def test_a_kind_of_model_is_checked_out_of_fold(tmp_path, capsys):
    table, page = write_tracks(tmp_path / "tracks.csv", errors=True), tmp_path / "check.md"
    words = ("--table", table, "--model", "lr", "--folds", 5, "--draws", 799)
    assert check(*words, "--out", page, "--json") == 0
    read = check_from_mapping(json.loads(capsys.readouterr().out)["check"], where="stdout")
    assert [len(one.quantities) for one in read.variants] == [18] * 4
    assert read.variants[0].refuted
    text = page.read_text()
    assert "Checked on 48 tracks of 6 sequences, each judged by a model of the other" in text
    assert "| largest error of all tracks |" in text
    assert ": refuted |" in text
    assert "(check.png)" in text
    assert page.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_without_places_runs_are_checked_alone(tmp_path, capsys):
    table = write_tracks(tmp_path / "tracks.csv", state=False)
    assert (
        check("--table", table, "--model", "guess-mu", "--folds", 3, "--draws", 799, "--json") == 0
    )
    (first, *_) = json.loads(capsys.readouterr().out)["check"]["variants"]
    names = [one["name"] for one in first["quantities"]]
    assert names == ["longest_run_s", "missed_0.5_s", "missed_1_s", "missed_2_s",
                     "after_hit", "after_miss"]  # fmt: skip


def test_a_fitted_model_carries_its_check_and_knows_its_own_data(tmp_path, capsys):
    table, model = write_tracks(tmp_path / "tracks.csv"), tmp_path / "own.safetensors"
    assert main(["pem", "fit", "--table", str(table), "--model", "lr", "--memory", "--folds", "3",
                 "--out", str(model)]) == 0  # fmt: skip
    assert "As it is the model reproduces" in capsys.readouterr().out
    assert "## Predictive checks" in model.with_suffix(".md").read_text()
    card = load_pem(str(model)).card
    kept = check_from_mapping(card.check, where="card")
    assert kept.folds == 3
    before = model.read_bytes()
    assert check("--table", table, "--pem", model, "--draws", 799) == 0
    assert "which are the data that it was fitted to" in " ".join(capsys.readouterr().out.split())
    other = write_tracks(tmp_path / "other.csv", seed=1)
    assert check("--table", other, "--pem", model, "--draws", 799, "--json") == 0
    told = json.loads(capsys.readouterr().out)["check"]
    assert check("--table", other, "--model", "lr", "--folds", 2, "--draws", 799) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "As it is the model reproduces" in printed
    assert "With both (memory time" in printed
    assert not told["same_data"]
    assert [one["name"] for one in told["variants"]] == ["independent", "memory", "frailty", "both"]
    assert model.read_bytes() == before


def test_a_visibility_that_comes_and_goes_is_checked_and_told_of_in_an_answer(tmp_path, capsys):
    table, model = write_tracks(tmp_path / "tracks.csv", sequences=2), tmp_path / "own.safetensors"
    assert check("--table", table, "--model", "lr", "--folds", 2, "--draws", 799,
                 "--varying-frailty", "--out", tmp_path / "check.md") == 0  # fmt: skip
    printed = " ".join(capsys.readouterr().out.split())
    assert "With visibility that comes and goes (time-varying frailty" in printed
    assert "| with visibility |" in (tmp_path / "check.md").read_text()
    assert main(["pem", "fit", "--table", str(table), "--model", "lr", "--memory", "--folds", "2",
                 "--varying-frailty", "--out", str(model)]) == 0  # fmt: skip
    assert "With visibility that comes and goes" in " ".join(capsys.readouterr().out.split())
    pem = load_pem(str(model))
    other = write_tracks(tmp_path / "other.csv", seed=1)
    assert check("--table", other, "--pem", model, "--draws", 799, "--json") == 0
    last = json.loads(capsys.readouterr().out)["check"]["variants"][-1]
    assert last["name"] == "visibility"
    law = pem.varying_frailty
    assert (last["frailty"], last["varying"], last["varying_s"]) == (
        law.frailty, law.varying, law.varying_s,
    )  # fmt: skip
    own = replace(ExperimentConfig(), pem=str(model), memory_law="visibility")
    shown = memory_of(build_experiment(own).pem).check
    assert [one.name for one in shown.variants] == ["visibility"]
    copied = memory_of(build_experiment(replace(own, memory_law="outcomes")).pem)
    assert [one.name for one in copied.check.variants] == ["both"]
    told = replace(made_up_result(), memory=copied)
    assert f"its other law, {law.label}, is left out" in memory_text(told)
    assert f"without the model's other law: {law.label}" in summary_markdown(told)
    assert "--memory-law visibility by method auto has it" in memory_text(told)
    in_slots = replace(told, memory=replace(copied, unmeasured=f"{SEVERAL_SLOTS}; another tells"))
    assert f"{law.label}, is left out" in memory_text(in_slots)
    assert "--memory-law" not in memory_text(in_slots)
    by_own = memory_of(build_experiment(own).pem)
    assert by_own.left_out == ""
    words = memory_text(replace(told, memory=by_own))
    assert f"{law.label}: the error model's own, measured on video; by its other law" in words
    other = replace(own, frailty=0.5, varying_frailty=0.7, varying_frailty_s=0.2)
    given = memory_of(build_experiment(other).pem)
    assert given.check.variants == ()
    nothing = replace(given.fitted, tau_s=0.0, frailty=0.0)
    assert "not the error model's own" in memory_text(
        replace(told, memory=replace(given, fitted=nothing))
    )


def test_position_errors_of_a_model_are_checked_beside_it(tmp_path, capsys):
    table = write_tracks(tmp_path / "tracks.csv", errors=True)
    words = ("--table", table, "--pem", "rrc", "--position-errors", "pointrcnn", "--draws", 799)
    assert check(*words, "--json") == 0
    (first, *_) = json.loads(capsys.readouterr().out)["check"]["variants"]
    assert first["quantities"][-1]["name"] == "largest_of_all_m"


BAD = {
    "no-table": (["--table", "none.csv"], "none.csv: no such table of tracks"),
    "both": (["--pem", "rrc", "--model", "lr"], "model: not with pem"),
    "draws": (["--draws", "100"], "draws is 100, allowed: 799 to 100000"),
    "folds": (["--model", "lr", "--folds", "7"], "folds is 7, allowed: 2 to"),
    "few-folds": (["--folds", "1"], "folds is 1, allowed: 2 or more"),
    "out": (["--out", "check.html"], "out is 'check.html', must end in .md"),
    "no-folder": (["--out", "none/check.md"], "out: no folder 'none'"),
    "errors": (["--position-errors", "pointrcnn"], "position_errors: only with pem"),
    "no-errors": (["--pem", "rrc", "--position-errors", "pointrcnn"], "the header lacks"),
    "pem": (["--pem", "rrrc"], "no perception error model 'rrrc'"),
    "rate": (["--rate-hz", "0"], "rate_hz is 0, allowed: above 0"),
    "varying": (["--pem", "rrc", "--varying-frailty"], "varying_frailty: not with pem, which is"),
    "seed": (["--seed", "-1"], "seed is -1, allowed: 0 or more"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_in_one_line(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    words, said = BAD[name]
    table = write_tracks(tmp_path / "tracks.csv")
    given = words if "--table" in words else ["--table", str(table), *words]
    assert check(*given) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_one_sequence_is_refused(tmp_path, capsys):
    table = write_tracks(tmp_path / "tracks.csv", sequences=1)
    assert check("--table", table, "--model", "lr") == 2
    assert "at least two sequences" in capsys.readouterr().err


CHECK = ModelCheck(
    tracks=489, approaching=200, sequences=18, observations=22_179, draws=999, folds=5,
    same_data=False,
    variants=tuple(
        CheckedVariant(name, tau_s, 0.0, (
            CheckedQuantity("missed_1_s", 0.06, expected, 0.01, 0.03, 0.002, refuted=True),
        ))
        for name, tau_s, expected in (("independent", 0.0, 0.006), ("both", 0.25, 0.02))
    ),
)  # fmt: skip


def test_an_answer_tells_of_the_variant_that_it_rests_on():
    """Of the model with its own memory, as independent, and with a memory that nobody checked."""

    class Own:
        name = digest = data = licence = "own"
        card = PemCard("own", "own", check=check_table(CHECK))
        memory = None

    (kept,) = memory_of(Own()).check.variants
    assert kept.name == "independent"
    pem = load_pem("rrc")
    pem = replace(pem, card=replace(pem.card, check=check_table(CHECK)))
    assert memory_of(pem).tau_s == 0.0  # the model alone; a run puts its memory around it


def test_the_line_stands_in_every_medium_and_is_read_back():
    memory = RunMemory(0.25, check=replace(CHECK, variants=CHECK.variants[1:]))
    result = replace(made_up_result(), memory=memory)
    line = (
        "This error model was checked on 489 tracks; with its memory time and frailty it gets runs "
        "of misses of 1 s or more too rare by a factor 3."
    )
    document = run_document(result)
    assert line in summary_text(result)
    assert line in summary_markdown(result)
    assert line in sections_html(document.choose(("memory",)), live=True)
    assert line in sections_html(document.choose(("memory",)), brief=True)
    again = result_from_document(json.loads(json.dumps(result_document(result))))
    assert again.memory == memory


def test_a_model_without_a_check_says_nothing():
    result = replace(made_up_result(), memory=RunMemory(0.25))
    assert "was checked on" not in summary_text(result)
    assert "check" not in result_document(result)["memory"]


def test_saving_a_model_without_a_check_leaves_no_entry(tmp_path):
    path = tmp_path / "plain.safetensors"
    save_pem(load_pem("ml-nn"), path)
    assert b'"check"' not in path.read_bytes()


def test_a_table_of_one_outcome_teaches_nothing(tmp_path, capsys):
    """Whatever the kind: trees would be fitted to it without a complaint."""
    table = write_tracks(tmp_path / "tracks.csv", missed=0.0)
    for kind in ("lr", "gb-raw"):
        assert check("--table", table, "--model", kind, "--folds", 3) == 2
        assert "obstacles were detected" in capsys.readouterr().err
