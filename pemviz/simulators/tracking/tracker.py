"""Tracks between perception and controller: confirmed by m of n hits, kept for a while without.

A tracker is a pure function of its state, and the state is a few arrays that lie in a simulator's
own: what a method does with states (keep, branch, take equal ones for one) it does with tracks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config.tracker_text import read_tracker
from pemviz.errors import ConfigError
from pemviz.simulators.scene import SceneTracks
from pemviz.simulators.tracking.filters import (
    AlphaBeta,
    Kalman,
    LastPosition,
    Motion,
    TrackFilter,
    at_rest,
)
from pemviz.types import StateBatch

LONGEST_WINDOW = 30
MOST_AXES = 2
VARIANCES = 3
ROUNDING = 1e-9
"""Of a step: a coasting time of so little less than a whole number of steps is one."""
FILTERS: Mapping[str, Callable[..., TrackFilter]] = {
    "none": LastPosition,
    "alpha-beta": AlphaBeta,
    "kalman": Kalman,
}


@dataclass(frozen=True)
class TrackerState:
    """Tracks, one for each rollout ``[N]``, or for each rollout and slot ``[N, K]``.

    Two states that no later outcome tells apart are equal: what has no influence any more is 0.

    Attributes:
        window: ``[...]`` the outcomes that still count towards a confirmation, the latest in the
            lowest bit; 0 once there is one.
        misses: ``[...]`` misses in a row of a confirmed track.
        confirmed: ``[...]`` whether the controller is told of the track.
        motion: Position and speed; zeros where there is no track.
    """

    window: IntArray
    misses: IntArray
    confirmed: BoolArray
    motion: Motion

    @property
    def position_m(self) -> FloatArray:
        """Position ``[..., A]`` [m]."""
        return self.motion.position_m

    @property
    def speed_mps(self) -> FloatArray:
        """Speed ``[..., A]`` [m/s]."""
        return self.motion.speed_mps

    @property
    def covariance(self) -> FloatArray:
        """Of position and speed along an axis, ``[..., 2, 2]`` [m^2, m^2/s, m^2/s^2]."""
        variances = self.motion.variances
        return variances[..., [0, 1, 1, 2]].reshape((*variances.shape[:-1], 2, 2))


@dataclass(frozen=True, kw_only=True)
class Tracker:
    """Confirms a track after ``hits`` of the last ``window`` outcomes, and keeps it for a while.

    A confirmed track without a hit for longer than ``coast_s`` is dropped, and whatever is there
    must be confirmed anew. An unconfirmed one is forgotten with the last hit in the window.

    Attributes:
        dt_s: Time between two outcomes [s].
        hits: Needed for a confirmation (m); at least 1.
        window: Outcomes that they are counted over (n), the latest included; at most 30.
        coast_s: For how long a confirmed track stays without a hit [s]; 0: it goes with the first
            miss.
        axes: Along how many axes positions are measured: 0, 1 or 2.
        filter: Of these positions; by default a track is where its last hit was.
        name: What its parts in a state's memory begin with.
    """

    dt_s: float
    hits: int = 2
    window: int = 3
    coast_s: float = 0.0
    axes: int = 0
    filter: TrackFilter = LastPosition()  # noqa: RUF009  frozen
    name: str = "track"

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: One line: what, and what is allowed.
        """
        wrong = [
            (not 0.0 < self.dt_s < np.inf, f"dt_s = {self.dt_s}: must be above 0 and finite"),
            (
                not 1 <= self.hits <= self.window <= LONGEST_WINDOW,
                f"{self.hits} of {self.window} hits: must be at least 1, and no more than the "
                f"window, which is at most {LONGEST_WINDOW}",
            ),
            (not 0.0 <= self.coast_s < np.inf, f"coast_s = {self.coast_s}: must be at least 0"),
            (
                self.axes not in range(MOST_AXES + 1),
                f"axes = {self.axes}: must be 0, 1 or {MOST_AXES}",
            ),
            (
                self.axes == 0 and self.filter != LastPosition(),
                "axes = 0: must be 1 or 2 with a filter, which takes positions",
            ),
        ]
        for is_wrong, words in wrong:
            if is_wrong:
                message = f"tracker: {words}"
                raise ConfigError(message)

    @property
    def has_speeds(self) -> bool:
        """Whether it tells how fast what it tracks moves."""
        return "speed_mps" in self.filter.keeps

    @property
    def coast_steps(self) -> int:
        """Misses in a row that a confirmed track outlives."""
        return int(np.floor(self.coast_s / self.dt_s + ROUNDING))

    def start(self, count: int, *, slots: int | None = None) -> TrackerState:
        """No tracks yet: arrays ``[count]``, with slots ``[count, slots]``."""
        shape = (count,) if slots is None else (count, slots)
        return TrackerState(
            window=np.zeros(shape, dtype=np.int64),
            misses=np.zeros(shape, dtype=np.int64),
            confirmed=np.zeros(shape, dtype=np.bool_),
            motion=at_rest(np.zeros((*shape, self.axes))),
        )

    def update(
        self, state: TrackerState, detected: BoolArray, position_m: FloatArray | None = None
    ) -> TrackerState:
        """Tracks after one more outcome ``[...]``; the given state is not written to.

        Args:
            state: Tracks before, ``[...]``.
            detected: Whether there is a hit, ``[...]``. Of a slot that is absent: False.
            position_m: Measured positions ``[..., A]``, or ``[...]`` with one axis [m]; what stands
                where there is no hit is not looked at. Left out with ``axes`` 0.

        Raises:
            ValueError: Positions are missing, too many, or of another shape.
        """
        measured_m = self._measured(detected, position_m)
        hit = np.where(detected, 1, 0)
        window = (state.window << 1) | hit
        misses = np.where(state.confirmed, (state.misses + 1) * (1 - hit), 0)
        confirmed = np.where(
            state.confirmed, misses <= self.coast_steps, self._count(window) >= self.hits
        )
        settled = confirmed | state.confirmed  # or dropped: what is there begins anew
        window = np.where(settled, 0, window & ((1 << (self.window - 1)) - 1))
        if self.filter == LastPosition():
            position_m = np.where(detected[..., None], measured_m, state.position_m)
            motion = at_rest(np.where(confirmed[..., None], position_m, 0.0))
        else:
            had_track = state.confirmed | (state.window != 0)
            predicted = self.filter.predicted(state.motion, dt_s=self.dt_s)
            corrected = self.filter.corrected(predicted, measured_m, dt_s=self.dt_s)
            after_hit = _chosen(had_track, corrected, self.filter.first(measured_m))
            motion = _chosen(detected, after_hit, predicted)
            none = at_rest(np.zeros_like(measured_m))
            motion = _chosen(confirmed | (window != 0), motion, none)
        return TrackerState(
            window=window,
            misses=np.where(confirmed, misses, 0),
            confirmed=confirmed,
            motion=motion,
        )

    def hits_seen(self, state: TrackerState) -> IntArray:
        """Hits ``[...]`` that count towards a confirmation; all of them once there is one."""
        return np.where(state.confirmed, self.hits, self._count(state.window))

    def steps_since_hit(self, state: TrackerState) -> IntArray:
        """Misses in a row ``[...]``; without a track as many as forget one."""
        result = state.misses
        for misses in range(self.window):
            none_later = state.window & ((1 << misses) - 1) == 0
            result = np.where(none_later & ~state.confirmed, misses, result)
        none = (state.window == 0) & ~state.confirmed
        return np.where(none, max(self.window - 1, self.coast_steps + 1), result)

    def numbers(self, state: TrackerState) -> list[FloatArray]:
        """What a proposal may look at, arrays ``[...]``.

        A track's hits, which are all once it is confirmed, and the steps since the last; with a
        filter of its motion also where it is [m] and how it moves [m/s], along each axis.
        """
        like = state.motion.variances[..., 0]
        facts = (self.hits_seen(state), self.steps_since_hit(state))
        numbers = [np.ones_like(like) * fact for fact in facts]
        if self.has_speeds:
            for axis in range(self.axes):
                numbers += [state.position_m[..., axis], state.speed_mps[..., axis]]
        return numbers

    def memory(self, state: TrackerState) -> dict[str, AnyArray]:
        """The state as arrays ``[N]`` by name, for a :class:`pemviz.StateBatch`'s memory."""
        parts: dict[str, AnyArray] = {
            "window": state.window, "misses": state.misses, "confirmed": state.confirmed
        }  # fmt: skip
        for field, places in self._places.items():
            for place in places:
                parts[f"{field}_{place}"] = getattr(state.motion, field)[..., place]
        named: dict[str, AnyArray] = {}
        for part, values in parts.items():
            name = f"{self.name}_{part}"
            if values.ndim == 1:
                named[name] = values
            else:
                named.update((f"{name}_{slot}", one) for slot, one in enumerate(values.T))
        return named

    def state(self, memory: Mapping[str, AnyArray], *, slots: int | None = None) -> TrackerState:
        """The tracks ``[...]``, with slots ``[..., slots]``, in a memory with arrays ``[...]``."""

        def part(name: str) -> Any:
            if slots is None:
                return memory[f"{self.name}_{name}"]
            of_slots = [memory[f"{self.name}_{name}_{slot}"] for slot in range(slots)]
            return np.stack(of_slots, -1)

        window = part("window")
        shape = (*window.shape, self.axes)
        motion = at_rest(np.zeros(shape, dtype=np.float64))
        kept = {
            field: np.stack([part(f"{field}_{place}") for place in places], -1)
            for field, places in self._places.items()
        }
        return TrackerState(
            window=window,
            misses=part("misses"),
            confirmed=part("confirmed"),
            motion=replace(motion, **kept),
        )

    @property
    def _places(self) -> dict[str, range]:
        """Fields of the motion that a memory holds, and their places in the last axis."""
        kept = self.filter.keeps if self.axes else ()
        return {f: range(VARIANCES if f == "variances" else self.axes) for f in kept}

    def _count(self, window: IntArray) -> Any:
        """Bits that are set ``[...]``."""
        return sum((window >> bit) & 1 for bit in range(self.window))

    def _measured(self, detected: BoolArray, position_m: FloatArray | None) -> FloatArray:
        shape = (*detected.shape, self.axes)
        if self.axes == 0 and position_m is None:
            return np.zeros(shape, dtype=np.float64)
        if position_m is not None and self.axes == 1 and position_m.shape == detected.shape:
            return position_m[..., None]
        if position_m is None or self.axes == 0 or position_m.shape != shape:
            given = "no positions" if position_m is None else f"positions {position_m.shape}"
            message = f"tracker: {given} for {self.axes} axes: must be of shape {shape}"
            raise ValueError(message)
        return position_m


