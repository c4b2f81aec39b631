import csv
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from pyarrow import parquet

from pemviz.cli.main import main
from pemviz.config.toml_files import load_config
from pemviz.recording import paths
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document
from pemviz.sweep.carry_out import sweep_folder
from pemviz.sweep.tables import FIGURES
from tests.comparable_results import comparable, comparable_result
from tests.recording.read_back import chunks
from tests.sweep.conftest import ROOT, VARIED, contents


def sweep(config, out, *words):
    return main(["sweep", str(config), "--out", str(out), *words])


def rows_of(out):
    with (out / "sweep.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_two_workers_give_the_bytes_of_one(serial, tiny, tmp_path, capsys):
    assert sweep(tiny, tmp_path / "out", *VARIED, "--workers", "2") == 0
    assert contents(tmp_path / "out") == contents(serial)
    shown = capsys.readouterr()
    assert "4 of 4" in shown.err
    assert "median probability" in shown.out
    assert multiprocessing.active_children() == []
    assert not [p for p in (tmp_path / "out" / "runs").iterdir() if p.name.startswith(".")]


def test_every_run_is_what_the_engine_makes_of_its_configuration(serial):
    folder = next(p for p in (serial / "runs").iterdir() if "agm_seed-4" in p.name)
    expected = result_document(
        run_experiment(load_config(folder / "config.toml"), run_id=folder.name)
    )
    assert comparable_result(folder) == comparable(expected)


def test_the_tables_hold_what_the_results_say(serial):
    rows = rows_of(serial)
    table = parquet.read_table(serial / "sweep.parquet").to_pylist()
    assert [(r["alpha"], r["metric"], r["seed"]) for r in rows] == [
        (alpha, metric, seed)
        for alpha in ("0.1", "0.5") for metric in ("agm",) for seed in ("3", "4")
    ]  # fmt: skip
    for row, typed in zip(rows, table, strict=True):
        document = json.loads((serial / row["run_folder"] / "result.json").read_text())
        assert document["config"]["alpha"] == float(row["alpha"]) == typed["alpha"]
        assert document["config"]["metric"] == row["metric"] == typed["metric"]
        assert document["seed"] == typed["seed"]
        assert typed["status"] == "done"
        assert typed["message"] is None
        for name in FIGURES:
            assert typed[name] == document["estimate"][name]
            assert row[name] == ("" if typed[name] is None else repr(typed[name]))


def test_the_summary_has_medians_and_ranges_over_seeds(serial):
    rows = [row for row in rows_of(serial) if (row["alpha"], row["metric"]) == ("0.5", "agm")]
    low, high = sorted(float(row["probability"]) for row in rows)
    line = f"| 0.5 | agm | 2 of 2 | {(low + high) / 2:.3g} | {low:.3g} | {high:.3g} |"
    assert line in (serial / "summary.md").read_text()


def test_the_overview_shows_every_estimate(serial):
    found = {}
    for chunk in chunks(serial / "sweep.rrd"):
        batch = chunk.to_record_batch()
        for field, column in zip(batch.schema, batch.columns, strict=True):
            found[chunk.entity_path, field.name.rpartition(":")[2]] = column.to_pylist()
    (labels,) = found[paths.sweep_estimates("points"), "labels"]
    expected = [
        f"alpha {row['alpha']}, metric {row['metric']}, seed {row['seed']}: "
        f"{float(row['probability']):.3g}; not a 95 % interval: {row['interval_caveats']}"
        for row in rows_of(serial)
    ]
    assert labels == expected
    (positions,) = found[paths.sweep_estimates("points"), "positions"]
    (strips,) = found[paths.sweep_estimates("intervals"), "strips"]
    assert len(strips) == len(positions) == 4
    for (x, y), ((low, low_y), (high, high_y)) in zip(positions, strips, strict=True):
        assert low < x < high
        assert low_y == high_y == y
    (titles,) = found[paths.sweep_estimates("settings"), "labels"]
    assert titles == ["alpha 0.1, metric agm", "alpha 0.5, metric agm"]
    for page in (paths.SWEEP_SUMMARY, paths.SWEEP_RUNS, paths.SWEEP_SETTINGS):
        assert (page, "text") in found


@pytest.mark.usefixtures("in_this_process")
def test_json_is_the_table_and_nothing_else(tiny, tmp_path, capsys):
    words = ["--vary", "method=naive", "--seeds", "2", "--json", "--workers", "1"]
    assert sweep(tiny, tmp_path / "out", *words) == 0
    document = json.loads(capsys.readouterr().out)
    table = parquet.read_table(tmp_path / "out" / "sweep.parquet").to_pylist()
    assert document == {"schema": 1, "out": str(tmp_path / "out"), "runs": table}


@pytest.mark.usefixtures("in_this_process")
def test_done_runs_are_skipped_and_damaged_ones_done_again(tiny, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--vary", "method=naive,monte-carlo", "--seeds", "2", "--workers", "1"]
    assert sweep(tiny, out, *words) == 0
    before = contents(out)
    folders = sorted((out / "runs").iterdir())
    (folders[0] / "result.json").write_text("{")
    document = json.loads((folders[1] / "result.json").read_text())
    (folders[1] / "result.json").write_text(json.dumps({**document, "status": "stopped"}))
    (folders[2] / "config.toml").write_text((folders[2] / "config.toml").read_text() + "#")
    untouched = (folders[3] / "result.json").stat().st_mtime_ns
    (out / "runs" / f".{folders[0].name}.partial").mkdir()
    capsys.readouterr()
    assert sweep(tiny, out, *words) == 0
    assert "1 of 4 runs are done already" in capsys.readouterr().err
    assert contents(out) == before
    assert (folders[3] / "result.json").stat().st_mtime_ns == untouched


@pytest.mark.usefixtures("in_this_process")
def test_keep_all_brings_back_whole_run_folders(tiny, tmp_path, capsys):
    words = ["--vary", "method=naive", "--workers", "1"]
    assert sweep(tiny, tmp_path / "out", *words) == 0
    assert sweep(tiny, tmp_path / "out", *words, "--keep", "all") == 0
    (folder,) = (tmp_path / "out" / "runs").iterdir()
    names = {path.name for path in folder.iterdir()}
    assert names >= {"config.toml", "result.json", "rollouts.npz", "run.rrd"}
    assert sweep(tiny, tmp_path / "out", *words, "--keep", "all") == 0
    assert "1 of 1 runs are done already" in capsys.readouterr().err


@pytest.mark.usefixtures("in_this_process")
def test_an_error_model_of_ones_own_travels_with_the_run(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = tmp_path / "mine.csv"
    model.write_text("distance_m,p_detected\n0,0.5\n20,0.5\n")
    words = ["--vary", "pem=mine.csv", "--vary", "method=naive", "--workers", "1"]
    assert sweep(tiny, "out", *words) == 0
    (folder,) = (tmp_path / "out" / "runs").iterdir()
    document = json.loads((folder / "result.json").read_text())
    assert document["config"]["pem"] == "mine.csv"
    assert document["pem"]["name"] == "mine"
    # the same name with other contents is another error model
    model.write_text("distance_m,p_detected\n0,0.9\n20,0.9\n")
    capsys.readouterr()
    assert sweep(tiny, "out", *words) == 0
    assert "done already" not in capsys.readouterr().err
    again = json.loads((folder / "result.json").read_text())
    assert again["pem"]["digest"] != document["pem"]["digest"]


@pytest.mark.usefixtures("in_this_process")
def test_an_error_model_in_python_is_run_where_that_is_allowed(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "swept_detector.py"
    source.write_text(
        "class Half:\n    def logit(self, salient):\n        return 0.0 * salient[..., 0]\n"
    )
    words = ["--vary", "pem=swept_detector:Half", "--vary", "method=naive", "--workers", "1"]
    assert sweep(tiny, tmp_path / "out", *words) == 2
    assert "--allow-python" in capsys.readouterr().err
    allowed = [*words, "--allow-python"]
    assert sweep(tiny, tmp_path / "out", *allowed) == 0
    (folder,) = (tmp_path / "out" / "runs").iterdir()
    assert json.loads((folder / "result.json").read_text())["pem"]["name"] == "Half"
    assert sweep(tiny, tmp_path / "out", *allowed) == 0
    assert "1 of 1 runs are done already" in capsys.readouterr().err
    # an edited module may answer otherwise
    source.write_text(f"{source.read_text()}# edited\n")
    assert sweep(tiny, tmp_path / "out", *allowed) == 0
    assert "done already" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        ([], ["nothing to start from", "--preset"]),
        (["absent.toml"], ["absent.toml", "cannot be read"]),
        (["--preset", "moon"], ["preset = 'moon'", "paper, paper-algorithm, town01"]),
        (["x.toml", "--preset", "paper"], ["give only one"]),
        (["--preset", "paper", "--vary", "alhpa=1"], ["did you mean alpha?"]),
        (["--preset", "paper", "--vary", "alpha=1,2"], ["vary alpha = 2.0", "at most 1"]),
        (["--preset", "paper", "--seeds", "0"], ["seeds = 0", "at least 1"]),
        (["--preset", "paper", "--workers", "0"], ["workers = 0", "at least 1"]),
        (["--preset", "paper", "--keep", "some"], ["some"]),
        (["--preset", "paper", "--vary", "scenario.states=3"], ["looks 99 steps ahead"]),
        (["--preset", "paper", "--workers", "2", "--scheduler", "tcp://x:1"], ["only one"]),
        (["--preset", "paper", "--scheduler", "no-address:"], ["scheduler", "no-address:"]),
        (["--preset", "paper", "--scheduler", "tcp://127.0.0.1:9"], ["cannot be reached"]),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys, monkeypatch, words, fragments):
    monkeypatch.setattr("pemviz.cluster.CONNECT_S", 1.0)  # nobody answers, however long
    assert main(["sweep", *words, "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in shown.err
    assert not (tmp_path / "out" / "sweep.csv").exists()


@pytest.mark.usefixtures("in_this_process")
def test_a_run_that_fails_is_told_tried_again_and_the_rest_goes_on(tiny, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--vary", "step_time_limit_s=1e-9,600", "--vary", "method=naive", "--workers", "1"]
    assert sweep(tiny, out, *words) == 3
    shown = capsys.readouterr()
    failed = [line for line in shown.err.splitlines() if line.startswith("failed: ")]
    assert len(failed) == 2
    assert all("a step took longer" in line for line in failed)
    assert [line.endswith("it is tried once more") for line in failed] == [True, False]
    assert "1 of 2 runs are done" in shown.err
    failed, done = rows_of(out)
    assert (failed["status"], failed["probability"], done["status"]) == ("failed", "", "done")
    assert "took longer" in failed["message"]
    assert "## Failed" in (out / "summary.md").read_text()
    document = json.loads((out / failed["run_folder"] / "result.json").read_text())
    assert document["status"] == "failed"


def test_without_dask_a_scheduler_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pemviz.cluster.find_spec", lambda name: None)
    words = ["--preset", "paper", "--scheduler", "tcp://x:1", "--out", str(tmp_path / "out")]
    assert main(["sweep", *words]) == 2
    assert "pip install 'pemviz[sweep]'" in capsys.readouterr().err


def test_a_second_sweep_in_the_same_folder_is_refused(tiny, tmp_path, capsys):
    with sweep_folder(tmp_path / "out"):
        assert sweep(tiny, tmp_path / "out", "--vary", "method=naive") == 2
    shown = capsys.readouterr()
    assert "another sweep is at work there" in shown.err
    assert shown.err.count("\n") == 1


def test_an_out_that_is_a_file_is_one_line(tiny, tmp_path, capsys):
    assert sweep(tiny, tiny, "--vary", "method=naive") == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_sweep_goes_on_where_it_was(serial, tiny, tmp_path, capsys, number):
    out = tmp_path / "out"
    words = ["sweep", str(tiny), "--out", str(out), *VARIED, "--workers", "1"]
    with subprocess.Popen(
        [sys.executable, "-m", "pemviz", *words], stderr=subprocess.PIPE, text=True, cwd=ROOT,
        stdout=subprocess.DEVNULL, start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("1 of 4"):
                os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(
                    number
                )
                break
        rest = process.stderr.read()
    assert "Traceback" not in rest
    if number != signal.SIGKILL:
        assert process.returncode == 3
        assert re.search(r"pemviz: \d of 4 runs are done; the same command again", rest)
        statuses = [row["status"] for row in rows_of(out)]
        assert statuses.count("done") == int(re.findall(r"pemviz: (\d) of 4", rest)[0])
        assert set(statuses) == {"done", "not run"}
    kept = {p: p.stat().st_mtime_ns for p in out.glob("runs/[!.]*/result.json")}
    assert 1 <= len(kept) < 4
    assert main(words) == 0
    assert f"{len(kept)} of 4 runs are done already" in capsys.readouterr().err
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert contents(out) == contents(serial)


@pytest.mark.slow
def test_a_sweep_killed_outright_leaves_no_process_behind(tiny, tmp_path):
    words = ["sweep", str(tiny), "--out", str(tmp_path / "out"), "--seeds", "500", "--workers", "1"]
    environment = {**os.environ, "TMPDIR": str(tmp_path / "scratch")}
    (tmp_path / "scratch").mkdir()
    with subprocess.Popen(
        [sys.executable, "-m", "pemviz", *words], stderr=subprocess.PIPE, text=True, cwd=ROOT,
        stdout=subprocess.DEVNULL, env=environment,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("1 of 500"):
                process.kill()
                break
        # the worker shares this pipe: it ends when the worker does
        process.stderr.read()
    for _ in range(100):
        left = list((tmp_path / "scratch").glob("pemviz-*"))  # torch has folders of its own
        if not left:
            break
        time.sleep(0.1)
    assert left == []


@pytest.mark.usefixtures("in_this_process")
def test_a_run_that_was_edited_is_named_and_carried_out_again(tiny, tmp_path, capsys, caplog):
    words = ["--vary", "method=monte-carlo", "--seeds", "2", "--workers", "1"]
    assert sweep(tiny, tmp_path, *words) == 0
    before = contents(tmp_path)
    path = sorted((tmp_path / "runs").iterdir())[1] / "result.json"
    document = json.loads(path.read_text())
    document["estimate"]["ci_high"] /= 100
    path.write_text(json.dumps(document))
    capsys.readouterr()
    assert sweep(tiny, tmp_path, *words) == 0
    assert "1 of 2 runs are done already" in capsys.readouterr().err
    assert str(path) in caplog.text
    assert "the run counts as not done" in caplog.text
    assert contents(tmp_path) == before
