"""``pemviz serve``: the panel in the browser."""

import logging
import signal
import sys
import threading
import webbrowser
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import FrameType

from pemviz.cli.parsing import Processes, parse_arguments
from pemviz.config.ranges import check_value
from pemviz.errors import EXIT_DONE, ConfigError
from pemviz.runs.events import Observer
from pemviz.runs.workers import check_one_kind

DESCRIPTION = (
    "Show the panel: set up experiments, run them, watch the proposals form, walk through the "
    "least robust rollouts in 3D. Ends with Ctrl-C."
)


@dataclass(frozen=True, kw_only=True)
class ServeArguments:
    """Options of ``pemviz serve``."""

    host: str = "127.0.0.1"
    """Address to listen on. Any but the loopback address lets others on the network use the
    panel: there is no password."""
    port: int = 8080
    """Port to listen on; 1 to 65535, or 0 for any free one."""
    recordings: Path = Path("recordings")
    """Folder of kept runs; new runs land there."""
    no_browser: bool = False
    """Do not open a browser."""
    workers: Processes | None = None
    """Processes that simulate slow simulators' rollouts; left out, one thread does. The results do
    not depend on it."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose workers do that instead."""


def run(words: Sequence[str]) -> int:
    """Serve until interrupted, and return the exit code.

    Raises:
        InputError: An argument is wrong or the port is taken.
    """
    arguments = parse_arguments(
        ServeArguments, words, command="serve", default=ServeArguments(), description=DESCRIPTION
    )
    if not 0 <= arguments.port <= 65535:
        message = f"port = {arguments.port}: must be a whole number, at least 0 and at most 65535"
        raise ConfigError(message)
    if arguments.workers is not None:
        check_value(name="workers", value=arguments.workers, annotation=Processes)
    check_one_kind(workers=arguments.workers, scheduler=arguments.scheduler)
    logging.basicConfig(format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    stopping = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    _serve(arguments, stopping)
    return EXIT_DONE


def _serve(arguments: ServeArguments, stopping: threading.Event) -> None:
    from pemviz.panel.process_memory import share_arenas  # noqa: PLC0415

    share_arenas()
    from pemviz.panel.app import App, show_something  # noqa: PLC0415  viser is slow to import
    from pemviz.panel.controller import Controller  # noqa: PLC0415
    from pemviz.panel.hub import Hub  # noqa: PLC0415
    from pemviz.panel.recordings_folder import RecordingsFolder, Viewers  # noqa: PLC0415
    from pemviz.panel.server import is_loopback  # noqa: PLC0415

    local = is_loopback(arguments.host)
    viewers = Viewers(viewer)
    controller = Controller(
        arguments.recordings,
        observers=recorders,
        workers=arguments.workers,
        scheduler=arguments.scheduler,
    )
    recordings = RecordingsFolder(arguments.recordings)
    app = App(
        Hub(
            controller=controller,
            recordings=recordings,
            open_recording=viewers.open if local else None,  # the viewer serves this machine only
        ),
        host=arguments.host,
        port=arguments.port,
    )
    address = f"http://{arguments.host}:{app.port}"
    if not local:
        print(
            f"pemviz: warning: {arguments.host} can be reached by others on the network; whoever "
            "reaches it can run experiments, read the recordings and delete them, without a "
            "password",
            file=sys.stderr,
        )
    show_something(controller, recordings)
    print(f"pemviz: the panel is at {address} (Ctrl-C ends it)", flush=True)
    if not arguments.no_browser:
        webbrowser.open(address)
    threading.Thread(target=_warm_up, name="pemviz-warm-up", daemon=True).start()
    stopping.wait()
    print("pemviz: stopping", file=sys.stderr)
    controller.close()
    app.stop()
    viewers.close()


def recorders(folder: Path) -> Sequence[Observer]:
    """Observers of a run that is kept, beside those of the panel itself."""
    from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

    return [Recorder(folder / "run.rrd")]


def viewer(path: Path) -> AbstractContextManager[str]:
    """Rerun's viewer for a recording, as a page of this machine."""
    from pemviz.recording.open import web_viewer  # noqa: PLC0415

    return web_viewer(path, port=0)


def _warm_up() -> None:
    """Import what the first run needs, while nobody waits for it."""
    for name in ("torch", "pemviz.recording.recorder"):
        import_module(name)
