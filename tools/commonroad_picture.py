"""A counterexample as CommonRoad's own renderer draws it, for the README.

    python tools/commonroad_picture.py --out assets/pictures/commonroad.png

Exports rank 1 of a run folder (the sample run) with ``pemviz export``, reads the file with
commonroad-io and draws it at the start, at the first and the last step that perception missed, and
at contact. Needs the extra ``pemviz[export]``.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.visualization.draw_params import MPDrawParams
from commonroad.visualization.mp_renderer import MPRenderer
from matplotlib import pyplot as plt

from pemviz.cli.main import main as pemviz
from pemviz.colors import EGO, LEAD
from pemviz.export.commonroad import EGO_ID, LEAD_ID
from pemviz.export.motion import braking_motion
from pemviz.runs.kept_rollout import read_kept_rollout

SIZE_IN, DPI = (9.0, 3.6), 100
SHOWN_M = (-2.0, 80.0, -2.6, 2.6)


def main() -> int:
    """Export, read back, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--run", type=Path, default=Path("recordings/sample"))
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rollout.xml"
        code = pemviz(["export", str(arguments.run), "--format", "commonroad", "--out", str(path)])
        if code:
            return code
        scenario, _ = CommonRoadFileReader(str(path)).open()
    motion = braking_motion(read_kept_rollout(arguments.run, rank=1), form="commonroad")
    moments = {"start": 0, "first miss": motion.missed[0], "last miss": motion.missed[-1]}
    if motion.contact is not None:
        moments["contact"] = motion.contact.step
    mpl.use("Agg")
    figure, axes = plt.subplots(len(moments), 1, figsize=SIZE_IN)
    for place, (name, step) in zip(np.atleast_1d(axes), moments.items(), strict=True):
        _draw(scenario, place, int(step))
        place.set_title(f"{name}, {step * scenario.dt:.2f} s", fontsize=9, loc="left", pad=3)
        place.tick_params(labelbottom=False)
    place.tick_params(labelbottom=True)
    place.set_xlabel("along the road [m]", fontsize=9)
    figure.tight_layout()
    figure.savefig(arguments.out, dpi=DPI)
    return 0


def _draw(scenario, place, step: int) -> None:  # noqa: ANN001  their libraries' own
    renderer = MPRenderer(ax=place, plot_limits=list(SHOWN_M))
    params = MPDrawParams()
    params.time_begin = params.time_end = step
    scenario.lanelet_network.draw(renderer, draw_params=params)
    for number, color in ((EGO_ID, EGO), (LEAD_ID, LEAD)):
        params.dynamic_obstacle.vehicle_shape.occupancy.shape.facecolor = color
        params.dynamic_obstacle.vehicle_shape.occupancy.shape.edgecolor = color
        scenario.obstacle_by_id(number).draw(renderer, draw_params=params.dynamic_obstacle)
    renderer.render()
    place.set_yticks([])
    place.tick_params(labelsize=8)


if __name__ == "__main__":
    sys.exit(main())
