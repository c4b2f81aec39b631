"""A connected browser as the tabs see it, what all browsers share, and the windows of its page.

Callbacks of controls run on viser's threads and only put work into the browser's queue; the
session's thread does it.
"""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import viser

from pemviz.panel.controller import Controller
from pemviz.panel.loading import LoadedRuns
from pemviz.panel.page import MARGIN_PX, NARROWEST_PX, ROLLOUT_PX, SHORT_PX
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.run_data import RunData

Value = TypeVar("Value")
OpenRecording = Callable[[Path], str]


@dataclass(frozen=True)
class Hub:
    """What all browsers share.

    Attributes:
        open_recording: Serves a recording to a viewer and returns the viewer's address;
            ``None`` where there is no viewer.
    """

    controller: Controller
    recordings: RecordingsFolder
    open_recording: OpenRecording | None = None
    loaded: LoadedRuns = field(default_factory=LoadedRuns)


class Browser:
    """A connected browser: its own selection, and the queue of what it asks for.

    Attributes:
        loaded: The run that it loaded; ``None`` while it looks at the one that all share.
        selections: How often it has chosen which run to look at.
        shown_version: The version of the shared state that its page shows; -1: to be refreshed.
    """

    def __init__(self, client: viser.ClientHandle, hub: Hub) -> None:
        self.client = client
        self.hub = hub
        self.loaded: RunData | None = None
        self.selections = 0
        self.shown_version = -1
        self._closed = threading.Event()
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._later: Callable[[], None] | None = None

    @property
    def closed(self) -> bool:
        """Whether the browser is gone."""
        return self._closed.is_set()

    def close(self) -> None:
        """The browser is gone."""
        self._closed.set()
        self.post(_nothing)

    def post(self, work: Callable[[], None]) -> None:
        """Have the session's thread do something."""
        self._work.put(work)

    def beside(
        self,
        work: Callable[[], Value],
        then: Callable[[Value], None],
        *,
        ended: Callable[[], None] | None = None,
    ) -> None:
        """Do ``work`` on a thread of its own, and have the session's thread do ``then`` with it.

        What ``work`` raises is raised there, and told to the person; ``ended`` is done before
        either.
        """

        def carry_out() -> None:
            try:
                outcome = partial(then, work())
            except BaseException as error:  # the session's thread tells it
                outcome = partial(_fail, error)
            if ended is not None:
                self.post(ended)
            self.post(outcome)

        threading.Thread(target=carry_out, name="pemviz-beside", daemon=True).start()

    def later(self, work: Callable[[], None]) -> None:
        """Have the session's thread do something, in place of what waits, once it is idle.

        Only for the session's own thread.
        """
        self._later = work

    def next_work(self, *, pause_s: float) -> Callable[[], None]:
        """What to do next; nothing if ``pause_s`` seconds pass without a request."""
        try:
            return self._work.get(timeout=pause_s if self._later is None else 0.0)
        except queue.Empty:
            work, self._later = self._later, None
            return _nothing if work is None else work

    def on(self, work: Callable[[], None]) -> Callable[[Any], None]:
        """A callback for a control: does ``work`` if a person moved it, not the program."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                self.post(work)

        return callback

    def tell(self, title: str, message: str, *, color: Any = "red") -> None:
        """Show a notification in this browser."""
        self.client.add_notification(title, message, color=color, auto_close_seconds=8.0)

    def look_at(self, run: RunData | None) -> None:
        """Look at a loaded run, or with ``None`` at the one that all share."""
        self.loaded = run
        self.selections += 1
        self.refresh()

    def refresh(self) -> None:
        """Look again at the shared state at the next turn."""
        self.shown_version = -1


def _fail(error: BaseException) -> None:
    raise error


def _nothing() -> None:
    """Time passes."""


def element_id(handle: viser.GuiInputHandle[int]) -> str:
    """The id of the input's element in the page."""
    return handle._impl.uuid  # pyright: ignore[reportPrivateUsage]


class Window:
    """A window over the scene, as wide as the scene is."""

    def __init__(self, client: viser.ClientHandle, *, at_top: bool) -> None:
        """Place it: from the top down, or up from the bottom."""
        self.panel = client.gui.add_panel()
        self._client = client
        self._at_top = at_top
        self._size_px = (0, 0)

    def fit(self) -> None:
        """Lay it over the scene anew if the scene's size has changed."""
        camera = self._client.camera
        size_px = (int(camera.image_width), int(camera.image_height))
        if size_px == self._size_px:
            return
        self._size_px = size_px
        self.panel.float(
            x=MARGIN_PX,
            y=MARGIN_PX if self._at_top else -MARGIN_PX,
            width=max(size_px[0] - 2 * MARGIN_PX, NARROWEST_PX),
            height=size_px[1] if self._at_top else ROLLOUT_PX,
        )

    @property
    def is_short(self) -> bool:
        """Whether the page is too low for the analysis and the rollout's plots together."""
        return int(self._client.camera.image_height) < SHORT_PX
