"""A CARLA server's world: connected to, made a straight road with two cars, and given back.

The client is imported when it is first needed: it is an extra, and takes half a second.
"""

import socket
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.util import find_spec
from math import ceil
from typing import TYPE_CHECKING, Any, cast

from pemviz.config import ScenarioConfig
from pemviz.config.settings import read_address
from pemviz.errors import ConfigError, RunError
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.carla.braking import CarlaBraking, CarPlace, Pedals, gap_m, place_of

if TYPE_CHECKING:
    import carla

CONNECT_S = 5.0
ANSWER_S = 60.0
"""For making a world, which takes a server longest."""
BLUEPRINT = "vehicle.lincoln.mkz_2020"
ABOVE_ROAD_M = 0.5
SETTLE_S, LEAD_IN_S = 1.0, 1.0
LONGEST_SUBSTEP_S = 0.01
OFF_M, OFF_MPS = 0.2, 0.2
"""How far a rollout's start may be off."""
ROAD_ID, LANE_ID = 1, -1
LANE_WIDTH_M = 3.5
BEFORE_M, BEYOND_M = 30.0, 150.0
"""Before the ego's place at the start, and beyond what two cars at the initial speed cover."""


def braking_on_carla(config: ScenarioConfig, address: str) -> CarlaBraking:
    """Episodes of the braking scenario on the server at ``HOST:PORT``.

    Raises:
        ConfigError: There is no server of the client's version, or somebody else drives it.
        RunError: It does not answer any more, or refuses.
    """
    where = f"carla = {address!r}"
    return CarlaBraking(config, Stage(connected(*read_address(address)), config, where=where))


def check_installed() -> None:
    """Refuse CARLA where its client is not there.

    Raises:
        ConfigError: Says how to install it.
    """
    if find_spec("carla") is None:
        install = "pip install 'pemviz[carla]'"
        message = f"simulator = 'carla': needs CARLA's client; install it with {install}"
        raise ConfigError(message)


def connected(host: str, port: int, *, connect_s: float = CONNECT_S) -> "carla.Client":
    """The client of a server that answers within ``connect_s``.

    The server also uses the port after its first, which is ``port``.

    Raises:
        ConfigError: The client is not installed; nothing listens there, what does is no CARLA
            server, or one of another version.
    """
    check_installed()
    where = f"carla = '{host}:{port}'"
    try:
        socket.create_connection((host, port), timeout=connect_s).close()
    except OSError as error:
        why = error.strerror or str(error) or type(error).__name__
        message = f"{where}: nothing to connect to ({why}); is the server running there?"
        raise ConfigError(message) from None
    import carla  # noqa: PLC0415  an extra

    client = carla.Client(host, port)
    client.set_timeout(connect_s)
    try:
        server = client.get_server_version()
    except RuntimeError as error:
        message = f"{where}: something listens, but not as a CARLA server ({_one_line(error)})"
        raise ConfigError(message) from None
    check_version(where, client=client.get_client_version(), server=server)
    client.set_timeout(ANSWER_S)
    return client


def check_version(where: str, *, client: str, server: str) -> None:
    """Refuse a server of another version than the client's, as CARLA itself advises against.

    A server built from sources tells its commit behind the version.

    Raises:
        ConfigError: It is one.
    """
    if server.partition("-")[0] != client.partition("-")[0]:
        message = f"{where}: the server is CARLA {server}, the client {client}: must be the same"
        raise ConfigError(message)


def check_free(where: str, settings: "carla.WorldSettings") -> None:
    """Refuse a server that another client drives: both would tick it.

    Raises:
        ConfigError: It is synchronous already.
    """
    if settings.synchronous_mode:
        message = (
            f"{where}: the server is driven by another client already (synchronous mode); "
            "wait for it, or start the server anew"
        )
        raise ConfigError(message)


@contextmanager
def answering(where: str) -> Generator[None, None, None]:
    """What a server is called for meanwhile.

    Raises:
        RunError: It does not answer, or refuses.
    """
    try:
        yield
    except RuntimeError as error:
        message = f"{where}: the server is lost, or refuses: {_one_line(error)}"
        raise RunError(message) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def road_length_m(config: ScenarioConfig, *, lead_in_s: float) -> float:
    """How long the road has to be [m] where both cars drive ``lead_in_s`` before the scenario."""
    driven_s = lead_in_s + config.states * config.dt_s
    return BEFORE_M + config.initial_gap_m + config.initial_speed_mps * driven_s + BEYOND_M


