"""What simulator sumo is asked for."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pemviz.config.ranges import Range

SumoModel = Literal["idm", "krauss", "acc"]


@dataclass(frozen=True, kw_only=True)
class SumoConfig:
    """With simulator sumo; ``pemviz.simulators.sumo`` tells exactly."""

    model: SumoModel = "idm"
    """Car-following model of SUMO's that the encounter's other cars drive by: idm (intelligent
    driver model), krauss (SUMO's default) or acc (adaptive cruise control)."""
    config: str | None = None
    """Traffic of SUMO's own, in place of encounters: free-traffic, which is shipped, or a .sumocfg
    file with the ego in it."""
    ego: str = "ego"
    """Which vehicle of that traffic is the ego: its id."""
    warm_up_s: Annotated[float, Range(low=0.0, high=10_000.0)] = 10.0
    """How long SUMO drives the ego in traffic, once it has entered, before a rollout begins [s]; 0
    to 10000."""
    step_s: Annotated[float, Range(low=0.001, high=1.0)] = 0.1
    """Time step in traffic [s], in place of the file's; whole milliseconds, 0.001 to 1."""
    states: Annotated[int, Range(low=2, high=100_000)] = 101
    """States in a rollout in traffic (T); perception acts at all but the last; 2 to 100000."""

    @property
    def dt_s(self) -> float:
        """Time step in traffic [s]."""
        return self.step_s
