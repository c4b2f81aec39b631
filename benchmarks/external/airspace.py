"""BlueSky, the open air traffic simulator: a pilot turns away from traffic that may not show.

Two A320 at 3,000 m, 128 m/s by calibrated airspeed: one flies east, the other comes from ahead and
the left on a heading of 225 degrees. At each update of the display, 4 s apart, the one turns 40
degrees to the right while the other is shown and comes nearer, and else back to its course. It
fails where they are less than the 3 nautical miles apart that are due near an airport.
"""

import contextlib
import io
import tempfile
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from benchmarks.external.motions import Flags, Numbers, Values
from benchmarks.external.quadrature import Known
from benchmarks.trust_systems import LinearLogit
from pemviz import FloatArray, Signal

DT_S, STEPS = 4.0, 36
AHEAD_NM, ASIDE_NM, COURSE_DEG, OTHER_DEG, TURN_DEG = 14.0, 6.0, 90.0, 225.0, 40.0
ALTITUDE_M, AIRSPEED_MPS, APART_NM, NM_M = 3000.0, 128.0, 3.0, 1852.0
DETECTOR = LinearLogit(at_zero=4.5, slope=-0.2)
"""The farther the other is, in nautical miles, the less often it shows."""
PAIRS, SEED = 2000, 20261126


class Pairs:
    """Pairs of aircraft that all begin in the same state and know nothing of other pairs.

    BlueSky is one simulation a process; what began last is what steps.
    """

    def begin(self, count: int) -> Values:
        """``count`` pairs; signals ``[count]``."""
        simulation, traffic = _started()
        clock: Any = import_module("bluesky.core.simtime")
        traffic.reset()
        clock.reset()
        clock.setdt(DT_S)
        simulation.simt = 0.0
        traffic.cre(
            [f"A{number}" for number in range(2 * count)],
            "A320",
            np.repeat([0.0, ASIDE_NM / 60.0], count),
            np.repeat([0.0, AHEAD_NM / 60.0], count),
            np.repeat([COURSE_DEG, OTHER_DEG], count),
            ALTITUDE_M,
            AIRSPEED_MPS,
        )
        simulation.op()
        self._count = count
        return self._signals()

    def move(self, detected: Flags) -> Values:
        """4 s on, given where the other is shown ``[count]``."""
        simulation, traffic = _started()
        turns = detected & (self._signals()["rate"] < 0.0)
        headings = np.where(turns, COURSE_DEG + TURN_DEG, COURSE_DEG)
        traffic.ap.selhdgcmd(np.arange(self._count), headings)
        simulation.step()
        return self._signals()

    def _signals(self) -> Values:
        """Distances [NM], their rate [NM/s], the least to come at today's velocities, the turn."""
        _, traffic = _started()
        own, other = slice(self._count), slice(self._count, None)
        away = np.stack([traffic.lon, traffic.lat]) * 60.0
        speed = np.stack([traffic.gseast, traffic.gsnorth]) / NM_M
        away, speed = away[:, other] - away[:, own], speed[:, other] - speed[:, own]
        distance, along = np.hypot(*away), (away * speed).sum(axis=0)
        when_s = np.maximum(-along / np.maximum((speed**2).sum(axis=0), 1e-12), 0.0)
        return {
            "room": distance - APART_NM,
            "rate": along / distance,
            "closest": np.hypot(*(away + speed * when_s)),
            "turned": (traffic.hdg[own] - COURSE_DEG + 180.0) % 360.0 - 180.0,
        }


class PilotWithDisplay:
    """One pair: a :class:`pemviz.EpisodicSimulator`."""

    name = "bluesky"
    states = STEPS + 1
    dt_s = DT_S
    signals = (
        Signal(name="room", key="room_nm", unit="NM", low=-3.0, high=15.0),
        Signal(name="rate", key="rate_nmps", unit="NM/s", low=-0.2, high=0.2),
        Signal(name="closest", key="closest_nm", unit="NM", low=0.0, high=15.0),
        Signal(name="turned", key="turned_deg", unit="deg", low=-45.0, high=45.0),
    )

    def __init__(self) -> None:
        """Nothing flies yet."""
        self._pair = Pairs()

    def reset(self) -> Mapping[str, float]:
        """Both on their courses."""
        return _first(self._pair.begin(1))

    def step(self, detected: bool) -> tuple[Mapping[str, float], bool]:
        """4 s on; nothing ends before the last step."""
        return _first(self._pair.move(np.array([detected]))), False

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """How far the other is [NM], ``[..., 1]``."""
        return signals["room"][..., None] + APART_NM


def _first(values: Values) -> Mapping[str, float]:
    return {name: float(each[0]) for name, each in values.items()}


def plain(count: int = 200_000, seed: int = SEED) -> Known:
    """Plain rollouts, many pairs at a time."""
    rng, pairs, failing = np.random.default_rng(seed), Pairs(), 0
    for _ in range(count // PAIRS):
        room: Numbers = pairs.begin(PAIRS)["room"]
        failed = room < 0.0
        for _ in range(STEPS):
            logit = DETECTOR.logit(room[:, None] + APART_NM)
            room = pairs.move(rng.random(PAIRS) < expit(logit))["room"]
            failed |= room < 0.0
        failing += int(failed.sum())
    return Known.counted(failing, count // PAIRS * PAIRS, f"{PAIRS:,} pairs at a time")


def system() -> PilotWithDisplay:
    """The environment."""
    return PilotWithDisplay()


@cache
def _started() -> tuple[Any, Any]:
    """BlueSky's simulation and traffic, without a screen; its data are read once into a folder."""
    bluesky: Any = import_module("bluesky")
    folder = Path(tempfile.gettempdir()) / "pemviz-benchmarks-bluesky"
    folder.mkdir(exist_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):
        bluesky.init(mode="sim", detached=True, workdir=str(folder))
    return bluesky.sim, bluesky.traf
