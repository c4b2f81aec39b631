"""Traffic rules by CommonRoad's own monitor; runs in its own environment.

Reads {"rules": {name: text or a name of CommonRoad's}, "deceleration_mps2", "reaction_s",
"abrupt_mps2", "dt_s", "length_m", "width_m", "traces": [{car: {"x": [..], "speed": [..],
"acceleration": [..]}}]} from standard input; of each trace the first car is judged. The last line
that it writes is a list of {rule: robustness at each step}, without any scale or bound.
"""

import json
import logging
import sys

import numpy as np
from commonroad.geometry.shape import Rectangle
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletType, LineMarking
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario
from commonroad.scenario.state import CustomState, InitialState
from commonroad.scenario.trajectory import Trajectory
from crmonitor.common import World
from crmonitor.common.vehicle import VehicleParameters
from crmonitor.evaluation import OfflineRuleEvaluator
from crmonitor.evaluation.predicate_interface import PredicateEvaluationInterfaceConfig
from crmonitor.monitor import OutputType
from crmonitor.predicates.base import PredicateConfig

FIRST, HALF_LANE_M, BEYOND_M = 10, 1.75, 100.0


def lanelet(end_m):
    x = np.linspace(-BEYOND_M, end_m + BEYOND_M, 50)
    left, centre, right = (
        np.stack([x, np.full(x.size, y)], axis=1) for y in (HALF_LANE_M, 0.0, -HALF_LANE_M)
    )
    return Lanelet(
        left,
        centre,
        right,
        1,
        line_marking_left_vertices=LineMarking.SOLID,
        line_marking_right_vertices=LineMarking.SOLID,
        lanelet_type={LaneletType.INTERSTATE, LaneletType.MAIN_CARRIAGE_WAY},
    )


def obstacle(number, car, shape):
    def state(kind, step, **more):
        return kind(
            time_step=step,
            position=np.array([car["x"][step], 0.0]),
            orientation=0.0,
            velocity=car["speed"][step],
            acceleration=car["acceleration"][step],
            **more,
        )

    later = [state(CustomState, step) for step in range(1, len(car["x"]))]
    prediction = TrajectoryPrediction(Trajectory(1, later), shape)
    begun = state(InitialState, 0, yaw_rate=0.0, slip_angle=0.0)
    return DynamicObstacle(number, ObstacleType.CAR, shape, begun, prediction)


def world_of(trace, request):
    scenario = Scenario(request["dt_s"])
    scenario.add_objects(lanelet(max(max(car["x"]) for car in trace.values())))
    shape = Rectangle(length=request["length_m"], width=request["width_m"])
    for number, car in enumerate(trace.values(), start=FIRST):
        scenario.add_objects(obstacle(number, car, shape))
    scenario.assign_obstacles_to_lanelets()
    world = World.create_from_scenario(scenario)
    for vehicle in world.vehicles:
        vehicle.vehicle_param = VehicleParameters.create(
            request["dt_s"], a_min=-request["deceleration_mps2"], t_react=request["reaction_s"]
        )
    return world


def main():
    logging.disable(logging.WARNING)
    request = json.load(sys.stdin)
    config = PredicateEvaluationInterfaceConfig(
        base=PredicateConfig(scale_rob=False, a_abrupt=-request["abrupt_mps2"])
    )
    evaluators = {
        name: OfflineRuleEvaluator.create_for_rule(
            text,
            request["dt_s"],
            OutputType.OUTPUT_ROBUSTNESS if "_i" in text else OutputType.STANDARD,
            config,
        )
        for name, text in request["rules"].items()
    }
    answers = []
    for trace in request["traces"]:
        world, answer = world_of(trace, request), {}
        for name, evaluator in evaluators.items():
            evaluator.reset()
            answer[name] = [float(value) for value in evaluator.evaluate(world, FIRST)]
        answers.append(answer)
    sys.stdout.write("\n" + json.dumps(answers) + "\n")


if __name__ == "__main__":
    main()
