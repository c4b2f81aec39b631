"""The simulator of an experiment with what is known about it."""

from dataclasses import dataclass

import numpy as np

from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.proposals.offset_logistic import SignalFeatures, StateFeatures
from pemviz.sampling.problem import BATCH_ROLLOUTS
from pemviz.sampling.rollouts.devices import is_gpu
from pemviz.sampling.rollouts.final_batch import largest_part
from pemviz.simulators.braking.features import BrakingFeatures
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.check import check_simulator
from pemviz.simulators.registry import SHIPPED, build_named_simulator
from pemviz.types import Simulator

SLOW_BATCH_ROLLOUTS = 50
OWN_BATCH_ROLLOUTS = 500
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
    """

    simulator: Simulator
    features: StateFeatures
    twin: Simulator | None
    batch_rollouts: int
    is_own: bool = False

    @property
    def farthest_m(self) -> float | None:
        """The initial gap [m]; ``None`` where the scenario has no gap."""
        if all(signal.name != GAP for signal in self.simulator.signals):
            return None
        return float(np.max(self.simulator.initial(count=1).signals[GAP]))


def build_back_end(config: ExperimentConfig) -> BackEnd:
    """The back end that ``config`` names, shipped or registered.

    Raises:
        ConfigError: There is none of that name, or it does not keep to the protocol.
    """
    simulator = build_named_simulator(config.simulator, config.scenario)
    if config.simulator not in SHIPPED:
        return own_back_end(simulator)
    return BackEnd(
        simulator=simulator,
        features=BrakingFeatures(config.scenario),
        twin=VectorizedSimulator(config.scenario),
        batch_rollouts=batch_rollouts(config),
    )


def batch_rollouts(config: ExperimentConfig) -> int:
    """How many rollouts are simulated at a time; the result does not depend on it."""
    if config.simulator == "highway-env":
        return SLOW_BATCH_ROLLOUTS
    largest = largest_part(states=config.scenario.states)
    return largest if is_gpu(config.device) else min(BATCH_ROLLOUTS, largest)


def own_back_end(simulator: Simulator, *, twin: Simulator | None = None) -> BackEnd:
    """A simulator of the user's own, tried out, with a twin of its own if it has one.

    Raises:
        ConfigError: One of them does not keep to the protocol, or they differ in their states.
    """
    check_simulator(simulator)
    if twin is not None:
        check_simulator(twin)
        if (twin.states, twin.signals) != (simulator.states, simulator.signals):
            message = f"twin of simulator {simulator.name!r}: must have the same states and signals"
            raise ConfigError(message)
    return BackEnd(
        simulator=simulator,
        features=SignalFeatures(simulator.signals),
        twin=twin,
        batch_rollouts=min(OWN_BATCH_ROLLOUTS, largest_part(states=simulator.states)),
        is_own=True,
    )


def check_method_fits(config: ExperimentConfig, back_end: BackEnd) -> None:
    """Check that the back end has what the method needs.

    Raises:
        ConfigError: It has not; the line names methods that fit.
    """
    lacks_twin = back_end.twin is None
    name = back_end.simulator.name
    if config.method == "value-twisted" and lacks_twin:
        message = (
            f"method = 'value-twisted': needs a fast twin, and simulator {name!r} has none; "
            "use mixture, with splitting as an independent check"
        )
        raise ConfigError(message)
    if config.reference and lacks_twin:
        message = (
            f"reference = true: the reference needs a fast twin, and simulator {name!r} has none; "
            "use method splitting as an independent check"
        )
        raise ConfigError(message)
    if config.method == "adaptive" and back_end.farthest_m is None:
        message = (
            f"method = 'adaptive': its proposal sees the gap alone, and simulator {name!r} has no "
            "signal 'gap'; use mixture, with splitting as an independent check"
        )
        raise ConfigError(message)
