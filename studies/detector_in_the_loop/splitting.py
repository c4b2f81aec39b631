"""Rare failures of the braking scenario with the detector in it: multilevel splitting.

What would be left between the cars if the ego braked from now on until both stand can only become
less: it falls with every frame in which the car is missed. Rollouts that reach a lower level of it
are continued from where they did, several times over, each time with other frames: noise, blur and
flicker are drawn anew, the scene stays. The product of the shares that reach the next level is the
probability without bias (fixed effort; Cerou, Del Moral, Furon & Guyader 2012), its interval is
Student's t on the logarithms of independent runs.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from pemviz.arrays import FloatArray, IntArray
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED
from pemviz.types import StateBatch
from studies.detector_in_the_loop.drives import DT_S
from studies.detector_in_the_loop.hashing import hashed
from studies.detector_in_the_loop.loop import Loop, with_traffic
from studies.detector_in_the_loop.scene import Scenes, draw_scenes
from studies.detector_in_the_loop.settings import SPLITTING, Setting, seeds
from studies.detector_in_the_loop.worlds import BrakingWorld

AGAIN = 900
"""Purpose of the seeds of a rollout that goes on from another one's state."""


@dataclass(frozen=True)
class Particles:
    """Rollouts on their way.

    Attributes:
        scenes: N scenes.
        states: At a step of each one's own, ``step [N]``.
        travelled_m: ``[N]``.
    """

    scenes: Scenes
    states: StateBatch
    travelled_m: FloatArray

    def take(self, rows: IntArray) -> "Particles":
        """Some of them, one or several times."""
        return Particles(self.scenes.take(rows), self.states.take(rows), self.travelled_m[rows])


@dataclass(frozen=True)
class SplitRun:
    """One run.

    Attributes:
        probability: Its estimate.
        shares: That reached each level, one after the other.
        frames: That were rendered.
    """

    probability: float
    shares: tuple[float, ...]
    frames: int


def left_m(world: BrakingWorld, states: StateBatch) -> FloatArray:
    """The gap at standstill if the ego brakes hard from now on ``[N]`` [m]."""
    config, signals = world.simulator.config, states.signals
    lead_m = signals[LEAD_SPEED] ** 2 / (2.0 * config.lead_deceleration_mps2)
    ego_m = signals[EGO_SPEED] ** 2 / (2.0 * config.emergency_deceleration_mps2)
    return signals[GAP] + lead_m - ego_m


def split_run(
    setting: Setting, loop: Loop, *, levels_m: FloatArray, count: int, run: int
) -> SplitRun:
    """One run with ``count`` particles at each level.

    Args:
        setting: Whose domain scenes are of.
        loop: The setting's, in a :class:`BrakingWorld`.
        levels_m: Descending; the last stage is over where the rule is broken.
        count: Particles.
        run: Number of the run.
    """
    world = loop.world
    assert isinstance(world, BrakingWorld)  # noqa: S101  the docstring asks for it
    scene_seeds, choice_seeds = seeds(SPLITTING, *setting.name.encode(), run).spawn(2)
    random = np.random.default_rng(choice_seeds)
    scenes = draw_scenes(setting.domain, count=count, cars=1, seeds=scene_seeds)
    states = world.begin(np.zeros((count, 0)))
    states = replace(states, step=np.zeros(count, dtype=np.int64))
    particles = Particles(scenes, states, np.zeros(count))
    probability, shares, frames = 1.0, list[float](), 0
    for stage, level_m in enumerate((*levels_m, None)):
        particles, looked = _until(loop, particles, level_m)
        frames += looked
        shares.append(particles.travelled_m.size / count)
        probability *= shares[-1]
        if particles.travelled_m.size == 0 or level_m is None:
            break
        rows = random.integers(0, particles.travelled_m.size, count)
        particles = particles.take(rows)
        own = hashed(particles.scenes.frame_seeds + np.arange(count, dtype=np.uint64), stage, AGAIN)
        particles = replace(particles, scenes=replace(particles.scenes, frame_seeds=own))
    return SplitRun(probability, tuple(shares), frames)


def _until(loop: Loop, particles: Particles, level_m: float | None) -> tuple[Particles, int]:
    """Those that reach a level, or fail without one, in the states in which they do."""
    world, arrived, frames = loop.world, list[Particles](), 0
    assert isinstance(world, BrakingWorld)  # noqa: S101  only these are split
    set_mps = world.simulator.config.initial_speed_mps
    while particles.travelled_m.size:
        states = particles.states
        there = world.failed(states.signals)
        if level_m is not None:
            there |= left_m(world, states) <= level_m
        if there.any():
            arrived.append(particles.take(np.flatnonzero(there)))
        going = np.flatnonzero(~there & (states.step < world.simulator.states - 1))
        particles = particles.take(going)
        states = particles.states
        detected = np.ones((going.size, 1), dtype=np.bool_)
        rows = np.arange(going.size)
        rows = rows[loop.matters(states)] if rows.size else rows
        rows = rows[loop.undecided(states.take(rows))] if rows.size else rows
        for step in np.unique(states.step[rows]):
            own = rows[states.step[rows] == step]
            scenes, travelled_m = particles.scenes.take(own), particles.travelled_m[own]
            poses = with_traffic(
                scenes,
                world.poses(states)[own],
                travelled_m,
                set_mps=np.full(own.size, set_mps),
                step=int(step),
            )
            detected[own] = loop.look(scenes, poses, travelled_m, step=int(step))
        frames += rows.size
        travelled_m = particles.travelled_m + world.ego_mps(states.signals) * DT_S
        particles = Particles(particles.scenes, world.step(states, detected), travelled_m)
    if not arrived:
        return particles, frames
    return Particles(
        Scenes.concatenate([one.scenes for one in arrived]),
        StateBatch.concatenate([one.states for one in arrived]),
        np.concatenate([one.travelled_m for one in arrived]),
    ), frames


def of_runs(probabilities: list[float], *, confidence: float = 0.95) -> tuple[float, float, float]:
    """Mean of runs, and an interval by Student's t on their logarithms' spread.

    Runs without a failure count in the mean; with any of these, or under three, the interval is
    all that is possible.
    """
    values = np.array(probabilities)
    mean = float(values.mean())
    if values.size < 3 or (values == 0.0).any():
        return mean, 0.0, 1.0
    spread = float(values.std(ddof=1)) / np.sqrt(values.size) / mean
    wide = float(student.ppf(0.5 + confidence / 2.0, values.size - 1)) * spread
    return mean, mean * float(np.exp(-wide)), mean * float(np.exp(wide))
