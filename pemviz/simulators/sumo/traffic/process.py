"""Episodes in a process that has libsumo, and makes processes of itself, one for each at a time.

``python -m pemviz.simulators.sumo.traffic.process FD`` reads sockets from its own one, FD, and
forks a process that serves each. It has no threads and nothing of pemviz's but this package: a
fork is safe, and costs a millisecond where an import of libsumo costs most of a second. What SUMO
prints stays in the process; it ends when the other end of its socket is closed.
"""

import array
import json
import os
import signal
import socket
import struct
import sys
import tempfile
from dataclasses import dataclass
from typing import Any, BinaryIO

from pemviz.simulators.sumo.traffic import places
from pemviz.simulators.sumo.traffic.messages import (
    ENDED,
    NOBODY_M,
    OF_EGO,
    OTHERS,
    RESET,
    RUNNING,
    SLOTS,
    WRONG,
    Pipe,
    TrafficSettings,
)
from pemviz.simulators.sumo.traffic.places import Body, Car

LATEST_S = 3600.0
"""Of SUMO's time: by then the ego has to have entered."""
AROUND_M = 130.0
COLLIDED = OF_EGO.index("collided")
ROUNDING_S = 1e-6
OUR_SPEED, SUMOS_SPEED = 32, 31
"""Speed modes: exactly what is set; or as SUMO's drivers do."""
HELD = ("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true",
        "--collision.action", "none")  # fmt: skip


@dataclass(frozen=True)
class Before:
    """What a step is compared with.

    Attributes:
        ego_mps: The ego's speed.
        leader: The car ahead in the path.
        leader_mps: Its speed.
        margin_m: The gap to it less its safe distance.
        led_s: For how long it has been there.
    """

    ego_mps: float
    leader: str | None
    leader_mps: float
    margin_m: float
    led_s: float


class Episode:
    """SUMO with the ego in it."""

    def __init__(self, library: Any, settings: TrafficSettings) -> None:
        """Nothing is loaded yet by ``library``, libsumo."""
        self._sumo, self._settings = library, settings
        self._started = False
        self._sizes: dict[str, tuple[float, float]] = {}
        self._slots: list[str | None] = [None] * len(SLOTS)
        self._others: list[str | None] = [None] * len(OTHERS)
        self._begun_m = 0.0
        self._before: Before | None = None
        self._values: list[float] = []

    def reset(self, seed: int) -> list[float]:
        """Begin with SUMO's seed; the signals, in order.

        Raises:
            LookupError: The ego does not enter, or leaves before the rollout begins.
            Exception: libsumo's own.
        """
        sumo, settings, ego = self._sumo, self._settings, self._settings.ego
        options = ["-c", settings.config, "--seed", str(seed), *HELD]
        options += ["--step-length", f"{settings.step_s:.3f}"]
        if self._started:
            sumo.load(options)
        else:
            sumo.start(["sumo", *options])
            self._started = True
        self._sizes.clear()
        while ego not in sumo.vehicle.getIDList():
            over = sumo.simulation.getTime() > LATEST_S
            if over or sumo.simulation.getMinExpectedNumber() <= 0:
                raise LookupError(f"no vehicle {ego!r} enters; which one is the ego? (sumo.ego)")
            sumo.simulationStep()
        sumo.vehicle.setLaneChangeMode(ego, 0)
        for _ in range(round(settings.warm_up_s / settings.step_s)):
            sumo.simulationStep()
        if ego not in sumo.vehicle.getIDList():
            raise LookupError(f"the ego {ego!r} leaves before its rollout begins (sumo.warm_up_s)")
        constants = sumo.constants
        of_each = [constants.VAR_POSITION, constants.VAR_ANGLE, constants.VAR_SPEED]
        about = constants.CMD_GET_VEHICLE_VARIABLE
        sumo.vehicle.subscribeContext(ego, about, AROUND_M, of_each)
        sumo.vehicle.setSpeedMode(ego, OUR_SPEED)
        self._begun_m, self._before = sumo.vehicle.getDistance(ego), None
        self._slots, self._others = [None] * len(SLOTS), [None] * len(OTHERS)
        self._values = self._signals()
        return self._values

    def step(self, acceleration_mps2: float) -> tuple[list[float], bool]:
        """The signals after a step with the ego's acceleration, and whether the episode has ended.

        Raises:
            Exception: libsumo's own.
        """
        sumo, ego = self._sumo, self._settings.ego
        speed_mps = sumo.vehicle.getSpeed(ego) + acceleration_mps2 * self._settings.step_s
        sumo.vehicle.setSpeed(ego, max(speed_mps, 0.0))
        sumo.simulationStep()
        if ego not in sumo.vehicle.getIDList():  # its route is over
            return self._values, True
        self._values = self._signals()
        return self._values, self._values[COLLIDED] > 0.0

    def _signals(self) -> list[float]:
        """Signals now, in the order of :data:`NAMES`."""
        ego, cars = self._bodies()
        around = {name: places.seen_from(ego, body) for name, body in cars.items()}
        self._slots = places.perceived(around, self._slots)
        self._others = places.pictured(around, self._slots, self._others)
        clearance_m = min([c.apart_m for c in around.values() if c.ahead], default=NOBODY_M)
        leader = places.leader_of(around)
        margin_m = places.safety_margin_m(ego.speed_mps, around.get(leader or ""))
        acceleration_mps2, needless_mps2 = self._braking(ego.speed_mps, around)
        before, led_s = self._before, 0.0
        if before is not None and before.leader == leader:
            led_s = before.led_s + self._settings.step_s
        lead_mps = around[leader].speed_mps if leader else 0.0
        self._before = Before(ego.speed_mps, leader, lead_mps, margin_m, led_s)
        vehicle, own = self._sumo.vehicle, self._settings.ego
        return [
            vehicle.getDistance(own) - self._begun_m,
            ego.speed_mps,
            acceleration_mps2,
            vehicle.getAllowedSpeed(own),
            clearance_m,
            margin_m if led_s >= places.RECOVERY_S - ROUNDING_S else NOBODY_M,
            needless_mps2,
            float(clearance_m <= 0.0),
            *(value for name in self._slots for value in _placed(around, name)),
            *(value for name in self._others for value in _placed(around, name)[:3]),
        ]

    def _braking(self, ego_mps: float, around: dict[str, Car]) -> tuple[float, float]:
        """The ego's acceleration in the step, and how much it braked beyond need [m/s^2]."""
        before, step_s = self._before, self._settings.step_s
        if before is None:
            return 0.0, 0.0
        acceleration_mps2 = (ego_mps - before.ego_mps) / step_s
        if before.margin_m < 0.0:
            return acceleration_mps2, 0.0
        lead_mps2 = 0.0
        if before.leader is not None and before.leader in around:
            lead_mps2 = (around[before.leader].speed_mps - before.leader_mps) / step_s
        return acceleration_mps2, max(min(lead_mps2, 0.0) - acceleration_mps2, 0.0)

    def _bodies(self) -> tuple[Body, dict[str, Body]]:
        """The ego and the cars around it."""
        vehicle, own = self._sumo.vehicle, self._settings.ego
        found = vehicle.getContextSubscriptionResults(own)
        constants = self._sumo.constants
        bodies: dict[str, Body] = {}
        for name, of_car in found.items():
            if name not in self._sizes:
                self._sizes[name] = vehicle.getLength(name), vehicle.getWidth(name)
            bodies[name] = Body(
                of_car[constants.VAR_POSITION],
                of_car[constants.VAR_ANGLE],
                of_car[constants.VAR_SPEED],
                *self._sizes[name],
            )
        return bodies.pop(own), bodies


