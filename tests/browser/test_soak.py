"""Twenty clients at once: nothing breaks, memory stays, and the run's result is the same."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pemviz.config.toml_files import load_preset
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document
from tests.browser.light_client import LightClient

ROOT = Path(__file__).resolve().parents[2]
CLIENTS = 20
SOAK_S = float(os.environ.get("PEMVIZ_SOAK_S", "30"))
GROWTH_MB = 50.0
VARYING = ("run_id", "timings_s", "schema")  # of a folder: with digests


def resident_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+) kB", text)[1]) / 1024


def results(root: Path):
    found = {path.parent.name: json.loads(path.read_text()) for path in root.glob("*/result.json")}
    return {name: document for name, document in found.items() if document["status"] == "done"}


def wait_for_results(root: Path, count: int, *, timeout_s: float = 300.0):
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        found = results(root)
        if len(found) >= count:
            return found
        time.sleep(0.2)
    raise TimeoutError(f"{count} runs in {root}")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_twenty_clients(tmp_path):
    root, log = tmp_path / "recordings", tmp_path / "log"
    with log.open("w") as stream:
        server = subprocess.Popen(
            [sys.executable, "-u", "-m", "pemviz", "serve", "--no-browser", "--port", "0",
             "--recordings", str(root)],
            cwd=ROOT, stdout=stream, stderr=stream,
        )  # fmt: skip
    try:
        port = wait_for_port(log)
        first = LightClient(port, seed=0)
        first.wait_until_idle()  # an empty folder starts with a quick look
        assert "run" in first.ask("start", preset="paper", values={})["answer"]
        wait_for_results(root, 1)
        first.close()
        time.sleep(2.0)
        before_mb = resident_mb(server.pid)
        clients = [LightClient(port, seed=seed) for seed in range(CLIENTS)]
        for client in clients:
            client.wait_until_idle()
        assert "run" in clients[0].ask("start", preset="paper", values={})["answer"]
        acts, end_s = 0, time.monotonic() + SOAK_S
        while time.monotonic() < end_s:
            for client in clients:
                client.act()
                acts += 1
            time.sleep(0.1)
        second = wait_for_results(root, 2)
        for client in clients:
            client.close()
        time.sleep(5.0)
        growth_mb = resident_mb(server.pid) - before_mb
        print(f"{acts} acts of {CLIENTS} clients in {SOAK_S:g} s; memory grew {growth_mb:.1f} MB")
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(30)
    text = log.read_text()
    assert "Traceback" not in text
    assert "ERROR" not in text
    assert server.returncode == 0
    alone = result_document(run_experiment(load_preset("paper")))
    for document in second.values():
        for key in alone.keys() - set(VARYING):
            assert document[key] == json.loads(json.dumps(alone[key])), key
    assert growth_mb < GROWTH_MB


def wait_for_port(log: Path, *, timeout_s: float = 60.0) -> int:
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        found = re.search(r"the panel is at http://127.0.0.1:(\d+)", log.read_text())
        if found:
            return int(found[1])
        time.sleep(0.1)
    raise TimeoutError(log.read_text())
