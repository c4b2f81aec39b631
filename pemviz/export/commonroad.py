"""A rollout as a CommonRoad scenario (2020a, XML), written by ``commonroad-io``.

One lanelet along y = 0. Both cars are dynamic obstacles with a trajectory of their own rectangle's
centre, a state at every step. The ego is one too, and not the trajectory of a CommonRoad solution:
a solution's vehicle must be one of four types of fixed sizes, none as long as the scenario's, so
that the bumpers would touch at another time. The planning problem starts in the ego's initial
state; who plans for it takes the obstacle ``EGO_ID`` out first. What perception missed stands in
comments at the file's top.
"""

import re
import tempfile
from pathlib import Path
from typing import Any, cast

import numpy as np
from commonroad.common.common_lanelet import LaneletType, LineMarking
from commonroad.common.file_writer import CommonRoadFileWriter
from commonroad.common.util import FileFormat, Interval
from commonroad.common.writer.file_writer_interface import OverwriteExistingFile
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem, PlanningProblemSet
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario, ScenarioID, Tag
from commonroad.scenario.state import CustomState, InitialState
from commonroad.scenario.trajectory import Trajectory

from pemviz.arrays import FloatArray
from pemviz.export.motion import (
    LANE_WIDTH_M,
    ROAD_BEFORE_M,
    ROAD_BEYOND_M,
    BrakingMotion,
    CarMotion,
    braking_motion,
    description,
    facts,
)
from pemviz.reports.escape import printable_line
from pemviz.runs.kept_rollout import KeptRollout
from pemviz.simulators.braking.scenario import CAR_WIDTH_M

LANELET_ID, EGO_ID, LEAD_ID, PROBLEM_ID = 1, 10, 11, 100
ROAD_POINTS = 50
DATE = re.compile(r' date="[0-9-]{10}"')
"""Today's, which the library writes; in the text of an attribute quotes would be escaped."""
DECIMALS = 17
"""As many as a float64 near 1 has: the library cuts off what is beyond."""


def commonroad_bytes(rollout: KeptRollout) -> bytes:
    """The scenario's file.

    Raises:
        InputError: The rollout is of another simulator.
    """
    motion = braking_motion(rollout, form="commonroad")
    name = ScenarioID(
        country_id="ZAM",  # CommonRoad's own: no country's road
        map_name="Pemviz",
        map_id=1,
        configuration_id=rollout.rank,
        obstacle_behavior="T",
        prediction_id=1,
    )
    scenario = Scenario(motion.dt_s, name)
    scenario.add_objects(_lanelet(motion))
    for number, car in ((EGO_ID, motion.ego), (LEAD_ID, motion.lead)):
        scenario.add_objects(_obstacle(number, car, dt_s=motion.dt_s))
    writer = CommonRoadFileWriter(
        scenario,
        PlanningProblemSet([_planning_problem(motion)]),
        author="pemviz",
        affiliation="",
        source=printable_line(description(rollout, motion)),
        tags={Tag.SIMULATED},
        decimal_precision=DECIMALS,
        file_format=FileFormat.XML,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.xml"
        writer.write_to_file(str(path), OverwriteExistingFile.SKIP)
        text = path.read_text(encoding="utf-8")
    declaration, scenario_text = text.split("\n", 1)
    scenario_text = DATE.sub(f' date="{rollout.date:%Y-%m-%d}"', scenario_text, count=1)
    lines = (declaration, *_comments(rollout, motion), scenario_text)
    return "\n".join(lines).encode("utf-8")


def _lanelet(motion: BrakingMotion) -> Lanelet:
    x_m = np.linspace(-ROAD_BEFORE_M, motion.end_m + ROAD_BEYOND_M, ROAD_POINTS)

    def along(y_m: float) -> FloatArray:
        return np.stack([x_m, np.full(x_m.size, y_m)], axis=1)

    half_m = LANE_WIDTH_M / 2
    return Lanelet(
        along(half_m),
        along(0.0),
        along(-half_m),
        LANELET_ID,
        line_marking_left_vertices=LineMarking.SOLID,
        line_marking_right_vertices=LineMarking.SOLID,
        lanelet_type={LaneletType.COUNTRY},
    )


def _obstacle(number: int, car: CarMotion, *, dt_s: float) -> DynamicObstacle:
    shape = RectObstacleShape(length=car.length_m, width=CAR_WIDTH_M)
    columns = (car.centre_m.tolist(), car.speed_mps.tolist(), _acceleration_mps2(car, dt_s=dt_s))
    states = [
        CustomState(
            time_step=step,
            position=np.array([x_m, 0.0]),
            orientation=0.0,
            velocity=speed_mps,
            acceleration=mps2,
        )
        for step, (x_m, speed_mps, mps2) in enumerate(zip(*columns, strict=True))
    ]
    return DynamicObstacle(
        number,
        ObstacleType.CAR,
        shape,
        _initial_state(car, dt_s=dt_s),
        TrajectoryPrediction(Trajectory(1, cast(Any, states[1:])), shape),
    )


def _acceleration_mps2(car: CarMotion, *, dt_s: float) -> list[float]:
    """Until the next state; the last state has the one before it."""
    steps = (np.diff(car.speed_mps) / dt_s).tolist()
    return [*steps, steps[-1]]


def _initial_state(car: CarMotion, *, dt_s: float) -> InitialState:
    return InitialState(
        time_step=0,
        position=np.array([float(car.centre_m[0]), 0.0]),
        orientation=0.0,
        velocity=float(car.speed_mps[0]),
        acceleration=_acceleration_mps2(car, dt_s=dt_s)[0],
        yaw_rate=0.0,
        slip_angle=0.0,
    )


def _planning_problem(motion: BrakingMotion) -> PlanningProblem:
    """From the ego's initial state to the rollout's last step, wherever that is."""
    last = motion.states - 1
    goal = GoalRegion([CustomState(time_step=Interval(last, last))])
    return PlanningProblem(PROBLEM_ID, _initial_state(motion.ego, dt_s=motion.dt_s), goal)


def _comments(rollout: KeptRollout, motion: BrakingMotion) -> list[str]:
    """Facts a line each, ``name: value``; XML allows no two hyphens in a row there."""
    described = {
        **facts(rollout, motion),
        "ego": f"obstacle {EGO_ID}",
        "lead": f"obstacle {LEAD_ID}",
        "reference_point": "centre of the rectangle",
    }
    lines = (f"pemviz {name}: {printable_line(value)}" for name, value in described.items())
    return [f"<!-- {re.sub('-(?=-)', '- ', line)} -->" for line in lines]
