import contextlib
import gc
import io
import json

import pytest

from pemviz.cli.main import main

HIGHWAY = ["--method", "mixture", "--no-plan", "--simulator", "highway-env", "--stages", "1",
           "--rollouts", "12", "--final-rollouts", "12", "--no-recording", "--json",
           "--no-measured-memory", "--scenario.states", "30", "--scenario.initial-gap-m", "10.5",
           "--spec", "always[0,29] (gap >= 9.0)"]  # fmt: skip


def record(tmp_path, capsys, *words):
    assert main(["record", "--out", str(tmp_path), *HIGHWAY, *words]) == 0
    document = json.loads(capsys.readouterr().out)
    (folder,) = tmp_path.iterdir()
    for name in ("run_id", "timings_s"):
        del document[name]
    return document, (folder / "rollouts.npz").read_bytes()


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("serial")
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["record", "--out", str(folder), *HIGHWAY]) == 0
    document = json.loads(out.getvalue())
    for name in ("run_id", "timings_s"):
        del document[name]
    (run,) = folder.iterdir()
    return document, (run / "rollouts.npz").read_bytes()


def test_two_processes_give_the_bytes_of_this_one(serial, tmp_path, capsys):
    assert record(tmp_path, capsys, "--workers", "2") == serial


@pytest.mark.slow
def test_a_cluster_gives_the_bytes_of_this_process(serial, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        found = record(tmp_path, capsys, "--scheduler", cluster.scheduler_address)
    assert found == serial


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of its jobs
def test_jobs_of_a_batch_system_give_the_bytes_of_this_process(serial, tmp_path, capsys):
    """Jobs that dask-jobqueue writes; the shell runs them here, in place of SLURM."""
    local = pytest.importorskip("dask_jobqueue.local")
    with local.LocalCluster(
        cores=1,
        processes=1,
        memory="1GB",
        local_directory=str(tmp_path / "work"),
        log_directory=str(tmp_path / "logs"),
        scheduler_options={"dashboard_address": ":0", "host": "127.0.0.1"},
    ) as cluster:
        cluster.scale(jobs=2)
        cluster.wait_for_workers(1)
        out = tmp_path / "out"
        found = record(out, capsys, "--scheduler", cluster.scheduler_address)
    del cluster
    gc.collect()  # while what it leaves open is no failure
    assert found == serial


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["--simulator", "vectorized", "--workers", "2"], "no use for it"),
        (["--method", "splitting", "--workers", "2"], "in this process alone"),
        (["--workers", "0"], "workers = 0"),
        (["--workers", "2", "--scheduler", "tcp://x:1"], "give only one"),
        (["--scheduler", "nonsense"], "an address has a port"),
    ],
)
def test_workers_that_could_not_help_are_refused(tmp_path, capsys, words, fragment):
    assert main(["record", "--out", str(tmp_path), *HIGHWAY, *words]) == 2
    shown = capsys.readouterr()
    assert fragment in shown.err
    assert shown.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_scheduler_that_is_not_there_leaves_no_run(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("pemviz.cluster.CONNECT_S", 0.5)
    words = ["record", "--out", str(tmp_path), *HIGHWAY, "--scheduler", "tcp://127.0.0.1:9"]
    assert main(words) == 2
    assert "cannot be reached" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
