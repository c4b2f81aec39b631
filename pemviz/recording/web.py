"""rerun's packaged web viewer and one recording, served on the loopback interface.

rerun's own server hands out the viewer's files; this one stands before it, so that viewer and
recording have one origin, pages elsewhere cannot read the recording, and the browser is told
to fetch nothing from outside this machine.
"""

import http.client
import shutil
import socket
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from subprocess import Popen
from threading import Thread
from typing import Any
from urllib.parse import urlencode, urlsplit

from pemviz.errors import InputError, RunError

LOOPBACK = "127.0.0.1"
RECORDING_PATH = "/run.rrd"
START_S = 30.0
TIMEOUT_S = 30.0
PASSED_ON = ("Content-Type", "Content-Length", "rerun-final-length")
POLICY = (
    "default-src 'self' blob: data:; "
    "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; "
    "frame-ancestors 'none'"
)

StartProcess = Callable[[list[str]], AbstractContextManager[Popen[bytes]]]


@contextmanager
def web_viewer(path: Path, *, port: int, start: StartProcess) -> Generator[str, None, None]:
    """Serve a recording with the viewer; yields the page's address.

    Args:
        path: The recording.
        port: Of the page; 0 takes a free one.
        start: Runs rerun with arguments until left.

    Raises:
        InputError: The port cannot be used.
        RunError: rerun's server does not start.
    """
    inner_port = free_port()
    # with an address to view, rerun serves the viewer's files and nothing else
    arguments = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(inner_port)]
    try:
        handler = partial(_Handler, path, inner_port)
        server = ThreadingHTTPServer((LOOPBACK, port), handler)
    except OSError as error:
        message = f"port = {port}: cannot be used ({error.strerror or error})"
        raise InputError(message) from error
    with server:
        page = f"http://{LOOPBACK}:{server.server_port}"
        address = f"{page}/?{urlencode({'url': page + RECORDING_PATH, 'renderer': 'webgl'})}"
        with start([*arguments, page + RECORDING_PATH]) as process:
            wait_for_port(inner_port, process)
            thread = Thread(target=server.serve_forever, daemon=True)
            thread.start()
            try:
                yield address
            finally:
                server.shutdown()
                thread.join()


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def wait_for_port(port: int, process: Popen[bytes], *, timeout_s: float = START_S) -> None:
    """Wait until the process listens.

    Raises:
        RunError: It ended, or takes too long.
    """
    end = time.monotonic() + timeout_s
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return
        time.sleep(0.05)
    message = "rerun's viewer did not start"
    raise RunError(message)


class _Handler(BaseHTTPRequestHandler):
    """Hands out the recording, and passes all else on to rerun's server."""

    def __init__(self, recording: Path, inner_port: int, *arguments: Any) -> None:
        self._recording = recording
        self._inner_port = inner_port
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Answer one request of the browser."""
        host = self.headers.get("Host", "")
        if host.rpartition(":")[0] not in (LOOPBACK, "localhost"):
            # a page elsewhere that had its name point to this machine
            self.send_error(HTTPStatus.FORBIDDEN)
        elif urlsplit(self.path).path == RECORDING_PATH:
            self._send_recording()
        else:
            self._pass_on()

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: the terminal belongs to the user."""

    def _send_recording(self) -> None:
        with self._recording.open("rb") as file:
            size = self._recording.stat().st_size
            self._start(HTTPStatus.OK, {"Content-Length": str(size)})
            if self.command == "GET":
                shutil.copyfileobj(file, self.wfile)

    def _pass_on(self) -> None:
        inner = http.client.HTTPConnection(LOOPBACK, self._inner_port, timeout=TIMEOUT_S)
        try:
            inner.request(self.command, self.path)
            answer = inner.getresponse()
            headers = {n: v for n in PASSED_ON if (v := answer.getheader(n)) is not None}
            self._start(answer.status, headers)
            shutil.copyfileobj(answer, self.wfile)
        finally:
            inner.close()

    def _start(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
