"""What simulator sumo is asked for."""

from dataclasses import dataclass
from typing import Literal

SumoModel = Literal["idm", "krauss", "acc"]


@dataclass(frozen=True, kw_only=True)
class SumoConfig:
    """With simulator sumo; ``pemviz.simulators.sumo`` tells exactly."""

    model: SumoModel = "idm"
    """Car-following model of SUMO's that other cars of a family drive by: idm (intelligent driver
    model), krauss (SUMO's default) or acc (adaptive cruise control)."""
