"""The scene of one page: a view of viser's within it, which shows the newest of what is wanted.

A page says which rollout, at which step and from where; however fast it does, the thread of its
scene draws the newest wish alone, so that nothing queues up behind a slow browser.
"""

import logging
import threading
from dataclasses import dataclass, replace

import viser

from pemviz.panel.scene import FIRST_VIEW_POSITION, FIRST_VIEW_TARGET, Scene
from pemviz.runs.drawn_rollout import DrawnRollout

LOG = logging.getLogger(__name__)

Place = tuple[float, float, float]
VIEWS: dict[str, tuple[Place, Place]] = {
    "from behind": (FIRST_VIEW_POSITION, FIRST_VIEW_TARGET),
    "from above": ((14.0, -0.5, 46.0), (14.0, 0.0, 0.0)),
}
"""Where the camera stands, and what it looks at."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What a page wants to see; ``looks`` counts how often it asked for a view."""

    drawn: DrawnRollout | None = None
    step: int = 0
    follow: bool = True
    dark: bool = False
    view: str = "from behind"
    looks: int = 0


class PageScene:
    """A page's scene; every method returns at once, from any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._wish = Wish()
        self._client: viser.ClientHandle | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._live, name="pemviz-scene", daemon=True)
        self._thread.start()

    def connect(self, client: viser.ClientHandle) -> None:
        """Draw for a client of viser's, which takes the place of one before."""
        with self._changed:
            self._client = client
            self._changed.notify()

    def disconnect(self, client: viser.ClientHandle) -> None:
        """The client is gone."""
        with self._changed:
            if self._client is client:
                self._client = None

    def close(self) -> None:
        """The page is gone."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def show(self, drawn: DrawnRollout, *, step: int) -> None:
        """Show another rollout, at a step."""
        self._want(replace(self._wish, drawn=drawn, step=step))

    def at(self, step: int, *, follow: bool) -> None:
        """Move to a step of the rollout, and keep up with the ego car or not."""
        self._want(replace(self._wish, step=step, follow=follow))

    def look(self, view: str) -> None:
        """Put the camera where a view is seen from."""
        self._want(replace(self._wish, view=view, looks=self._wish.looks + 1))

    def color(self, *, dark: bool) -> None:
        """Light or dark, as the page is."""
        self._want(replace(self._wish, dark=dark))

    def _want(self, wish: Wish) -> None:
        with self._changed:
            self._wish = wish
            self._changed.notify()

    def _live(self) -> None:
        client, scene, shown = None, None, Wish()
        while True:
            with self._changed:
                while not self._closed and self._client is client and self._wish is shown:
                    self._changed.wait()
                if self._closed:
                    return
                wish = self._wish
                if self._client is not client:
                    client, scene, shown = self._client, None, Wish()
            if client is None:
                shown = wish
                continue
            try:
                if scene is None:
                    scene = Scene(client.scene)
                _draw(client, scene, wish, shown=shown)
            except BaseException:  # the client may be gone in the middle of it
                LOG.debug("a scene was not drawn", exc_info=True)
            shown = wish


def _draw(client: viser.ClientHandle, scene: Scene, wish: Wish, *, shown: Wish) -> None:
    """Have a client show a wish, where it is another than the one shown."""
    with client.atomic():
        if wish.dark != shown.dark:
            client.gui.configure_theme(
                dark_mode=wish.dark, show_logo=False, show_share_button=False
            )
        if wish.looks != shown.looks:
            client.camera.position, client.camera.look_at = VIEWS[wish.view]
        if wish.drawn is None:
            return
        if wish.drawn is not shown.drawn:
            scene.show(wish.drawn)
        scene.follow = wish.follow
        scene.at(min(wish.step, wish.drawn.count - 1))