def _placed(cars: dict[str, Car], name: str | None) -> tuple[float, float, float, float]:
    """Gap, offset, speed and heading of who has a place, if anybody."""
    if name is None:
        return NOBODY_M, 0.0, 0.0, 0.0
    car = cars[name]
    return car.gap_m, car.aside_m, car.speed_mps, car.heading_rad


def main() -> None:
    """Serve until the other end is closed."""
    own = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent alone acts on Ctrl-C
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that end
    os.environ["LIBSUMO_AS_TRACI"] = "quiet"
    import libsumo  # noqa: PLC0415  an extra

    while True:
        message, given, _, _ = socket.recv_fds(own, 1, 1)
        if not message:
            return
        if os.fork() == 0:
            own.close()
            _serve(Pipe(socket.socket(fileno=given[0])), libsumo)
            os._exit(0)
        os.close(given[0])


def _serve(pipe: Pipe, library: Any) -> None:
    """Answer until the pipe is closed."""
    with tempfile.TemporaryFile() as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        try:
            episode = Episode(library, TrafficSettings(**json.loads(pipe.receive())))
            while True:
                pipe.send(_answer(episode, pipe.receive(), printed))
        except (EOFError, OSError):
            pass


def _answer(episode: Episode, request: bytes, printed: BinaryIO) -> bytes:
    """The answer to a request; what goes wrong is an answer too."""
    kind, given = request[:1], request[1:]
    try:
        if kind == RESET:
            values, ended = episode.reset(*struct.unpack("q", given)), False
        else:
            values, ended = episode.step(*struct.unpack("d", given))
    except LookupError as error:
        return WRONG + str(error.args[0]).encode()
    except Exception as error:  # in SUMO's printed words, if there are any
        printed.seek(0)
        lines = printed.read().decode(errors="replace").splitlines()
        words = [line.removeprefix("Error:") for line in lines if line.startswith("Error:")]
        words = words or [str(error) or type(error).__name__]
        return WRONG + " ".join(" ".join(words).split()).encode()
    return (ENDED if ended else RUNNING) + array.array("d", values).tobytes()


if __name__ == "__main__":
    main()