def road_text(length_m: float) -> str:
    """OpenDRIVE 1.4 of one straight road along x, a lane each way."""
    lanes = "".join(
        f"""
      <{side}><lane id="{number}" type="driving" level="false">
        <width sOffset="0" a="{LANE_WIDTH_M}" b="0" c="0" d="0"/></lane></{side}>"""
        if number
        else """
      <center><lane id="0" type="none" level="false"/></center>"""
        for side, number in (("left", 1), ("center", 0), ("right", LANE_ID))
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="4" name="pemviz" version="1.00"/>
  <road name="straight" length="{length_m:.17g}" id="{ROAD_ID}" junction="-1">
    <link/>
    <planView>
      <geometry s="0" x="0" y="0" hdg="0" length="{length_m:.17g}"><line/></geometry>
    </planView>
    <elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile>
    <lanes><laneSection s="0">{lanes}
    </laneSection></lanes>
  </road>
</OpenDRIVE>
"""


def synchronous(settings: "carla.WorldSettings", dt_s: float) -> "carla.WorldSettings":
    """The settings changed to ticks of ``dt_s`` [s] that wait for a call."""
    settings.synchronous_mode = True
    settings.no_rendering_mode = True
    settings.fixed_delta_seconds = dt_s
    settings.substepping = True
    settings.max_substeps = ceil(dt_s / LONGEST_SUBSTEP_S - 1e-9)
    settings.max_substep_delta_time = dt_s / settings.max_substeps
    settings.deterministic_ragdolls = True
    return settings


class Stage:
    """A server's world, from the moment that it is ours until it is given back."""

    def __init__(self, client: "carla.Client", config: ScenarioConfig, *, where: str) -> None:
        """Make the world of the scenario; ``where`` names the server in messages.

        Raises:
            ConfigError: Somebody else drives the server.
            RunError: It does not answer, or refuses.
        """
        self.config, self.where = config, where
        self.actors: list[carla.Vehicle] = []
        self._undo: list[Callable[[], Any]] = []
        with answering(where):
            check_free(where, client.get_world().get_settings())
            length_m = road_length_m(config, lead_in_s=LEAD_IN_S)
            client.generate_opendrive_world(road_text(length_m), _plain_road())
            self.world = client.get_world()
            before = self.world.get_settings()
            self._undo.append(lambda: self.world.apply_settings(before))
            try:
                self.world.apply_settings(synchronous(self.world.get_settings(), config.dt_s))
            except BaseException:
                self.close()
                raise

    def begin(self) -> tuple[CarPlace, CarPlace]:
        """Both cars anew, at the initial gap and speed: the ego's place and the lead car's.

        Raises:
            RunError: The server does not answer, refuses, or does not bring them there.
        """
        config = self.config
        with answering(self.where):
            while self.actors:
                self.actors.pop().destroy()
            road = self.world.get_map()
            place = road.get_waypoint_xodr(ROAD_ID, LANE_ID, BEFORE_M)
            if place is None:
                message = "its world lacks the road"
                raise RuntimeError(message)
            start = place.transform
            self.along = start.get_forward_vector()
            half_m = self._spawn(start, 0.0).bounding_box.extent.x
            self._spawn(start, config.initial_gap_m - CAMERA_TO_BUMPER_M + 2.0 * half_m)
            self._tick(SETTLE_S)
            for car in self.actors:
                self._hold(car, config.initial_speed_mps)
            self._tick(LEAD_IN_S)
            ego, lead = self._places()
            self.actors[0].disable_constant_velocity()
        off_m = abs(gap_m(ego, lead) - config.initial_gap_m)
        off_mps = max(abs(car.speed_mps - config.initial_speed_mps) for car in (ego, lead))
        if off_m > OFF_M or off_mps > OFF_MPS:
            message = (
                f"{self.where}: a rollout begins {off_m:.2f} m and {off_mps:.2f} m/s off, "
                f"allowed: {OFF_M:g} m and {OFF_MPS:g} m/s"
            )
            raise RunError(message)
        return ego, lead

    def step(self, pressed: Pedals, lead_mps: float) -> tuple[CarPlace, CarPlace]:
        """Both cars one tick on, after which the lead car has the speed ``lead_mps``.

        Raises:
            RunError: The server does not answer, or refuses.
        """
        import carla  # noqa: PLC0415  an extra

        with answering(self.where):
            ego, lead = self.actors
            ego.apply_control(carla.VehicleControl(throttle=pressed.throttle, brake=pressed.brake))
            self._hold(lead, lead_mps)
            self.world.tick()
            return self._places()

    def _places(self) -> tuple[CarPlace, CarPlace]:
        ego, lead = (
            place_of(car.get_transform(), car.get_velocity(), car.bounding_box, along=self.along)
            for car in self.actors
        )
        return ego, lead

    @staticmethod
    def _hold(car: "carla.Vehicle", speed_mps: float) -> None:
        """Have a car drive ahead at a speed [m/s]."""
        import carla  # noqa: PLC0415  an extra

        car.enable_constant_velocity(carla.Vector3D(speed_mps, 0.0, 0.0))

    def close(self) -> None:
        """Give the server back as it was, but for its map; what it refuses is left."""
        undo = [*(car.destroy for car in self.actors), *reversed(self._undo)]
        self.actors, self._undo = [], []
        undo_all(undo)

    def _spawn(self, start: "carla.Transform", ahead_m: float) -> "carla.Vehicle":
        import carla  # noqa: PLC0415  an extra

        place = carla.Location(
            start.location.x + ahead_m * self.along.x,
            start.location.y + ahead_m * self.along.y,
            start.location.z + ABOVE_ROAD_M,
        )
        try:
            blueprint = self.world.get_blueprint_library().find(BLUEPRINT)
        except IndexError:
            message = f"{self.where}: the server has no vehicle {BLUEPRINT}"
            raise RunError(message) from None
        car = self.world.spawn_actor(blueprint, carla.Transform(place, start.rotation))
        self.actors.append(cast("carla.Vehicle", car))
        return self.actors[-1]

    def _tick(self, duration_s: float) -> None:
        for _ in range(ceil(duration_s / self.config.dt_s - 1e-9)):
            self.world.tick()


def undo_all(actions: list[Callable[[], Any]]) -> None:
    """Carry out all of them, in order, whatever the server refuses: it may be gone."""
    for action in actions:
        try:
            action()
        except RuntimeError:
            continue


def _plain_road() -> "carla.OpendriveGenerationParameters":
    import carla  # noqa: PLC0415  an extra

    return carla.OpendriveGenerationParameters(
        vertex_distance=2.0,
        max_road_length=50.0,
        wall_height=0.0,
        additional_width=0.6,
        smooth_junctions=True,
        enable_mesh_visibility=False,
        enable_pedestrian_navigation=False,
    )
