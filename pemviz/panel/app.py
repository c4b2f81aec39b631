"""The panel's server: a session for every browser, and what it shows first."""

import logging
import threading
from dataclasses import replace
from pathlib import Path

import viser

from pemviz.config.toml_files import load_preset
from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.panel.browser import Hub
from pemviz.panel.controller import Controller
from pemviz.panel.loading import load_run
from pemviz.panel.memory import give_back
from pemviz.panel.recordings import RecordingsFolder
from pemviz.panel.scene import FIRST_VIEW_FOV, FIRST_VIEW_POSITION, FIRST_VIEW_TARGET
from pemviz.panel.server import guarded_server
from pemviz.panel.session import Session
from pemviz.panel.views.page import COLUMN_PX

LOG = logging.getLogger(__name__)

QUICK_ROLLOUTS = 200


class App:
    """The server and its sessions.

    Attributes:
        server: viser's server.
    """

    def __init__(self, hub: Hub, *, host: str, port: int) -> None:
        """Start serving.

        Raises:
            InputError: The address cannot be bound.
        """
        self._hub = hub
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self.server = server = guarded_server(host=host, port=port)
        server.gui.set_panel_label("pemviz")
        server.gui.main_panel.dock_left()
        server.gui.main_panel.set_width(COLUMN_PX)
        server.initial_camera.position = FIRST_VIEW_POSITION
        server.initial_camera.look_at = FIRST_VIEW_TARGET
        server.initial_camera.fov = FIRST_VIEW_FOV
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """The port bound."""
        return self.server.get_port()

    def stop(self) -> None:
        """End all sessions and the server."""
        with self._lock:
            sessions = list(self._sessions.values())
            self._sessions.clear()
        for session in sessions:
            session.close()
        self.server.stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        session = Session(client, self._hub)
        with self._lock:
            self._sessions[client.client_id] = session
        session.start()

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
            session.join()
            del session
            give_back()


def show_something(controller: Controller, recordings: RecordingsFolder) -> None:
    """Show the shipped sample, else the newest readable run, else a quick look that is not kept."""
    candidates: list[Path] = []
    sample = sample_run()
    if sample is not None:
        candidates.append(sample)
    candidates += [recordings.root / name for name in recordings.names()]
    for folder in candidates:
        try:
            controller.show(load_run(folder))
        except InputError as error:
            LOG.warning("%s", error)
        else:
            return
    quick = replace(load_preset("paper"), method="naive", final_rollouts=QUICK_ROLLOUTS, plan=False)
    controller.start(quick, keep=False)
