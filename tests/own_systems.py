"""Systems that a package registers, for the panel: a drone, and one with slots, without a scene."""

import runpy
from pathlib import Path

from tests.scene_toys import CameraOfTwo, CutIn

_OWN = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "own_system.py"))
WallCamera = _OWN["WallCamera"]
DRONE, BLIND = "drone-at-wall", "unseen-cut-in"
RULES = {DRONE: "always[0,60] (distance >= 0.3)", BLIND: "always[0,40] (collided <= 0.5)"}


class UnseenCutIn(CutIn):
    """It does not say where its cars are."""

    scene = scene_tracks = None


def drone():
    return _OWN["DroneAtWall"]()


def unseen():
    return UnseenCutIn(name=BLIND)


PEMS = {DRONE: WallCamera(), BLIND: CameraOfTwo()}


def register(folder: Path) -> None:
    """As pip would have installed a package with them into a folder."""
    info = folder / "own_systems-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-systems\n")
    points = f"{DRONE} = tests.own_systems:drone\n{BLIND} = tests.own_systems:unseen\n"
    (info / "entry_points.txt").write_text(f"[pemviz.simulators]\n{points}")
