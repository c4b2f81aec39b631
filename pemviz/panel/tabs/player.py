"""The Rollout panel beneath the scene: play, pause, speed, scrub, follow, plots against time."""

import time
from collections.abc import Callable
from typing import Literal

import viser

from pemviz.panel.browser import Browser, set_html
from pemviz.panel.page_layout import Window
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData
from pemviz.panel.scene import FIRST_VIEW_POSITION, FIRST_VIEW_TARGET, Scene
from pemviz.panel.views.page import ROLLOUT, SHEET
from pemviz.panel.views.rollout import Track, track, track_plots, with_cursor

Key = Literal["space", "arrowleft", "arrowright"]

SPEEDS = {"0.1x": 0.1, "0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0}
STEP_HINT = "State of the rollout; drag to scrub. Keys: arrow left, arrow right."
PLAY_HINT = "Play and pause (key: space), start again, speed as a multiple of real time."
PLOT_PAUSE_S = 0.12
FROM_BEHIND, FROM_ABOVE = "from behind", "from above"
VIEWS = {
    FROM_BEHIND: (FIRST_VIEW_POSITION, FIRST_VIEW_TARGET),
    FROM_ABOVE: ((17.0, -9.5, 75.0), (17.0, -9.0, 0.0)),
}
"""Where the camera stands, and what it looks at; the rollout's plots cover what lies below."""


class Player:
    """Plays one rollout in this browser's scene."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.playing = False
        self._key: object = None
        self.track: Track | None = None
        self._pieces: tuple[str, ...] = ()
        self._step = 0
        self._began: tuple[float, int] = (0.0, 0)
        self._plotted_s = 0.0
        self._speed = 1.0
        self.scene = Scene(browser.client.scene)
        self.window = Window(browser.client, at_top=False)
        with self.window.panel.add_tab("Rollout", viser.Icon.MOVIE):
            self._add_controls()

    def show(self, run: RunData, entry: RankedRow) -> None:
        """Show a rollout; nothing changes if it is the one shown."""
        key = (self._browser.selections, run.name, entry.repetition, entry.stage, entry.rollout)
        if key == self._key:
            return
        chosen = self.track = track(run, entry)
        self._key = key
        self._pieces = track_plots(chosen)
        self.playing = False
        with self._browser.client.atomic():
            self.slider.max = chosen.states - 1
            self.scene.show(chosen)
            self._go_to(chosen.interesting_step)

    def look_from(self, view: str) -> None:
        """Put the camera where a view of that name is taken from."""
        camera = self._browser.client.camera
        position, target = VIEWS[view]
        camera.position, camera.look_at = position, target

    @property
    def contact_words(self) -> str:
        """When and how fast the cars of the rollout shown touch, if they do."""
        return "" if self.track is None else self.track.drawn.contact_words

    def advance(self) -> None:
        """Move on with the time that has passed, while playing."""
        chosen = self.track
        if not self.playing or chosen is None:
            return
        began_s, first = self._began
        passed = (time.monotonic() - began_s) * self._speed
        step = min(first + int(passed / chosen.dt_s), chosen.states - 1)
        if step != self._step:
            self._go_to(step)
        if step == chosen.states - 1:
            self._pause()

    def _add_controls(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        gui.add_html(f"{SHEET}<div class='{ROLLOUT}'></div>")
        self.slider = gui.add_slider("Step", 0, 99, 1, 0, hint=STEP_HINT)
        buttons = ("Play", "Pause", "Restart", *SPEEDS)
        self.play = gui.add_button_group("Playback", buttons, hint=PLAY_HINT)
        self._plots = gui.add_html("")
        self.slider.on_update(browser.on(self._scrub))
        self.play.on_click(browser.on(self._play_clicked))
        self._key_for("Play or pause", "space", self._toggle)
        self._key_for("Step back", "arrowleft", lambda: self._nudge(-1))
        self._key_for("Step ahead", "arrowright", lambda: self._nudge(1))

    def _key_for(self, label: str, key: Key, work: Callable[[], None]) -> None:
        command = self._browser.client.gui.add_command(label, hotkey=key)
        command.on_trigger(self._browser.on(work))

    def _go_to(self, step: int) -> None:
        chosen = self.track
        if chosen is None:
            return
        self._step = min(max(step, 0), chosen.states - 1)
        with self._browser.client.atomic():
            self.scene.at(self._step)
            self.slider.value = self._step
            now_s = time.monotonic()
            if not self.playing or now_s - self._plotted_s >= PLOT_PAUSE_S:
                self._plotted_s = now_s
                page = with_cursor(self._pieces, chosen, self._step, speed=self._speed)
                set_html(self._plots, page)

    def _scrub(self) -> None:
        self._pause()
        self._go_to(self.slider.value)

    def _nudge(self, by: int) -> None:
        self._pause()
        self._go_to(self._step + by)

    def _toggle(self) -> None:
        if self.playing:
            self._pause()
        else:
            self._play()

    def _play_clicked(self) -> None:
        word = self.play.value
        if word in SPEEDS:
            self._set_speed(SPEEDS[word])
        elif word == "Pause":
            self._pause()
        else:
            if word == "Restart":
                self._go_to(0)
            self._play()

    def _play(self) -> None:
        if self.track is None:
            return
        if self._step >= self.track.states - 1:
            self._go_to(0)
        self.playing = True
        self._began = (time.monotonic(), self._step)

    def _pause(self) -> None:
        if self.playing:
            self.playing = False
            self._go_to(self._step)

    def _set_speed(self, speed: float) -> None:
        self._speed = speed
        self._began = (time.monotonic(), self._step)
        self._go_to(self._step)

    def follow(self, follow: bool) -> None:
        """Whether the view keeps up with the ego car."""
        self.scene.follow(follow)
        self._go_to(self._step)
