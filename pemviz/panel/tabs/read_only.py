"""What hardly asks: the head above all tabs, and the tabs Learning and Why."""

from pemviz.panel.browser import Browser, element_id, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.tabs.trajectories import TrajectoriesTab
from pemviz.panel.views.headline import headline, status
from pemviz.panel.views.learning import learning
from pemviz.panel.views.why import why
from pemviz.reports.pictures.causes import SHOWN_CHAINS, shown_chains

CHAIN_HINT = (
    "Show the rollout that contributes most to the chain of misses at this place of the table "
    "below, in the scene; or click the chain there."
)


class Head:
    """The answer, the state, the progress bar."""

    def __init__(self, browser: Browser) -> None:
        gui = browser.client.gui
        self._headline = gui.add_html("")
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False, color="blue")

    def refresh(self, state: PanelState, run: RunData | None) -> None:
        """Show the state."""
        set_html(self._headline, headline(run))
        set_html(self._status, status(state))
        if self._bar.visible != state.running:
            self._bar.visible = state.running
        self._bar.value = 100.0 * state.progress.share if state.progress is not None else 0.0


class LearningTab:
    """How the proposal forms."""

    def __init__(self, browser: Browser) -> None:
        self._page = browser.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._page, learning(run))


class WhyTab:
    """Which misses cause violations, and how far to trust the number; a chain opens in 3D."""

    def __init__(self, browser: Browser, trajectories: TrajectoriesTab) -> None:
        gui = browser.client.gui
        self._trajectories = trajectories
        self._run: RunData | None = None
        self.chain = gui.add_number(
            "Show chain", 0, min=0, max=SHOWN_CHAINS, step=1, hint=CHAIN_HINT
        )
        self._page = gui.add_html("")
        self.chain.on_update(browser.on(self._show_chain))

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        self._run = run
        set_html(self._page, why(run, target=element_id(self.chain)))

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
