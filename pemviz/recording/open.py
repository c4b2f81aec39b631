"""``pemviz open``: a recording in rerun's native viewer or in the browser, on this machine.

In the browser it is rerun's packaged viewer. Rerun's own server hands out the viewer's files;
:func:`web_viewer` stands before it, so that viewer and recording have one origin, pages elsewhere
cannot read the recording, and the browser is told to fetch nothing from outside this machine.
"""

import http.client
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import FrameType
from typing import Annotated, Any
from urllib.parse import urlencode, urlsplit

import rerun_cli
import tyro

from pemviz.config.ranges import Range
from pemviz.errors import InputError, RunError
from pemviz.files.atomic import is_folder

RECORDING_NAME = "run.rrd"
MAGIC = b"RRF"
LOOPBACK = "127.0.0.1"
ENDING_S = 5.0
WAKE_S = 0.5
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


@dataclass(frozen=True, kw_only=True)
class OpenArguments:
    """Options of ``pemviz open``."""

    target: Annotated[Path, tyro.conf.Positional]
    """A run folder, or a recording (.rrd)."""
    web: bool = False
    """Show it in the browser; nothing is fetched from outside this machine."""
    port: Annotated[int, Range(low=0, high=65535)] = 0
    """Port of the page with --web, on the loopback interface; 0 takes a free one."""
    no_browser: bool = False
    """With --web, print the address and leave opening it to you."""


def open_recording(arguments: OpenArguments) -> int:
    """Show a recording until the viewer is closed or the user presses Ctrl-C; returns 0.

    Raises:
        InputError: There is no such recording, the port is taken, or there is no display.
        RunError: The viewer failed.
    """
    path = find_recording(arguments.target)
    with _ends_like_ctrl_c():
        try:
            if arguments.web:
                _show_in_browser(path, port=arguments.port, no_browser=arguments.no_browser)
            else:
                _show_natively(path)
        except KeyboardInterrupt:
            pass
    return 0


def find_recording(target: Path) -> Path:
    """The recording that a run folder or file stands for.

    Raises:
        InputError: There is none, or it is not a recording.
    """
    path = target / RECORDING_NAME if is_folder(target) else target
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
    except OSError as error:
        message = f"open {target}: there is no recording {path} ({error.strerror or error})"
        raise InputError(message) from error
    if start != MAGIC:
        message = f"open {target}: {path} is not a rerun recording"
        raise InputError(message)
    return path.resolve()


def viewer_program() -> Path:
    """Rerun's own program; the ``rerun`` script would leave it running when ended.

    Raises:
        RunError: It is not installed.
    """
    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "rerun.exe"):
        if (folder / name).is_file():
            return folder / name
    message = f"the viewer is missing from {folder}: install rerun-sdk again"
    raise RunError(message)


def quiet_environment() -> Mapping[str, str]:
    """The viewer's environment: it sends its makers no usage statistics where CI is set."""
    return {**os.environ, "CI": "1"}


@contextmanager
def viewer_process(
    arguments: Sequence[str], *, program: Path | None = None
) -> Generator[subprocess.Popen[bytes], None, None]:
    """Rerun with these arguments, ended on leaving.

    It gets a session of its own, so that Ctrl-C reaches this process alone, which ends it.
    """
    command = [str(program or viewer_program()), *arguments]
    with subprocess.Popen(  # noqa: S603  the packaged program, arguments of our own
        command,
        env=quiet_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(timeout=ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _show_natively(path: Path) -> None:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        message = "open: there is no display for the native viewer; give --web"
        raise InputError(message)
    with viewer_process([str(path), "--bind", LOOPBACK, "--port", "auto"]) as viewer:
        code = viewer.wait()
    if code != 0:
        message = f"the viewer ended with code {code}; --web needs no graphics driver"
        raise RunError(message)


def _show_in_browser(path: Path, *, port: int, no_browser: bool) -> None:
    with web_viewer(path, port=port) as address:
        print(f"{address}\nCtrl-C ends it.", flush=True)
        if not no_browser:
            webbrowser.open(address)
        while True:
            time.sleep(WAKE_S)  # a signal interrupts


@contextmanager
def _ends_like_ctrl_c() -> Generator[None, None, None]:
    """SIGTERM, and the terminal's closing, end the viewer as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        raise KeyboardInterrupt

    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    previous = {n: signal.signal(n, interrupt) for n in (signal.Signals[s] for s in names)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def web_viewer(path: Path, *, port: int) -> Generator[str, None, None]:
    """Serve a recording with the viewer at a port, 0 for a free one; yields the page's address.

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
        with viewer_process([*arguments, page + RECORDING_PATH]) as process:
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


def wait_for_port(
    port: int, process: subprocess.Popen[bytes], *, timeout_s: float = START_S
) -> None:
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
