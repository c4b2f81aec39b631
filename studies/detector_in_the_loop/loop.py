"""The closed loop: the camera looks, the detector says what it sees, the ego acts on that.

A rollout is a function of its scene, its start and the frames' own hashes. A frame is rendered only
where it matters: where what the ego does next is the same with all cars detected as with none, no
outcome can change it, since an ego without a tracker does the least of what each detected car asks.
"""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.matching import matched
from pemviz.types import StateBatch
from studies.detector_in_the_loop.detector import Detector
from studies.detector_in_the_loop.drives import DT_S, LANE_M, labels_of
from studies.detector_in_the_loop.frames import frames_at
from studies.detector_in_the_loop.render import render
from studies.detector_in_the_loop.scene import Scenes
from studies.detector_in_the_loop.training import IOU_ABOVE
from studies.detector_in_the_loop.worlds import World


@dataclass(frozen=True)
class Looks:
    """What the detector said at the frames that mattered, ``[M]`` of all rollouts.

    Attributes:
        rollout: Which.
        step: At which state.
        detected: Whether each car was ``[M, K]``.
        near_m: Where its rear was, ahead of the camera ``[M, K]``.
    """

    rollout: IntArray
    step: IntArray
    detected: BoolArray
    near_m: FloatArray


@dataclass(frozen=True)
class Driven:
    """N rollouts.

    Attributes:
        failed: Whether the rule was broken ``[N]``.
        looks: What was seen on the way.
    """

    failed: BoolArray
    looks: Looks


@dataclass(frozen=True)
class Loop:
    """A world with a camera and a detector in it.

    Attributes:
        world: The scenario.
        detector: What looks at the images.
        threshold: Score from which on a detection counts.
    """

    world: World
    detector: Detector
    threshold: float

    def drive(self, scenes: Scenes, normals: FloatArray) -> Driven:
        """A rollout for each of N scenes, from starts of standard normals ``[N, S]``."""
        world, states = self.world, self.world.begin(normals)
        count = scenes.count
        travelled_m, failed = np.zeros(count), world.failed(states.signals)
        set_mps = world.ego_mps(states.signals)
        looks: list[Looks] = []
        for step in range(world.simulator.states - 1):
            detected = np.ones((count, world.cars), dtype=np.bool_)
            rows = np.flatnonzero(~failed)
            rows = rows[self.matters(states.take(rows))] if rows.size else rows
            rows = rows[self.undecided(states.take(rows))] if rows.size else rows
            if rows.size:
                own = scenes.take(rows)
                poses = with_traffic(
                    own,
                    world.poses(states)[rows],
                    travelled_m[rows],
                    set_mps=set_mps[rows],
                    step=step,
                )
                detected[rows] = self.look(own, poses, travelled_m[rows], step=step)
                steps = np.full(rows.size, step)
                looks.append(Looks(rows, steps, detected[rows], poses[:, : world.cars, 1]))
            travelled_m += world.ego_mps(states.signals) * DT_S
            states = world.step(states, detected)
            failed |= world.failed(states.signals)
        return Driven(failed, _together(looks, world.cars))

    def matters(self, states: StateBatch) -> BoolArray:
        """Whether the ego's next speed depends on what is detected at states ``[N]``."""
        world = self.world
        shape = (states.shape[0], world.cars)
        all_, none = (world.step(states, np.full(shape, value)) for value in (True, False))
        return world.ego_mps(all_.signals) != world.ego_mps(none.signals)

    def undecided(self, states: StateBatch) -> BoolArray:
        """Whether what is detected from states ``[N]`` on decides over failure.

        It fails with all missed from there on, and not with all detected: with fewer detections
        the ego of these scenarios is never slower.
        """
        steps = np.broadcast_to(states.step, states.shape)
        if not steps.size:
            return np.zeros(states.shape, dtype=np.bool_)
        found = []
        for outcome in (False, True):
            here, step = states, steps.copy()
            failed = self.world.failed(here.signals)
            detected = np.full((states.shape[0], self.world.cars), outcome)
            for _ in range(self.world.simulator.states - 1 - int(steps.min())):
                here = self.world.step(here, detected)
                step = step + 1
                on_time = step <= self.world.simulator.states - 1
                failed = failed | (self.world.failed(here.signals) & on_time)
            found.append(failed)
        return found[0] & ~found[1]

    def look(
        self, scenes: Scenes, poses: FloatArray, travelled_m: FloatArray, *, step: int
    ) -> BoolArray:
        """Which cars ``[N, K]`` of the world the detector finds; poses ``[N, K + 1, 4]``."""
        frames = frames_at(
            scenes,
            step=np.full(scenes.count, float(step)),
            dt_s=DT_S,
            poses=poses,
            travelled_m=travelled_m,
        )
        found = self.detector.detect(render(scenes, frames))
        labels = labels_of(scenes, poses)
        hits = matched(
            labels.box_px,
            found.box_px,
            obstacle_counts=labels.visible,
            detection_counts=found.score >= self.threshold,
            above=IOU_ABOVE,
        )
        return hits[:, : self.world.cars]


def with_traffic(
    scenes: Scenes, poses: FloatArray, travelled_m: FloatArray, *, set_mps: FloatArray, step: int
) -> FloatArray:
    """Poses ``[N, K + 1, 4]`` of N scenes, seen from the ego's place in its lane.

    Traffic to the left keeps its speed, near the ego's at the start.
    """
    traffic = np.zeros((scenes.count, 1, 4))
    speed_mps = set_mps + scenes.column("traffic_mps")
    traffic[:, 0, 0] = -LANE_M
    traffic[:, 0, 1] = scenes.column("traffic_m") + speed_mps * (step * DT_S) - travelled_m
    found = np.concatenate([poses, traffic], axis=1)
    found[:, :, 0] += scenes.column("offset_m")[:, None]
    return found


def _together(looks: list[Looks], cars: int) -> Looks:
    if not looks:
        none = np.zeros(0, dtype=np.int64)
        return Looks(none, none, np.zeros((0, cars), dtype=np.bool_), np.zeros((0, cars)))
    return replace(
        looks[0],
        rollout=np.concatenate([one.rollout for one in looks]),
        step=np.concatenate([one.step for one in looks]),
        detected=np.concatenate([one.detected for one in looks]),
        near_m=np.concatenate([one.near_m for one in looks]),
    )
