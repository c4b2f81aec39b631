"""The commands of `pemviz pem` end to end on made-up data, and their one-line refusals."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import tyro

from pemviz.cli.pem import collect, evaluate, fit, memory, show
from pemviz.files.shipped import asset_path
from pemviz.pem import PemError, load_pem
from pemviz.pem.models.cards import fitted_memory
from pemviz.pem.models.protocol import SALIENT_COLUMNS
from tests.pem.synthetic_tracks import draw_tracks
from tests.pem.test_collect import LABEL, RESULT

SYNTHETIC = asset_path("pem", "synthetic-obstacles.csv")


def test_collect_fit_evaluate_show(tmp_path, capsys):
    for folder, line in (("labels", LABEL), ("detections", RESULT)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "000000.txt").write_text(f"{line}\nbroken\n")
    arguments = collect.CollectArguments(
        labels=tmp_path / "labels",
        detections=tmp_path / "detections",
        out=tmp_path / "table.csv",
        skip_bad=True,
    )
    assert collect.run(arguments) == 0
    printed = capsys.readouterr()
    assert "1 frames, 1 obstacles, 0 missed" in printed.out
    assert "warning: 2 malformed lines skipped" in printed.err

    out = tmp_path / "own.safetensors"
    fitted = fit.FitArguments(table=SYNTHETIC, out=out, model="lr", members=3, folds=3, seed=4)
    assert fit.run(fitted) == 0
    assert "roc_auc, 3-fold" in capsys.readouterr().out
    metadata = json.loads(out.with_suffix(".json").read_text())
    assert metadata["inputs"][-1] == "rotation_y_rad"
    assert len(metadata["normalisation_mean"]) == 4
    assert metadata["digest"] == load_pem(str(out)).digest
    assert "bce, 3-fold" in out.with_suffix(".md").read_text()

    shown = show.ShowArguments(pem=str(out), out=tmp_path / "curve.png")
    assert show.run(shown) == 0
    printed = capsys.readouterr().out
    assert "z from 13 to 15 m" in printed
    assert "ensemble 95 %" in printed
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")

    told = evaluate.EvaluateArguments(
        table=SYNTHETIC, out=tmp_path / "report", models=("guess-mu", "lr"), folds=2, json=True
    )
    assert evaluate.run(told) == 0
    assert json.loads(capsys.readouterr().out)["models"][0]["model"] == "guess-mu"
    assert evaluate.run(evaluate.EvaluateArguments(SYNTHETIC, tmp_path / "r", ("lr",), 2)) == 0
    printed = capsys.readouterr().out
    assert "written:" in printed
    assert "…" not in printed  # no cell is cut at the eighty columns of a file
    (row,) = (line for line in printed.splitlines() if line.startswith("lr "))
    assert row.count("±") == 2


def test_show_warns_about_the_default_scenarios_thin_data(capsys):
    assert show.run(show.ShowArguments()) == 0
    printed = capsys.readouterr().out
    assert "warning: extrapolation: no training obstacle" in printed
    assert "CC BY-NC-SA 3.0" in printed


@pytest.mark.parametrize(
    ("run", "arguments", "words"),
    [
        (
            collect.run,
            collect.CollectArguments(labels=Path("none"), detections=Path("none")),
            "none: no folder with KITTI label files",
        ),
        (
            collect.run,
            collect.CollectArguments(labels=Path("l"), detections=Path("d"), iou_above=1.0),
            "iou_above is 1, allowed: 0 to below 1",
        ),
        (
            fit.run,
            fit.FitArguments(table=SYNTHETIC, out=Path("model.pkl")),
            "out is 'model.pkl', must end in .safetensors",
        ),
        (
            fit.run,
            fit.FitArguments(table=Path("nothing.csv"), out=Path("m.safetensors")),
            "nothing.csv: no table",
        ),
        (
            fit.run,
            fit.FitArguments(table=SYNTHETIC, out=Path("m.safetensors"), members=1),
            "members is 1, allowed: 0, or 2 or more",
        ),
        (
            fit.run,
            fit.FitArguments(table=SYNTHETIC, out=Path("m.safetensors"), model="best", folds=0),
            "folds is 0, allowed with model best: 2 or more",
        ),
        (
            evaluate.run,
            evaluate.EvaluateArguments(table=SYNTHETIC, folds=1),
            "folds is 1, allowed: 2 to",
        ),
        (show.run, show.ShowArguments(pem="yolo"), "no perception error model 'yolo'"),
        (show.run, show.ShowArguments(z_from_m=9.0, z_to_m=3.0), "increasing"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(run, arguments, words):
    with pytest.raises(PemError) as caught:
        run(arguments)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        (collect.CollectArguments, "--labels l --detections d --format yolo --skip-bad"),
        (fit.FitArguments, "--table t.csv --out m.safetensors --model gb-raw --members 20"),
        (evaluate.EvaluateArguments, "--table t.csv --models lr ml-nn"),
        (show.ShowArguments, "ml-nn --class-name Van"),
    ],
)
def test_tyro_makes_flags_of_every_field(kind, line, capsys):
    assert isinstance(tyro.cli(kind, args=line.split()), kind)
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--help"])
    printed = capsys.readouterr().out
    for name in kind.__dataclass_fields__:
        flag = "[STR]" if (kind, name) == (show.ShowArguments, "pem") else f"--{name}"
        assert flag.replace("_", "-") in printed


TABLE = """class_id,truncation,occlusion,alpha_rad,height_m,width_m,length_m,x_m,y_m,z_m,\
rotation_y_rad,detected
0,0,0,0,1.5,1.6,4,0,1.6,20,1.5,1
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TABLE.replace("20,1.5", "far,1.5"), r"2: column 10 \(z_m\) is 'far', not a number"),
        (TABLE.replace(",detected", ""), "1: the header lacks detected"),
        (TABLE.replace("1.5,1\n", "1.5\n"), "2: 11 columns where 12 are needed"),
        (TABLE.replace("1.5,1\n", "1.5,2\n"), "column 'detected' must hold 0 or 1"),
        (TABLE.replace("0,0,0,0,1.5", "7,0,0,0,1.5"), "class_id is 7, allowed: 0 Car"),
        (TABLE.splitlines()[0] + "\n", "the table has no rows"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, text, words):
    path = tmp_path / "table.csv"
    path.write_text(text)
    arguments = fit.FitArguments(table=path, out=tmp_path / "m.safetensors", folds=0)
    with pytest.raises(PemError, match=words):
        fit.run(arguments)


