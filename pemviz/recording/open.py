"""``pemviz open``: a recording in rerun's native viewer or in the browser, on this machine."""

import os
import signal
import subprocess
import sys
import time
import webbrowser
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import rerun_cli
import tyro

from pemviz.config.ranges import Range
from pemviz.errors import InputError, RunError
from pemviz.files.atomic import is_folder
from pemviz.recording.web import web_viewer

RECORDING_NAME = "run.rrd"
MAGIC = b"RRF"
LOOPBACK = "127.0.0.1"
ENDING_S = 5.0
WAKE_S = 0.5


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
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
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
    with web_viewer(path, port=port, start=viewer_process) as address:
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
