"""The simulator of an experiment with what methods and views may know about it."""

from dataclasses import dataclass

import numpy as np

from pemviz.pem import PositionErrorModel
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.simulators.latents import begun
from pemviz.types import Simulator

GAP = "gap"


@dataclass(frozen=True)
class BackEnd:
    """A simulator and what methods and views may know about it.

    Attributes:
        simulator: The simulator.
        features: What proposals may look at.
        twin: A fast simulator of the same scenario, if there is one.
        batch_rollouts: How many rollouts are simulated at a time.
        is_own: Whether it is the user's own or another package's.
        position_errors: Of what the shipped scenario measures; ``None``: it measures exactly.
        single_outcomes: The scenario without hidden properties; ``None``: it has none.
    """

    simulator: Simulator
    features: StateFeatures
    twin: Simulator | None
    batch_rollouts: int
    is_own: bool = False
    position_errors: PositionErrorModel | None = None
    single_outcomes: "BackEnd | None" = None

    @property
    def scenario_alone(self) -> "BackEnd":
        """The back end without hidden properties."""
        return self if self.single_outcomes is None else self.single_outcomes

    @property
    def farthest_m(self) -> float | None:
        """The initial gap [m], of a random one the median; ``None`` where there is no gap."""
        if all(signal.name != GAP for signal in self.simulator.signals):
            return None
        return float(np.max(begun(self.simulator, count=1).signals[GAP]))
