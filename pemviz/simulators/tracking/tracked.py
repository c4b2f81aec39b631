"""Any scenario behind a tracker: it is told of confirmed tracks in place of single outcomes."""

from dataclasses import dataclass, replace

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.simulators.latents import WrappedSimulator, begun, stepped
from pemviz.simulators.slots import SlotSimulator, WrappedSlots
from pemviz.simulators.tracking.tracker import Tracker, TrackerState
from pemviz.types import Simulator, StateBatch


@dataclass(frozen=True)
class TrackedSimulator(WrappedSimulator):
    """The same scenario; ``step`` hands it whether the obstacle is tracked.

    Attributes:
        tracker: One without positions; a scenario that takes those from its tracker holds one
            itself.
    """

    tracker: Tracker

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The scenario's initial states, without tracks."""
        states = begun(self.scenario, count=count, start=start)
        return self._with(states, self.tracker.start(count, slots=self._count))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The scenario's next states, given what is tracked after outcomes ``[N]``."""
        begins = f"{self.tracker.name}_"
        own = {name: v for name, v in states.memory.items() if not name.startswith(begins)}
        before = self.tracker.state(states.memory, slots=self._count)
        tracks = self.tracker.update(before, detected)
        after = stepped(self.scenario, replace(states, memory=own), tracks.confirmed, noise)
        return self._with(after, tracks)

    def _with(self, states: StateBatch, tracks: TrackerState) -> StateBatch:
        return replace(states, memory={**states.memory, **self.tracker.memory(tracks)})

    @property
    def _count(self) -> int | None:
        """Of slots."""
        return None


@dataclass(frozen=True)
class TrackedSlots(WrappedSlots, TrackedSimulator):
    """The same with a track for each slot of a scenario; what is absent is no hit."""

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The scenario's next states, given what is tracked after outcomes ``[N, K]``."""
        return super().step(states, detected & self.present(states.signals), noise)

    @property
    def _count(self) -> int:
        return len(self.slots)


def tracked(simulator: Simulator | SlotSimulator, tracker: Tracker) -> TrackedSimulator:
    """A scenario that is told of confirmed tracks: its ``step`` gets them as ``detected``.

    With slots each has a track of its own. The tracker is one without positions, and of the
    scenario's time step.

    Raises:
        ConfigError: The tracker is another's, or the scenario has memory of its names.
    """
    where = f"simulator {simulator.name!r}"
    if tracker.axes:
        message = f"{where}: tracked hands on no positions: must be a tracker with axes = 0"
        raise ConfigError(message)
    if any(n.startswith(f"{tracker.name}_") for n in begun(simulator, count=1).memory):
        message = f"{where}: its memory has the names of tracker {tracker.name!r}: choose another"
        raise ConfigError(message)
    if isinstance(simulator, SlotSimulator):
        return TrackedSlots(simulator, tracker)
    return TrackedSimulator(simulator, tracker)