def _chosen(condition: BoolArray, one: Motion, other: Motion) -> Motion:
    """``one`` where ``condition [...]``, else ``other``."""
    where = condition[..., None]
    return Motion(
        position_m=np.where(where, one.position_m, other.position_m),
        speed_mps=np.where(where, one.speed_mps, other.speed_mps),
        variances=np.where(where, one.variances, other.variances),
    )


def tracker_of_text(text: str, *, dt_s: float, axes: int) -> Tracker | None:
    """The tracker that a text, as ``2/3,coast=0.5,filter=kalman``, spells out.

    ``None`` for ``none``.

    Raises:
        ConfigError: One line: what is wrong, and what is allowed.
    """
    settings = read_tracker(text)
    if settings is None:
        return None
    options = {
        "alpha": settings.alpha,
        "beta": settings.beta,
        "position_sd_m": settings.position_sd,
        "acceleration_sd_mps2": settings.acceleration_sd,
        "first_speed_sd_mps": settings.speed_sd,
    }
    given = {name: value for name, value in options.items() if value is not None}
    return Tracker(
        dt_s=dt_s,
        hits=settings.hits,
        window=settings.window,
        coast_s=settings.coast,
        axes=axes,
        filter=FILTERS[settings.filter](**given),
    )


def tracker_of(simulator: object) -> Tracker | None:
    """The tracker that a simulator says it holds, as its attribute ``tracker``.

    Its states' memory then has what :meth:`Tracker.memory` gives, with slots a track for each, and
    proposals look at the tracks.
    """
    found = getattr(simulator, "tracker", None)
    return found if isinstance(found, Tracker) else None


def scene_tracks(
    tracker: Tracker | None, states: StateBatch, *, slots: int, ego_m: FloatArray, length_m: float
) -> SceneTracks:
    """Where the controller believes cars to be, ``[..., K]``, of which it tracks gap and offset.

    States hold the tracks after the outcomes of the step that led to them: where a filter knows
    speeds, they are where it predicts cars to be. Without a tracker there are none. The ego's
    centre is at ``ego_m [...]``; all cars have one length.
    """
    if tracker is None:
        none = np.zeros((*np.shape(ego_m), slots))
        return SceneTracks(none, none, none, none, none > 0.0)
    tracks = tracker.state(states.memory, slots=slots)
    motion = tracker.filter.predicted(tracks.motion, dt_s=tracker.dt_s)
    sd_m = np.sqrt(motion.variances[..., 0])
    return SceneTracks(
        x_m=np.asarray(ego_m)[..., None] + length_m + motion.position_m[..., 0],
        y_m=motion.position_m[..., 1],
        x_sd_m=sd_m,
        y_sd_m=sd_m,
        confirmed=tracks.confirmed,
    )
