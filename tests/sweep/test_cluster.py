import os
import signal
import threading
import time

import pytest

from pemviz.cli.main import main
from tests.sweep.conftest import VARIED, contents

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Two worker processes; pemviz is theirs to import, as on a real cluster."""
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        local_directory=str(tmp_path_factory.mktemp("dask")),
        silence_logs=50,
    ) as cluster:
        yield cluster


def worker_pids(cluster) -> list[int]:
    with distributed.Client(cluster, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


def kill_when_something_is_done(pid, out):
    while not list(out.glob("runs/[!.]*")):
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)


def test_a_cluster_gives_the_bytes_of_one_process(serial, cluster, tiny, tmp_path):
    words = [str(tiny), *VARIED, "--out", str(tmp_path / "out")]
    assert main(["sweep", *words, "--scheduler", cluster.scheduler_address]) == 0
    assert contents(tmp_path / "out") == contents(serial)


def test_a_worker_killed_in_the_middle_changes_nothing(serial, cluster, tiny, tmp_path, capsys):
    out = tmp_path / "out"
    pid = worker_pids(cluster)[0]
    killer = threading.Thread(target=kill_when_something_is_done, args=(pid, out))
    killer.start()
    words = [str(tiny), *VARIED, "--out", str(out), "--scheduler", cluster.scheduler_address]
    assert main(["sweep", *words]) == 0
    killer.join()
    assert pid not in worker_pids(cluster)
    assert contents(out) == contents(serial)
    assert "Traceback" not in capsys.readouterr().err


def test_a_scheduler_that_goes_away_is_one_line(tiny, tmp_path, capsys):
    out = tmp_path / "out"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", silence_logs=50
    ) as cluster:
        ender = threading.Thread(target=end_when_something_is_done, args=(cluster, out))
        ender.start()
        words = [str(tiny), "--seeds", "50", "--out", str(out)]
        assert main(["sweep", *words, "--scheduler", cluster.scheduler_address]) == 3
        ender.join()
    shown = capsys.readouterr()
    assert "the connection is lost" in shown.err
    assert "of 50 runs are done; the same command again does the rest" in shown.err
    assert (out / "sweep.csv").exists()


def end_when_something_is_done(cluster, out):
    while not list(out.glob("runs/[!.]*")):
        time.sleep(0.05)
    cluster.close()
