"""``pemviz open`` shows a recording on this machine only and leaves nothing behind."""

import http.client
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from pemviz.errors import InputError
from pemviz.recording.open import (
    OpenArguments,
    find_recording,
    open_recording,
    quiet_environment,
    viewer_process,
    viewer_program,
)

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
OPEN = """
import sys
from pathlib import Path
from pemviz.recording.open import OpenArguments, open_recording
sys.exit(open_recording(OpenArguments(target=Path(sys.argv[1]), web=True, no_browser=True)))
"""


@contextmanager
def shown(folder):
    """The process that shows a run in the browser, and the page's address."""
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", OPEN, str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        yield process, urlsplit(process.stdout.readline().strip())
    finally:
        process.send_signal(signal.SIGINT)
        if process.poll() is None:
            process.communicate(timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def opened(learned):
    with shown(learned.folder) as process_and_address:
        yield process_and_address


def get(address, path, **headers):
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=PATIENCE_S)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def listening(process):
    """Addresses that a process and its children listen on."""
    everyone = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    return {
        connection.laddr.ip
        for one in everyone
        for connection in one.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }


def test_web_viewer_and_recording_come_from_one_loopback_address(opened, learned):
    process, address = opened
    assert address.hostname == "127.0.0.1"
    recording = urlsplit(parse_qs(address.query)["url"][0])
    assert recording.netloc == address.netloc
    answer, body = get(address, recording.path)
    assert answer.status == 200
    assert body == learned.path.read_bytes()
    answer, body = get(address, f"/?{address.query}")
    assert answer.status == 200
    assert b"Rerun Viewer" in body
    answer, body = get(address, "/re_viewer.js")
    assert answer.status == 200
    assert len(body) > 10_000
    assert listening(process) == {"127.0.0.1"}


def test_the_browser_is_told_to_fetch_nothing_from_outside(opened):
    answer, _ = get(opened[1], "/")
    policy = answer.getheader("Content-Security-Policy") or ""
    assert policy.startswith("default-src 'self'")
    assert "http" not in policy
    assert "*" not in policy
    assert answer.getheader("Access-Control-Allow-Origin") is None


def test_a_foreign_name_for_this_machine_is_refused(opened):
    for path in ("/run.rrd", "/"):
        answer, _ = get(opened[1], path, Host="attacker.example:80")
        assert answer.status == 403
    answer, _ = get(opened[1], "/absent")
    assert answer.status == 404


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_cleanly_with_its_child(learned, number):
    with shown(learned.folder) as (process, address):
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) == 1
        process.send_signal(number)
        _, complaint = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaint
    assert complaint == ""
    assert not any(child.is_running() for child in children)
    with pytest.raises(ConnectionRefusedError):
        get(address, "/")


def stubborn_viewer(folder: Path) -> Path:
    """A program that notes its arguments and ignores a polite request to end."""
    program = folder / "viewer"
    program.write_text(
        f"#!{sys.executable}\n"
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "open(sys.argv[0] + '.arguments', 'w').write(' '.join(sys.argv[1:]))\n"
        "time.sleep(600)\n"
    )
    program.chmod(0o755)
    return program


def test_a_viewer_that_does_not_end_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("pemviz.recording.open.ENDING_S", 0.2)
    with viewer_process(["a", "b"], program=stubborn_viewer(tmp_path)) as process:
        noted = tmp_path / "viewer.arguments"
        end = time.monotonic() + PATIENCE_S
        while not (noted.exists() and noted.read_text()) and time.monotonic() < end:
            time.sleep(0.02)
        assert noted.read_text().split() == ["a", "b"]
    assert process.returncode == -signal.SIGKILL


def test_the_native_viewer_is_bound_to_loopback(tmp_path, monkeypatch, learned):
    program = tmp_path / "viewer"
    program.write_text('#!/bin/sh\necho "$@" > "$0.arguments"\n')
    program.chmod(0o755)
    monkeypatch.setattr("pemviz.recording.open.viewer_program", lambda: program)
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_recording(OpenArguments(target=learned.folder)) == 0
    words = (tmp_path / "viewer.arguments").read_text().split()
    assert words == [str(learned.path), "--bind", "127.0.0.1", "--port", "auto"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have a display")
def test_without_a_display_the_web_viewer_is_offered(learned, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="--web"):
        open_recording(OpenArguments(target=learned.folder))


def test_what_is_no_recording_is_one_line(tmp_path):
    (tmp_path / "other.rrd").write_bytes(b"something else")
    (tmp_path / "run").mkdir()
    for target, words in (
        (tmp_path / "absent.rrd", "no recording"),
        (tmp_path / "run", "no recording"),
        (tmp_path / "other.rrd", "not a rerun recording"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            find_recording(target)
        assert "\n" not in str(caught.value)


def test_a_taken_port_is_one_line(learned, opened):
    with pytest.raises(InputError, match="port"):
        open_recording(
            OpenArguments(target=learned.folder, web=True, port=opened[1].port, no_browser=True)
        )


def test_the_viewer_sends_no_usage_statistics():
    done = subprocess.run(
        [viewer_program(), "--version"], env=dict(quiet_environment()), capture_output=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0
    assert quiet_environment()["CI"]