def tracks_table(folder):
    """Tracks with a memory time of 0.3 s, as a CSV of one's own."""
    table, _ = draw_tracks(seed=1, tau_s=0.3, frailty=0.0, sequences=6, tracks_each=8)
    path = folder / "tracks.csv"
    header = ["sequence", "frame", "track", *SALIENT_COLUMNS, "detected"]
    rows = [
        [str(table.sequence[row]), str(table.frame[row]), str(table.track[row])]
        + [f"{value:.10g}" for value in table.obstacles.salient[row]]
        + [str(int(table.detected[row]))]
        for row in range(len(table))
    ]
    path.write_text("\n".join(",".join(cells) for cells in [header, *rows]) + "\n")
    return path


def test_memory_is_fitted_kept_in_the_card_and_told(tmp_path, capsys):
    table = tracks_table(tmp_path)
    out = tmp_path / "video.safetensors"
    fit.run(fit.FitArguments(table=table, out=out, model="lr", memory=True, rate_hz=10.0, folds=3))
    told = capsys.readouterr().out
    assert "memory time 0." in told
    assert "independent misses do not explain this detector" in told
    assert "misses right after a miss" in (tmp_path / "video-memory.md").read_text()
    assert (tmp_path / "video-memory.png").stat().st_size > 10_000
    pem = load_pem(str(out))
    fitted = fitted_memory(pem.card.memory, where=str(out))
    assert fitted.tau_interval_s[0] < fitted.memory.tau_s < fitted.tau_interval_s[1]
    assert fitted.sequences == 6
    card = out.with_suffix(".md").read_text()
    assert "## Memory of misses" in card
    assert "| misses in a row |" in card
    assert "Weights" in card


