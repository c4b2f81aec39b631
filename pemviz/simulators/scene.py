"""What a scenario may offer so that views draw it: cars on a road, tracks, measurement errors.

The frame is the world's: x along the road, y to its left [m], headings counterclockwise from x
[rad]; x and y are those of a car's centre. Any simulator may offer it, shipped or not: a view finds
it by :mod:`pemviz.simulators.drawn_scene`, and draws whatever states files hold.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.types import StateBatch


@dataclass(frozen=True)
class SceneZone:
    """A stretch of road ahead of a car that its controller treats apart.

    Attributes:
        ahead_m: How far it reaches from the car's front bumper.
        words: What happens in it, for labels.
    """

    ahead_m: float
    words: str


@dataclass(frozen=True)
class SceneCar:
    """One car of a scene.

    Attributes:
        name: For labels, e.g. ``lead``.
        length_m: Bumper to bumper.
        width_m: Side to side.
        height_m: Ground to roof.
        slot: Name of the slot whose outcomes are about this car; ``None``: perception is not
            about it. Without slots, outcomes are about the first car after the ego.
        zone: Drawn on the road ahead of it.
    """

    name: str
    length_m: float = 5.0
    width_m: float = 2.0
    height_m: float = 1.5
    slot: str | None = None
    zone: SceneZone | None = None


@dataclass(frozen=True)
class Ramp:
    """A lane that comes to a straight road from beside, or leaves it.

    Attributes:
        x_m: Where along the road its edges are given [m], ascending, at least two.
        right_m: y of its right edge there [m].
        left_m: y of its left edge there [m], greater. Where either edge is the road's, cars may
            change between ramp and road.
    """

    x_m: tuple[float, ...]
    right_m: tuple[float, ...]
    left_m: tuple[float, ...]


@dataclass(frozen=True)
class Road:
    """A straight road.

    Attributes:
        lane_edges_m: y of its lines [m], ascending, at least two; those between the first and the
            last part lanes.
        ramps: What joins it from either side.
    """

    lane_edges_m: tuple[float, ...]
    ramps: tuple[Ramp, ...] = ()

    @property
    def right_m(self) -> float:
        """Its right edge's y, or of a ramp's that reaches farther [m]."""
        return min((self.lane_edges_m[0], *(y for ramp in self.ramps for y in ramp.right_m)))

    @property
    def left_m(self) -> float:
        """Its left edge's y, or of a ramp's that reaches farther [m]."""
        return max((self.lane_edges_m[-1], *(y for ramp in self.ramps for y in ramp.left_m)))


@dataclass(frozen=True)
class SceneStates:
    """Where C cars are in states ``[...]``.

    Attributes:
        x_m: Centre along the road, ``[..., C]`` [m].
        y_m: Centre to the left, ``[..., C]`` [m].
        heading_rad: ``[..., C]``, counterclockwise from the road's direction [rad].
        speed_mps: ``[..., C]`` [m/s].
        present: ``[..., C]`` whether the car is there at all; the rest counts only where it is.
        collided: ``[...]`` whether the ego has touched another car.
        impact_speed_mps: ``[...]`` how fast the ego and a car close in [m/s], read where they
            first touch; ``None``: the scenario does not tell.
    """

    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray
    speed_mps: FloatArray
    present: BoolArray
    collided: BoolArray
    impact_speed_mps: FloatArray | None = None

    @property
    def of_cars(self) -> FloatArray:
        """Each car's x, y [m], heading [rad] and speed [m/s], ``[..., C, 4]``."""
        return np.stack([self.x_m, self.y_m, self.heading_rad, self.speed_mps], axis=-1)


@dataclass(frozen=True)
class SceneTracks:
    """Where the controller believes the car of each of K slots to be, in states ``[...]``.

    Attributes:
        x_m: Its centre along the road, ``[..., K]`` [m].
        y_m: Its centre to the left, ``[..., K]`` [m].
        x_sd_m: Standard deviation of ``x_m``, ``[..., K]`` [m]; 0 where none is known.
        y_sd_m: Standard deviation of ``y_m``, ``[..., K]`` [m].
        confirmed: ``[..., K]`` whether there is a track that the controller acts on; the rest
            counts only where there is.
    """

    x_m: FloatArray
    y_m: FloatArray
    x_sd_m: FloatArray
    y_sd_m: FloatArray
    confirmed: BoolArray


@runtime_checkable
class DrawsScene(Protocol):
    """A scenario that tells where its cars are."""

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The C cars, the ego first."""
        ...

    @property
    def road(self) -> Road:
        """What they drive on."""
        ...

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Signals ``[...]`` to where the cars are: signals are what files hold of a rollout."""
        ...


@runtime_checkable
class DrawsTracks(Protocol):
    """A scenario that tells where its controller believes cars to be."""

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        """States ``[...]``, memory included, to the tracks of the K slots, 1 without slots."""
        ...


@runtime_checkable
class TellsErrors(Protocol):
    """A scenario with latents of steps that says what errors they make.

    Any :class:`pemviz.Simulator` may offer it; views then show errors in place of latents.
    """

    def measurement_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Measured minus true values at each step of one rollout [m].

        Args:
            signals: ``[T]`` by name.
            memory: ``[T]`` by name, what its states remember.

        Returns:
            ``[T-1]`` by what was measured; NaN where nothing was.
        """
        ...


@runtime_checkable
class FilmsRollouts(Protocol):
    """A system that draws one of its rollouts: a recording then holds a film of the least robust.

    One that cannot always draw, as a gymnasium environment by its ``render_mode``, says so by an
    attribute ``films``.
    """

    def pictures(
        self, outcomes: BoolArray, *, start: FloatArray | None = None
    ) -> Iterator[AnyArray]:
        """A picture of each state, ``[H, W, 3]`` of bytes (red, green, blue).

        Args:
            outcomes: Perception's, ``[T-1]``, with slots ``[T-1, K]``.
            start: Latents at the start ``[S]``, if it takes any.
        """
        ...
