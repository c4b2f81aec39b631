"""What hardly asks: the head above all tabs, and the tabs Learning and Why."""

from pemviz.analysis.starts import MOST_POINTS
from pemviz.panel.browser import Browser, element_id, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.page_layout import Window
from pemviz.panel.run_data import RunData
from pemviz.panel.tabs.chart import Chart
from pemviz.panel.tabs.trajectories import TrajectoriesTab
from pemviz.panel.views.headline import headline, status
from pemviz.panel.views.learning import learning, learning_words, proposal_curves
from pemviz.panel.views.weights import heaviest_curves, looking_at_gaps, weights_page
from pemviz.panel.views.why import why
from pemviz.reports.causes_words import SHOWN_CHAINS, shown_chains

CHAIN_HINT = (
    "Show the rollout that contributes most to the chain of misses at this place of the table "
    "below, in the scene; or click the chain there."
)

START_HINT = (
    "Show the violating rollout of this number in the plane of starts below, in the scene; or "
    "click its dot there."
)
NUMBER_HINT = (
    "Show a rollout in the scene and below: its place in the run's rollouts.npz, counted from 0; "
    "or click a point."
)


class Head:
    """The answer, the state, the progress bar."""

    def __init__(self, browser: Browser) -> None:
        gui = browser.client.gui
        self._headline = gui.add_html("")
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False, color="blue")

    def refresh(self, state: PanelState, run: RunData | None, *, limit: float | None) -> None:
        """Show the state; the answer is judged by ``limit``."""
        set_html(self._headline, headline(run, limit=limit))
        set_html(self._status, status(state))
        if self._bar.visible != state.running:
            self._bar.visible = state.running
        self._bar.value = 100.0 * state.progress.share if state.progress is not None else 0.0


class LearningTab:
    """How the proposal forms."""

    def __init__(self, browser: Browser) -> None:
        self._words = browser.client.gui.add_html("")
        self._curves = Chart(browser)
        self._page = browser.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._words, learning_words(run))
        self._curves.show(proposal_curves(run))
        set_html(self._page, learning(run))


class WeightsTab:
    """All rollouts at once; a click on one shows it."""

    def __init__(self, browser: Browser, trajectories: TrajectoriesTab, window: Window) -> None:
        gui = browser.client.gui
        self._trajectories = trajectories
        self._window = window
        self._run: RunData | None = None
        self.waiting = False
        self.number = gui.add_number("Show rollout", 0, min=0, max=10_000_000, step=1,
            hint=NUMBER_HINT)  # fmt: skip
        self._page = gui.add_html("")
        self._curves = Chart(browser)
        self.number.on_update(browser.on(self._show_rollout))
        trajectories.on_show(self._mark)

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        self._run = run
        last = max(0 if run is None else run.kept - 1, 0)
        if self.number.max != last:
            self.number.max = last
        self._curves.show(heaviest_curves(run))
        self._draw()

    def _draw(self) -> None:
        shown = self._trajectories.shown
        selected = None if shown is None or self._run is None else shown.index
        run = self._run
        self.waiting = run is not None and not run.running and looking_at_gaps(run) is not None
        page = weights_page(self._run, target=element_id(self.number), selected=selected)
        set_html(self._page, page)

    def go_on(self) -> None:
        """Tell how far the look at all rollouts is, while it goes on."""
        if self.waiting:
            self._draw()

    def _mark(self) -> None:
        """Another rollout is shown."""
        shown = self._trajectories.shown
        if shown is not None and self.number.value != shown.index:
            self.number.value = shown.index
        self._draw()

    def _show_rollout(self) -> None:
        if self._run is not None:
            self._trajectories.pick_index(int(self.number.value))
            if self._window.is_short:
                self._window.panel.minimize()


class WhyTab:
    """Which misses cause violations, and how far to trust the number; a chain opens in 3D."""

    def __init__(self, browser: Browser, trajectories: TrajectoriesTab, window: Window) -> None:
        gui = browser.client.gui
        self._trajectories = trajectories
        self._window = window
        self._run: RunData | None = None
        self.chain = gui.add_number(
            "Show chain", 0, min=0, max=SHOWN_CHAINS, step=1, hint=CHAIN_HINT
        )
        self.start = gui.add_number(
            "Show start", 0, min=0, max=MOST_POINTS, step=1, hint=START_HINT, visible=False
        )
        self._page = gui.add_html("")
        self.chain.on_update(browser.on(self._show_chain))
        self.start.on_update(browser.on(self._show_start))

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        self._run = run
        named = run is not None and bool(run.result.starts)
        if self.start.visible != named:
            self.start.visible = named
        targets = {"target": element_id(self.chain), "start_target": element_id(self.start)}
        set_html(self._page, why(run, **targets))

    def _show_start(self) -> None:
        place = int(self.start.value)
        starts = () if self._run is None else self._run.result.starts
        points = starts[0].points if starts else ()
        if place < 1 or not points:
            return
        point = points[min(place, len(points)) - 1]
        self.start.value = 0  # so that the same one can be asked for again
        self._trajectories.pick(
            repetition=point.repetition, stage=point.stage, rollout=point.rollout
        )
        self._window.panel.minimize()  # the scene is what was asked for

    def _show_chain(self) -> None:
        place = int(self.chain.value)
        explanation = None if self._run is None else self._run.result.explanation
        if place < 1 or explanation is None or explanation.stage is None:
            return
        chains = shown_chains(explanation.chains)
        if not chains:
            return
        chain = chains[min(place, len(chains)) - 1]
        self.chain.value = 0  # so that the same chain can be asked for again
        if chain.likeliest is not None:
            self._trajectories.pick(
                repetition=explanation.repetition, stage=explanation.stage, rollout=chain.likeliest
            )
            self._window.panel.minimize()  # the scene is what was asked for
