"""The panel's server: pages of our own, a scene of viser's for each, and what they ask for."""

import logging
from dataclasses import replace
from typing import Any

import viser

from pemviz.config.toml_files import load_preset
from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.panel.arguments import Arguments
from pemviz.panel.controller import Controller
from pemviz.panel.hub import Hub
from pemviz.panel.loading import load_run
from pemviz.panel.new_run_place import NewRunPlace
from pemviz.panel.process_memory import give_back
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.run_place import RunPlace
from pemviz.panel.runs_place import RunsPlace
from pemviz.panel.scene import look_from_first_view
from pemviz.panel.server import guarded_server, scene_of
from pemviz.panel.shared_state import shared_state
from pemviz.panel.site import OwnPages, Page

LOG = logging.getLogger(__name__)

QUICK_ROLLOUTS = 200


class App:
    """The server and its pages.

    Attributes:
        server: viser's server.
    """

    def __init__(self, hub: Hub, *, host: str, port: int) -> None:
        """Start serving.

        Raises:
            InputError: The address cannot be bound.
        """
        self._hub = hub
        self._tokens: dict[int, str] = {}
        runs = RunsPlace(hub)
        requests = {
            **runs.requests,
            **RunPlace(runs.run).requests,
            **NewRunPlace(hub, runs.run).requests,
            "stop": self._stop,
        }
        self._site = OwnPages(
            requests,
            version=lambda: hub.controller.state.version,
            state=lambda: shared_state(hub.controller.state),
            download=runs.download,
        )
        self.server = server = guarded_server(host=host, port=port, site=self._site)
        look_from_first_view(server)
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """The port bound."""
        return self.server.get_port()

    def stop(self) -> None:
        """End the server."""
        self.server.stop()

    def _stop(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        self._hub.controller.stop()
        return True

    def _connect(self, client: viser.ClientHandle) -> None:
        token = scene_of(self.server, client)
        self._tokens[client.client_id] = token
        self._site.connect_scene(token, client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        token = self._tokens.pop(client.client_id, None)
        if token is not None:
            self._site.disconnect_scene(token, client)
            give_back()


def show_something(controller: Controller, recordings: RecordingsFolder) -> None:
    """Show the newest readable run, else the shipped sample, else a quick look that is not kept."""
    sample = sample_run()
    shipped = [] if sample is None else [sample]
    own = (name for name in recordings.names() if all(name != each.name for each in shipped))
    for folder in (*(recordings.root / name for name in own), *shipped):
        try:
            controller.show(load_run(folder))
        except InputError as error:
            LOG.warning("%s", error)
        else:
            return
    quick = replace(load_preset("paper"), method="naive", final_rollouts=QUICK_ROLLOUTS, plan=False)
    controller.start(quick, keep=False)
