"""Encounters of a logical scenario on highway-env, and films of them.

highway-env itself is imported when the first scene is built, not with this module.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.errors import ConfigError
from pemviz.simulators.encounters.scenario import LogicalScenario
from pemviz.simulators.encounters.single_encounter import measured_place
from pemviz.types import StateBatch

if TYPE_CHECKING:
    from pemviz.simulators.encounters.highway_env_encounters import EncounterEnv

SCENES_KEPT = 8
NUMBER = "environment_"


@dataclass(frozen=True)
class HighwayEncounters(LogicalScenario):
    """Each rollout of a batch in turn is loaded into a highway-env scene, stepped, read back."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "highway-env"

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The states s_0, arrays ``[count]``, for standard normals ``[count, S]`` or medians."""
        given = np.zeros((count, self.latents.start)) if start is None else start
        scene, rows = self._scene, list[list[float]]()
        for normals in given[:, : self.random_values]:
            scene.begin(normals)
            rows.append([*scene.numbers(), *scene.signals.values().values()])
        tracks: dict[str, AnyArray] = {}
        if self.tracker is not None:
            tracks = self.tracker.memory(self.tracker.start(count, slots=len(self.slots)))
        return self._states(rows, step=0, kept={**tracks, **self.noise_begun(given)})

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The next states, for outcomes ``[N, K]`` and, with errors, noise ``[N, 2 K]``."""
        hits = np.asarray(detected, dtype=np.bool_) & self.sight_at(states).present
        numbers = [name for name in states.memory if name.startswith(NUMBER)]
        table = np.stack([states.memory[name] for name in numbers], axis=-1).tolist()
        noises = {} if self.noise is None else self.noise.renewed(states, noise)
        reported, kept = self._reported(states, hits, self._places_m(states, noises))
        scene, rows = self._scene, list[list[float]]()
        for row, before in enumerate(table):
            scene.load(before)
            scene.move(hits[row], *(None if one is None else one[row] for one in reported))
            rows.append([*scene.numbers(), *scene.signals.values().values()])
        return self._states(rows, step=int(states.step) + 1, kept={**kept, **noises})

    @property
    def _scene(self) -> "EncounterEnv":
        return _scene(self.config, self.chosen, self.tracker_text, get_ident())

    def _places_m(self, states: StateBatch, noises: Mapping[str, AnyArray]) -> FloatArray:
        """Gaps and offsets as perception measures them, ``[N, K, 2]``."""
        true = [
            np.stack([states.signals[f"{what}_{name}"] for name in self.reported_names], axis=-1)
            for what in ("gap", "aside")
        ]
        true_m = np.stack(true, axis=-1)
        if not noises:
            return true_m
        errors_m = self.errors_m(self.sight_at(states).salient, noises)
        pairs = zip(true_m.reshape(-1, 2).tolist(), errors_m.reshape(-1, 2).tolist(), strict=True)
        places = [measured_place(self.config, *place, *error) for place, error in pairs]
        return np.array(places, dtype=np.float64).reshape(true_m.shape)

    def _reported(
        self, states: StateBatch, hits: BoolArray, places_m: FloatArray
    ) -> tuple[Sequence[AnyArray | None], dict[str, AnyArray]]:
        """Which tracks there are, where, and how fast, ``[N, K, ...]``; and what states keep."""
        tracker = self.tracker
        if tracker is None:
            return (None, places_m, None), {}
        before = tracker.state(states.memory, slots=len(self.slots))
        tracks = tracker.update(before, hits, places_m)
        speeds = tracks.speed_mps if tracker.has_speeds else None
        return (tracks.confirmed, tracks.position_m, speeds), tracker.memory(tracks)

    def _states(
        self, rows: list[list[float]], *, step: int, kept: Mapping[str, AnyArray]
    ) -> StateBatch:
        count = len(self.signals)
        table = np.array(rows, dtype=np.float64).reshape(len(rows), -1).T
        numbers, values = table[:-count], table[-count:]
        signals = {signal.name: row for signal, row in zip(self.signals, values, strict=True)}
        memory = {f"{NUMBER}{place}": row for place, row in enumerate(numbers)}
        return StateBatch(
            step=np.array(step, dtype=np.int64), signals=signals, memory={**memory, **kept}
        )


def encounter_frames(
    simulator: LogicalScenario, *, detected: BoolArray, start: FloatArray | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Film a rollout with outcomes ``[T-1, K]`` and start ``[S]`` or medians; needs no display.

    Raises:
        ConfigError: It measures with errors, whose noise no film is told of.

    Returns:
        T frames, one a state, each ``[160, 640, 3]`` RGB: the road from above, its left side on
        top, the ego blue.
    """
    from pemviz.simulators.encounters.highway_env_encounters import EncounterEnv  # noqa: PLC0415  pygame

    if simulator.errors is not None:
        which = simulator.config.logical_scenario
        message = f"film of {which}: must be of encounters without position errors"
        raise ConfigError(message)
    environment = EncounterEnv(
        simulator.config, simulator.chosen, simulator.tracker_text, render_mode="rgb_array"
    )
    try:
        if start is not None:
            environment.begin(start)
        yield environment.render()
        for outcomes in detected:
            environment.advance(outcomes)
            yield environment.render()
    finally:
        environment.close()


@lru_cache(maxsize=SCENES_KEPT)
def _scene(
    config: EncounterConfig,
    chosen: tuple[StartChoice, ...],
    tracker: str,
    thread: int,  # noqa: ARG001
) -> "EncounterEnv":
    """A scene to work in. Its content outlives no call, so sharing is safe within a thread."""
    from pemviz.simulators.encounters.highway_env_encounters import EncounterEnv  # noqa: PLC0415  pygame

    return EncounterEnv(config, chosen, tracker)
