"""Two cars on a straight road in a CARLA server's world, and what is left of them afterwards."""

from collections.abc import Callable
from math import ceil
from typing import TYPE_CHECKING, Any, cast

from pemviz.config import ScenarioConfig
from pemviz.errors import RunError
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.carla.motion import CarPlace, Pedals, gap_m, place_of
from pemviz.simulators.carla.road import BEFORE_M, LANE_ID, ROAD_ID, road_length_m, road_text
from pemviz.simulators.carla.server import answering, check_free

if TYPE_CHECKING:
    import carla

BLUEPRINT = "vehicle.lincoln.mkz_2020"
ABOVE_ROAD_M = 0.5
SETTLE_S, LEAD_IN_S = 1.0, 1.0
LONGEST_SUBSTEP_S = 0.01
OFF_M, OFF_MPS = 0.2, 0.2
"""How far a rollout's start may be off."""


def synchronous(settings: "carla.WorldSettings", dt_s: float) -> "carla.WorldSettings":
    """The settings changed to ticks of ``dt_s`` [s] that wait to be asked for."""
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
        """Make the world.

        Args:
            client: Of the server.
            config: The scenario.
            where: The server, for messages.

        Raises:
            ConfigError: Somebody else drives the server.
            RunError: It does not answer, or refuses.
        """
        self.config, self.where = config, where
        self.actors: list[carla.Vehicle] = []
        self._undo: list[Callable[[], Any]] = []
        with answering(where):
            check_free(where, client.get_world().get_settings())
            client.generate_opendrive_world(
                road_text(road_length_m(config, lead_in_s=LEAD_IN_S)), _plain_road()
            )
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
            self.clear()
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
                self.hold(car, config.initial_speed_mps)
            self._tick(LEAD_IN_S)
            ego, lead = self.places()
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
        """Both cars one tick on.

        Args:
            pressed: The ego's pedals.
            lead_mps: Speed that the lead car has after it.

        Raises:
            RunError: The server does not answer, or refuses.
        """
        import carla  # noqa: PLC0415  an extra

        with answering(self.where):
            ego, lead = self.actors
            ego.apply_control(carla.VehicleControl(throttle=pressed.throttle, brake=pressed.brake))
            self.hold(lead, lead_mps)
            self.world.tick()
            return self.places()

    def places(self) -> tuple[CarPlace, CarPlace]:
        """Where both cars are."""
        ego, lead = (
            place_of(car.get_transform(), car.get_velocity(), car.bounding_box, along=self.along)
            for car in self.actors
        )
        return ego, lead

    @staticmethod
    def hold(car: "carla.Vehicle", speed_mps: float) -> None:
        """Have a car drive ahead at a speed [m/s]."""
        import carla  # noqa: PLC0415  an extra

        car.enable_constant_velocity(carla.Vector3D(speed_mps, 0.0, 0.0))

    def clear(self) -> None:
        """Take both cars away."""
        while self.actors:
            self.actors.pop().destroy()

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
