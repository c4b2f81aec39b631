"""A rollout as OpenSCENARIO 1.1 and its road as OpenDRIVE 1.7, written by ``scenariogeneration``.

Both cars follow a trajectory by time, a vertex at every state, in absolute simulation time. A
position is that of the middle of a car's rear axle, as the standard has it; axles lie at a fifth
and four fifths of a car's length (this project's choice: the scenario has none), and bounding
boxes say where the bumpers are. What perception missed stands in the ego's properties. The replay
stops at contact, since what a rollout tells after it happens in no encounter; the trajectories
hold all states.
"""

from typing import Any

import scenariogeneration
import scenariogeneration.xodr
import scenariogeneration.xosc

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
from pemviz.simulators.braking.scenario import CAR_HEIGHT_M, CAR_WIDTH_M

# the library's enumerations are not of the types that its own functions ask for
xosc: Any = scenariogeneration.xosc
xodr: Any = scenariogeneration.xodr

VERSION = 1
"""Minor version: greaterOrEqual, which starts and stops the replay, came with 1.1."""
ROAD_VERSION = "7"
REAR_AXLE, FRONT_AXLE = 0.2, 0.8
"""Of a car's length, from its rear bumper."""
WHEEL_M, TRACK_M, STEERING_RAD = 0.65, 1.5, 0.5
TOP_SPEED_MPS, TOP_ACCELERATION_MPS2 = 70.0, 20.0
"""Beyond what the scenario allows."""
EGO, LEAD = "Ego", "Lead"


def openscenario_files(rollout: KeptRollout, *, road_file: str) -> tuple[bytes, bytes]:
    """The scenario, and the road beside it that it names.

    Raises:
        InputError: The rollout is of another simulator.
    """
    motion = braking_motion(rollout, form="openscenario")
    ego, lead = _vehicle(motion.ego), _vehicle(motion.lead)
    for name, value in facts(rollout, motion).items():
        ego.add_property(name, printable_line(value))
    entities = xosc.Entities()
    entities.add_scenario_object(EGO, ego)
    entities.add_scenario_object(LEAD, lead)
    scenario = xosc.Scenario(
        printable_line(description(rollout, motion)),
        "pemviz",
        xosc.ParameterDeclarations(),
        entities,
        _storyboard(motion),
        xosc.RoadNetwork(roadfile=road_file),
        xosc.Catalog(),
        osc_minor_version=VERSION,
        creation_date=rollout.date.replace(tzinfo=None),
    )
    scenario_file = scenariogeneration.prettify(scenario.get_element())
    return scenario_file, _road(motion, date=rollout.date.isoformat())


def _vehicle(car: CarMotion) -> Any:
    front_m = (FRONT_AXLE - REAR_AXLE) * car.length_m
    centre_m = (0.5 - REAR_AXLE) * car.length_m
    vehicle = xosc.Vehicle(
        car.name,
        xosc.VehicleCategory.car,
        xosc.BoundingBox(CAR_WIDTH_M, car.length_m, CAR_HEIGHT_M, centre_m, 0.0, CAR_HEIGHT_M / 2),
        xosc.Axle(STEERING_RAD, WHEEL_M, TRACK_M, front_m, WHEEL_M / 2),
        xosc.Axle(0.0, WHEEL_M, TRACK_M, 0.0, WHEEL_M / 2),
        TOP_SPEED_MPS,
        TOP_ACCELERATION_MPS2,
        TOP_ACCELERATION_MPS2,
    )
    vehicle.add_property("reference_point", "middle of the rear axle, on the road")
    return vehicle


def _storyboard(motion: BrakingMotion) -> Any:
    init = xosc.Init()
    act = xosc.Act("replay", _at(0.0, name="start"))
    for entity, car in ((EGO, motion.ego), (LEAD, motion.lead)):
        axle_m = car.rear_m + REAR_AXLE * car.length_m
        positions = [xosc.WorldPosition(x, 0.0, 0.0, 0.0, 0.0, 0.0) for x in axle_m.tolist()]
        at_once = xosc.TransitionDynamics(
            xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0.0
        )
        speed = xosc.AbsoluteSpeedAction(float(car.speed_mps[0]), at_once)
        init.add_init_action(entity, xosc.TeleportAction(positions[0]))
        init.add_init_action(entity, speed)
        act.add_maneuver_group(_maneuver_group(entity, positions, motion))
    contact = motion.contact
    end_s = motion.time_s[-1] if contact is None else contact.time_s
    board = xosc.StoryBoard(init, _at(float(end_s), name="end", stop=True))
    board.add_act(act)
    return board


def _maneuver_group(entity: str, positions: list[Any], motion: BrakingMotion) -> Any:
    trajectory = xosc.Trajectory(f"{entity}Trajectory", False)
    trajectory.add_shape(xosc.Polyline(motion.time_s.tolist(), positions))
    follow = xosc.FollowTrajectoryAction(
        trajectory, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1.0, 0.0
    )
    event = xosc.Event(f"{entity}Event", xosc.Priority.overwrite)
    event.add_action(f"{entity}Action", follow)
    event.add_trigger(_at(0.0, name=f"{entity}Start"))
    maneuver = xosc.Maneuver(f"{entity}Maneuver")
    maneuver.add_event(event)
    group = xosc.ManeuverGroup(f"{entity}Group")
    group.add_actor(entity)
    group.add_maneuver(maneuver)
    return group


def _at(time_s: float, *, name: str, stop: bool = False) -> Any:
    """True from a simulation time on."""
    condition = xosc.SimulationTimeCondition(time_s, xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(
        name, 0.0, xosc.ConditionEdge.none, condition, "stop" if stop else "start"
    )


def _road(motion: BrakingMotion, *, date: str) -> bytes:
    """One lane, straight along y = 0."""
    planview = xodr.PlanView(-ROAD_BEFORE_M, LANE_WIDTH_M / 2, 0.0)
    planview.add_geometry(xodr.Line(ROAD_BEFORE_M + motion.end_m + ROAD_BEYOND_M))
    lanes = xodr.Lanes()
    centre = xodr.standard_lane(rm=xodr.std_roadmark_solid())
    section = xodr.LaneSection(0.0, centre)
    section.add_right_lane(xodr.standard_lane(LANE_WIDTH_M, xodr.std_roadmark_solid()))
    lanes.add_lanesection(section)
    drive = xodr.OpenDrive("straight road", revMinor=ROAD_VERSION)
    drive.add_road(xodr.Road(1, planview, lanes))
    drive.adjust_roads_and_lanes()
    element = drive.get_element()
    next(element.iter("header")).set("date", date)
    return scenariogeneration.prettify(element)
