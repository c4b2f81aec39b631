import csv
import io
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markdown_it import MarkdownIt

from pemviz.cli import reproduce as command
from pemviz.cli.main import main
from pemviz.errors import ConfigError
from pemviz.reproduce import reproduce
from pemviz.reproduce.carry_out import plan
from pemviz.reproduce.experiments import run_repetition
from tests.reproduce.quick import QUICK

ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"
NAMES = {
    "table2.md", "table2.csv", "table3.md", "table3.csv", "learned_proposal.png",
    "learned_proposal.csv", "proposals_stage_3.png", "proposals_stage_3.csv", "least_safe.png",
    "least_safe.csv", "reproduction.md",
}  # fmt: skip


def table_of(made, name):
    return list(csv.DictReader(io.StringIO(made.files()[name].decode())))


def test_all_tables_and_figures_are_made(made):
    files = made.files()
    assert set(files) == NAMES
    for name, content in files.items():
        assert content.startswith(PNG) == name.endswith(".png")


def test_the_page_shows_them_all(made):
    html = MarkdownIt("commonmark").enable("table").render(made.page)
    assert html.count("<table>") == 3
    for name in ("learned_proposal", "proposals_stage_3", "least_safe"):
        assert f'src="{name}.png"' in html
    assert "Left out: it needs" in html
    assert html.count("<h2>") == 7


def test_curves_in_the_files_are_the_runs_own(made):
    outcomes = [run_repetition(QUICK.adaptive("classical"), n) for n in range(2)]
    rows = table_of(made, "learned_proposal.csv")
    np.testing.assert_array_equal([float(r["gap_m"]) for r in rows], np.linspace(0, 20, 201))
    for number, outcome in enumerate(outcomes):
        written = [float(row[f"proposal_repetition_{number}"]) for row in rows]
        np.testing.assert_array_equal(written, outcome.curves[4])
    at_stage = [float(row["classical_mean"]) for row in table_of(made, "proposals_stage_3.csv")]
    expected = (outcomes[0].curves[3] + outcomes[1].curves[3]) / 2
    np.testing.assert_allclose(at_stage, expected, rtol=1e-12)


def test_least_safe_rollouts_stay_above_the_limit_in_the_file(made):
    rows = table_of(made, "least_safe.csv")
    assert len(rows) == 100
    assert rows[1]["time_s"] == "0.05"
    for metric in ("classical", "agm", "smooth-cumulative"):
        assert min(float(row[f"{metric}_gap_m"]) for row in rows) >= 2.0
        assert rows[-1][f"{metric}_detected"] == ""


def test_the_files_do_not_depend_on_the_number_of_processes(made):
    by_two = reproduce(replace(QUICK, workers=2, parts=("table3",))).files()
    for name in ("table3.md", "table3.csv"):
        assert by_two[name] == made.files()[name]


def test_shared_repetitions_are_run_once():
    jobs = plan(QUICK)
    labels = [job.label for job in jobs.values()]
    assert len(labels) == len(set(labels)) == 2 + 2 * (3 + 4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"repetitions": 0}, "repetitions = 0"),
        ({"workers": 0}, "workers = 0"),
        ({"parts": ("table1",)}, "table1 needs --data"),
        ({"parts": ("table1",), "data": Path("nowhere.csv")}, "nowhere.csv"),
        ({"pem": "nowhere"}, "nowhere"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_wrong_settings_are_one_line(changes, words):
    with pytest.raises(Exception, match=words) as caught:
        reproduce(replace(QUICK, **changes))
    assert "\n" not in str(caught.value)


def test_table_1_alone_needs_data(capsys, tmp_path):
    assert main(["reproduce", "table1", "--out", str(tmp_path / "out")]) == 2
    assert "table1 needs --data" in capsys.readouterr().err


def test_the_command_writes_everything(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(command, "_settings", lambda arguments: replace(QUICK, parts=("table2",)))
    assert main(["reproduce", "table2", "--out", str(tmp_path), "--no-recording"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "table2.md", "table2.csv", "reproduction.md",
    }  # fmt: skip
    shown = capsys.readouterr()
    assert shown.out.startswith("# The paper reproduced")
    assert "adaptive_20, repetition 2 of 2" in shown.err


@pytest.mark.parametrize("words", [["table9"], ["--repetitions", "x"], ["--seed", "-1"]])
def test_bad_arguments_are_one_line(words, tmp_path, capsys):
    assert main(["reproduce", *words, "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert shown.out == ""


def test_a_file_in_the_way_is_bad_input(tmp_path, capsys):
    (tmp_path / "out").write_text("in the way")
    assert main(["reproduce", "table2", "--out", str(tmp_path / "out")]) == 2
    assert "no folder can be made there" in capsys.readouterr().err


def test_an_unwritable_table_is_refused_before_anything_runs():
    with pytest.raises(ConfigError):
        reproduce(replace(QUICK, parts=("table1",)))


def test_ctrl_c_leaves_nothing_half_written(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "pemviz", "reproduce", "table2", "--out", str(tmp_path / "out")],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"}, start_new_session=True,
    )  # fmt: skip
    assert process.stderr is not None
    first = process.stderr.readline()
    assert " of " in first
    began = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert process.returncode == 3, rest
    assert "interrupted" in rest
    assert "Traceback" not in rest
    assert time.monotonic() - began < 60
    assert list((tmp_path / "out").iterdir()) == []