def table_of_distance(path, p_missed):
    """Tracks that keep their distance each, missed with the probability that it gives."""
    random = np.random.default_rng(3)
    lines = ["sequence,frame,track,distance,detected"]
    for sequence, track in itertools.product(range(10), range(8)):
        distance = random.uniform(0.0, 60.0)
        for frame in range(12):
            detected = int(random.random() >= p_missed(distance))
            lines.append(f"{sequence},{frame},{track},{distance + random.normal():.2f},{detected}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize(
    ("p_missed", "best"),
    [
        (lambda distance: 1.0 / (1.0 + np.exp(3.0 - distance / 20.0)), "lr"),
        (lambda distance: 0.6 if 20.0 < distance < 40.0 else 0.02, "gb-raw"),
    ],
)
def test_best_is_what_predicts_other_sequences(tmp_path, capsys, p_missed, best, memory):
    given = {
        "table": table_of_distance(tmp_path / "t.csv", p_missed),
        "features": "distance",
        "rate_hz": 10.0,
        "memory": memory,
    }
    out = {kind: tmp_path / f"{kind}.safetensors" for kind in ("best", "gb-raw", "lr")}
    assert fit.run(fit.FitArguments(**given, model="best", out=out["best"])) == 0
    assert f"; {best} is fitted" in capsys.readouterr().out
    for kind in ("gb-raw", "lr"):
        assert fit.run(fit.FitArguments(**given, model=kind, out=out[kind])) == 0
        doubts = capsys.readouterr().err
        assert ("lr predicts rows that it was not fitted to better" in doubts) == (
            kind == "gb-raw" and best == "lr"
        )
    same = {kind: load_pem(str(path)).digest for kind, path in out.items()}
    assert [kind for kind in ("gb-raw", "lr") if same[kind] == same["best"]] == [best]


def test_independence_is_judged_in_one_command(tmp_path, capsys):
    table, page = tracks_table(tmp_path), tmp_path / "memory.md"
    arguments = memory.MemoryArguments(
        table=table, model="lr", rate_hz=10.0, folds=3, json=True, out=page
    )
    memory.run(arguments)
    document = json.loads(capsys.readouterr().out)
    independence = document["independence"]
    assert independence["misses_after_miss"] > 2 * independence["expected"]
    assert [each["tau_s"] for each in independence["needed"]] == [0.02, 0.05, 0.1, 0.2]
    needed = [each["sequences"] for each in independence["needed"]]
    assert needed == sorted(needed, reverse=True)
    assert "misses right after a miss" in page.read_text()
    assert page.with_suffix(".png").stat().st_size > 10_000


def test_independence_is_judged_without_the_state(tmp_path, capsys):
    lines = [line.split(",") for line in tracks_table(tmp_path).read_text().splitlines()]
    table, page = tmp_path / "own.csv", tmp_path / "own.md"
    table.write_text("\n".join(",".join([*cells[:3], cells[-1]]) for cells in lines) + "\n")
    settings = {"table": table, "rate_hz": 10.0, "folds": 3}
    with pytest.raises(PemError, match="the header lacks class_id"):
        memory.run(memory.MemoryArguments(**settings))
    memory.run(memory.MemoryArguments(**settings, model="guess-mu", out=page))
    printed = capsys.readouterr().out
    assert "independent misses do not explain this detector (p-value below 0.0001)" in printed
    assert "sequences," in printed.splitlines()[-1]
    assert "plain view:" not in page.read_text()


def test_a_memory_is_shown_beside_its_model(tmp_path, capsys):
    out = tmp_path / "rrc.png"
    assert show.run(show.ShowArguments(pem="rrc", out=out)) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Memory of misses" in words
    assert "these figures flatter it" in words
    assert (tmp_path / "rrc-memory.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate_hz": None}, "lacks rate_hz; give the rate"),
        ({"rate_hz": -1.0}, "rate_hz is -1, allowed"),
        ({"out": Path("page.txt")}, "must end in .md"),
        ({"folds": 9}, "allowed: 2 to the number of sequences, 6"),
        ({"table": Path("nowhere.csv")}, "no such table of tracks"),
    ],
)
def test_memory_refuses_in_one_line(changes, words, tmp_path):
    settings = {"table": tracks_table(tmp_path), "model": "lr", "rate_hz": 10.0, "folds": 3}
    with pytest.raises(PemError, match=words) as caught:
        memory.run(memory.MemoryArguments(**(settings | changes)))
    assert "\n" not in str(caught.value)
