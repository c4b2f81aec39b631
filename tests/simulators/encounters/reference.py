"""One encounter at a time, in plain numbers, from the specification alone."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pemviz.config import EncounterConfig
from tests.simulators.reference import OneTrack


class Car:
    """Another car: its centre, and what it will do."""

    def __init__(self, x: float, y: float, speed: float):
        self.x, self.y, self.speed, self.heading = x, y, max(speed, 0.0), 0.0
        self.profile: Callable[[float], float] = lambda _: y
        self.brakes: Callable[[float], float] = lambda _: 0.0
        self.states_ahead = 0
        self.closing = 0.0
        self.track: OneTrack | None = None

    @property
    def along(self) -> float:
        return self.speed * math.cos(self.heading)


def jerk_free(share: float) -> float:
    u = min(max(share, 0.0), 1.0)
    return 10 * u**3 - 15 * u**4 + 6 * u**5


def inverse(wanted: float) -> float:
    low, high = 0.0, 1.0
    while high - low > 1e-15:
        middle = (low + high) / 2
        low, high = (middle, high) if jerk_free(middle) < wanted else (low, middle)
    return low


def changes_lane(begin: float, duration: float, y_from: float, y_to: float):
    return lambda time: y_from + (y_to - y_from) * jerk_free((time - begin) / duration)


class Encounter:
    """An encounter that goes on by ``step``, and what there is to be seen of it."""

    def __init__(self, config: EncounterConfig, start: Mapping[str, float], tracker=None):
        self.config, self.time, self.count = config, 0.0, 0
        self.length, self.width, self.lane = (
            config.car_length_m, config.car_width_m, config.lane_width_m,
        )  # fmt: skip
        self.x, self.speed, self.wanted = 0.0, start["ego_speed"], start["ego_speed"]
        self.acceleration = self.needless = self.impact = 0.0
        self.collided, self.avoidable = False, -10.0
        self.cut_in = start.get("cut_in_time", 0.0)
        self.cars = self.begin(start)
        self.false_positive = None if "ghost_gap" not in start else Car(
            self.length + start["ghost_gap"], 0.0, 0.0
        )  # fmt: skip
        self.reported = (
            self.cars if self.false_positive is None else [*self.cars, self.false_positive]
        )
        for car in self.reported:
            car.heading = self.aimed(car)
            car.track = None if tracker is None else OneTrack(tracker)
        self.has_speeds = tracker is not None and "speed_mps" in tracker.filter.keeps
        self.count_ahead()
        self.safe = self.safe_distance()

    def begin(self, start: Mapping[str, float]) -> list[Car]:
        """Cars of the logical scenario; x of a car whose gap is 0 is the ego's length ahead."""
        beside = self.lane * (1 if self.config.side == "left" else -1)
        ahead = self.length + start["gap"]
        first = Car(ahead, 0.0, start["ego_speed"] - start["closing_speed"])
        cars = [first]
        if self.config.logical_scenario == "braking":
            first.brakes = lambda t: start["deceleration"] if t >= start["brake_time"] else 0.0
        elif self.config.logical_scenario == "cut-in":
            share = inverse((self.lane - self.width) / 2 / self.lane)
            until = start["cut_in_time"] + share * start["duration"]
            first.x += min(start["closing_speed"], start["ego_speed"]) * until
            first.y = beside
            first.profile = changes_lane(start["cut_in_time"], start["duration"], beside, 0.0)
            x = first.x + self.length + start["lead_gap"]
            cars.append(Car(x, 0.0, start["ego_speed"]))
        else:
            first.profile = changes_lane(start["cut_out_time"], start["duration"], 0.0, beside)
            clear = start["cut_out_time"] + start["duration"] * inverse(self.width / self.lane)
            faster = max(first.speed - start["revealed_speed"], 0.0)
            x = first.x + self.length + faster * (clear + start["margin"])
            cars.append(Car(x, 0.0, start["revealed_speed"]))
        if self.config.neighbour:
            x = self.length + start["neighbour_gap"]
            cars.append(Car(x, -beside, start["ego_speed"]))
        return cars

    def gap(self, car: Car) -> float:
        return car.x - self.x - self.length

    def aimed(self, car: Car) -> float:
        if car.speed == 0.0:
            return car.heading
        to_go = car.profile(self.time + self.config.dt_s) - car.y
        return math.asin(min(max(to_go / (car.speed * self.config.dt_s), -0.3), 0.3))

    # -- seeing

    def images(self) -> list[tuple[float, float, float, float]]:
        """Near end, centre's distance, and left and right end in the image, by car."""
        return [self.image(car) for car in self.cars]

    def image(self, car: Car) -> tuple[float, float, float, float]:
        near = self.gap(car) + self.config.camera_to_bumper_m
        ends = [max(z, 0.5) for z in (near, near + self.length)]
        sides = [-car.y - self.width / 2, -car.y + self.width / 2]
        shares = [side / end for side in sides for end in ends]
        return near, near + self.length / 2, min(shares), max(shares)

    def seen(self) -> list[tuple[bool, list[float]]]:
        """Whether each car is present, and its salient variables."""
        config, images = self.config, self.images()
        edge = math.tan(math.radians(config.camera_half_angle_deg))
        found = []
        for place, (car, (near, z, left, right)) in enumerate(zip(self.cars, images, strict=True)):
            low, high = max(left, -edge), min(right, edge)
            width = max(high - low, 0.0)
            covers = sorted(
                (max(low, a), min(high, b))
                for other, (n, centre, a, b) in enumerate(images)
                if centre > 0.5 and (n, other) < (near, place) and min(high, b) > max(low, a)
            )
            covered, reached = 0.0, low
            for a, b in covers:
                covered += max(b - max(a, reached), 0.0)
                reached = max(reached, b)
            occluded = covered / width if width else 0.0
            level = 0.0 if occluded < 0.1 else 1.0 if occluded < 0.5 else 2.0
            present = 0.5 < z <= config.farthest_m and width > 0.0 and occluded < 0.9
            rotation = -math.pi / 2 - car.heading
            found.append((present, [
                0.0, 1.0 - width / (right - left), level, rotation - math.atan2(-car.y, z),
                config.car_height_m, self.width, self.length, -car.y, config.camera_height_m, z,
                rotation,
            ]))  # fmt: skip
        if self.false_positive is not None:
            _, z, left, right = self.image(self.false_positive)
            before = any(self.gap(car) < self.gap(self.false_positive) for car in self.ahead())
            cut_off = 1.0 - (min(right, edge) - max(left, -edge)) / (right - left)
            alpha = -math.pi / 2 - math.atan2(-self.false_positive.y, z)
            found.append((0.5 < z <= config.farthest_m and not before, [
                0.0, cut_off, 0.0, alpha, config.car_height_m, self.width, self.length, 0.0,
                config.camera_height_m, z, -math.pi / 2,
            ]))  # fmt: skip
        return found

    # -- driving

    def controller_input(self, detected: Sequence[bool]) -> list[tuple[float, float, float]]:
        """Gap, offset and closing speed of the cars that the controller is told of."""
        cars = []
        for car, reported, (present, _) in zip(self.reported, detected, self.seen(), strict=True):
            hit = reported and present
            gap, closing = self.gap(car), self.speed - car.along
            if car.track is None:
                cars += [(gap, car.y, closing)] if hit else []
                continue
            car.track.update(hit, np.array([gap, car.y]))
            car.closing = closing if hit else car.closing
            if car.track.confirmed:
                position, speed = car.track.x
                faster = -speed[0] if self.has_speeds else car.closing
                cars.append((position[0], position[1], faster))
        return cars

    def decide(self, detected: Sequence[bool]) -> float:
        config, wanted, hard = self.config, [], False
        for gap, y, closing in self.controller_input(detected):
            if abs(y) - self.width / 2 < config.path_half_width_m and gap + self.length > 0:
                far = gap - config.standstill_gap_m - config.time_gap_s * self.speed
                wanted += [config.gap_gain_per_s2 * far - config.closing_gain_per_s * closing]
                strength = 2 * config.hard_deceleration_mps2
                hard |= closing > 0 and gap < closing * (closing / strength + config.hard_reserve_s)
        wanted += [config.speed_gain_per_s * (self.wanted - self.speed)]
        chosen = min(
            max(min(wanted), -config.maximum_deceleration_mps2), config.maximum_acceleration_mps2
        )
        chosen = -config.hard_deceleration_mps2 if hard else chosen
        return 0.0 if self.collided else max(chosen, -self.speed / config.dt_s)

    def step(self, detected: Sequence[bool]) -> None:
        dt, chosen = self.config.dt_s, self.decide(detected)
        was_in = self.has_come_in()
        braked = [car.brakes(self.time) for car in self.cars]
        needless, old = self.unreasoned(chosen, braked), (self.x, [(c.x, c.y) for c in self.cars])
        self.x += self.speed * dt
        self.speed = max(self.speed + chosen * dt, 0.0)
        for car, strength in zip(self.cars, braked, strict=True):
            car.x += car.speed * math.cos(car.heading) * dt
            car.y += car.speed * math.sin(car.heading) * dt
            car.speed = max(car.speed - strength * dt, 0.0)
        self.acceleration, self.count = chosen, self.count + 1
        self.time = self.count * dt
        touched_before = self.collided
        if not self.collided:
            self.touch(old)
        for car in self.cars:
            car.heading = self.aimed(car)
        self.count_ahead()
        if not self.collided and not touched_before:
            self.needless, self.safe = needless, self.safe_distance()
            if self.config.logical_scenario == "cut-in" and self.has_come_in() and not was_in:
                self.avoidable = self.regulation()

    def touch(self, old: tuple[float, list[tuple[float, float]]]) -> None:
        """Stop the ego and the first car that it touches in this step, if it does."""
        found: tuple[float, Car, tuple[float, float]] | None = None
        for car, (x, y) in zip(self.cars, old[1], strict=True):
            first, last = (x - old[0], y), (car.x - self.x, car.y)
            share = touching(first, last, (self.length, self.width))
            if share is not None and (found is None or share < found[0]):
                found = (share, car, (x, y))
                self.impact = math.dist(first, last) / self.config.dt_s
        if found is not None:
            share, car, (x, y) = found
            self.x = old[0] + share * (self.x - old[0])
            car.x, car.y = x + share * (car.x - x), y + share * (car.y - y)
            self.speed = car.speed = 0.0
            self.collided = True

    # -- what rules ask for

    def clearance(self) -> float:
        if self.collided:
            return 0.0
        return min(
            max(abs(car.x - self.x) - self.length, abs(car.y) - self.width) for car in self.cars
        )

    def ahead(self) -> list[Car]:
        reach = (self.lane + self.width) / 2
        return [c for c in self.cars if abs(c.y) < reach and self.gap(c) + self.length > 0]

    def count_ahead(self) -> None:
        nearest = min(self.ahead(), key=self.gap, default=None)
        for car in self.cars:
            car.states_ahead = car.states_ahead + 1 if car is nearest else 0

    def margin(self, car: Car) -> float:
        strength = 2 * self.config.hard_deceleration_mps2
        needed = (self.speed**2 - car.along**2) / strength
        return self.gap(car) - max(needed + self.config.reaction_time_s * self.speed, 0.0)

    def safe_distance(self) -> float:
        steps = math.floor(self.config.recovery_time_s / self.config.dt_s + 1e-9)
        bound = self.config.gap_bound_m
        settled = [self.margin(car) for car in self.cars if car.states_ahead > steps]
        return min(max(min(settled, default=bound), -bound), bound)

    def unreasoned(self, chosen: float, braked: Sequence[float]) -> float:
        ahead = self.ahead()
        if any(self.margin(car) < 0 for car in ahead):
            return 0.0
        nearest = min(ahead, key=self.gap, default=None)
        if nearest is None:
            return max(-chosen, 0.0)
        after = max(nearest.speed - braked[self.cars.index(nearest)] * self.config.dt_s, 0.0)
        return max(-chosen - (nearest.speed - after) / self.config.dt_s, 0.0)

    def has_come_in(self) -> bool:
        return abs(self.cars[0].y) - self.width / 2 <= self.lane / 2 - 0.3

    def regulation(self) -> float:
        closing = self.speed - self.cars[0].along
        if self.time < self.cut_in + 0.72:
            return -10.0
        if closing <= 0:
            return 10.0
        spare = self.gap(self.cars[0]) / closing - (closing / 12 + 0.35)
        return min(max(spare, -10.0), 10.0)


def touching(
    first: tuple[float, float], last: tuple[float, float], reach: tuple[float, float]
) -> float | None:
    """Least share of the way at which nothing is left between: by search, as that is convex."""

    def apart(share: float) -> float:
        return max(abs(a + share * (b - a)) - r for a, b, r in zip(first, last, reach, strict=True))

    low, high = 0.0, 1.0
    for _ in range(200):
        third = (high - low) / 3
        low, high = (
            (low, high - third)
            if apart(low + third) <= apart(high - third)
            else (low + third, high)
        )
    closest = high
    if apart(0.0) <= 0.0:
        return 0.0
    if apart(closest) > 0.0:
        return None
    low, high = 0.0, closest
    while high - low > 1e-15:
        middle = (low + high) / 2
        low, high = (middle, high) if apart(middle) > 0.0 else (low, middle)
    return high
