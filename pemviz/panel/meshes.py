"""Shapes of the scene as vertices ``[V, 3]`` in metres and triangles ``[F, 3]``."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray

Profile = list[tuple[float, float]]

CAR_LENGTH_M = 5.0
WIDTH_M = 1.75
HEIGHT_M = 1.55
BODY: Profile = [(0.0, 0.3), (5.0, 0.3), (5.0, 0.72), (4.85, 0.84), (0.15, 0.98), (0.0, 0.88)]
CABIN: Profile = [(0.45, 0.93), (3.75, 0.82), (2.95, 1.42), (2.55, 1.5), (1.2, 1.5), (0.9, 1.42)]
ROOF: Profile = [(1.05, 1.48), (2.75, 1.46), (2.5, 1.54), (1.3, 1.55)]
WHEELS_X_M = (0.95, 4.05)
WHEEL_RADIUS_M = 0.34


@dataclass(frozen=True)
class Mesh:
    """Triangles."""

    vertices: FloatArray
    faces: IntArray


def extruded(profile: Profile, *, width: float, y: float = 0.0) -> Mesh:
    """A convex counter-clockwise profile in x and z, extruded along y around ``y``."""
    count = len(profile)
    outline = np.asarray(profile, dtype=np.float64)
    sides = [
        np.stack([outline[:, 0], np.full(count, y + side * width / 2), outline[:, 1]], axis=1)
        for side in (-1, 1)
    ]
    faces: list[tuple[int, int, int]] = []
    for place in range(1, count - 1):
        faces.append((0, place, place + 1))
        faces.append((count, count + place + 1, count + place))
    for place in range(count):
        after = (place + 1) % count
        faces.append((place, count + place, after))
        faces.append((after, count + place, count + after))
    return Mesh(np.concatenate(sides), np.asarray(faces, dtype=np.int64))


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(mesh.vertices.shape[0] for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]
        ),
    )


def disc(*, radius: float, x: float = 0.0, z: float = 0.0, sides: int = 16) -> Profile:
    """A round profile."""
    angles = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    points = zip(x + radius * np.cos(angles), z + radius * np.sin(angles), strict=True)
    return [(float(px), float(pz)) for px, pz in points]


def car_body() -> Mesh:
    """Body and roof of a car; its rear at x = 0, the ground at z = 0."""
    return joined(extruded(BODY, width=WIDTH_M), extruded(ROOF, width=WIDTH_M - 0.32))


def car_glass() -> Mesh:
    """The car's windows."""
    return extruded(CABIN, width=WIDTH_M - 0.18)


def car_wheels() -> Mesh:
    """The car's four wheels."""
    return joined(
        *(
            extruded(disc(radius=WHEEL_RADIUS_M, x=x, z=WHEEL_RADIUS_M), width=0.22, y=y)
            for x in WHEELS_X_M
            for y in (-WIDTH_M / 2 + 0.08, WIDTH_M / 2 - 0.08)
        )
    )


def hit_mark() -> Mesh:
    """A flat lozenge on the road."""
    profile: Profile = [(-0.28, 0.0), (0.28, 0.0), (0.28, 0.05), (-0.28, 0.05)]
    return extruded(profile, width=0.5)


def miss_mark() -> Mesh:
    """An upright cross, which differs from the hit's mark in more than colour."""
    bar: Profile = [(-0.42, -0.07), (0.42, -0.07), (0.42, 0.07), (-0.42, 0.07)]
    arms: list[Mesh] = []
    for angle in (np.pi / 4, -np.pi / 4):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = np.asarray(bar) @ turn.T + np.array([0.0, 0.42])
        arms.append(extruded([(float(x), float(z)) for x, z in turned], width=0.14))
    return joined(*arms)
