"""When splitting uses the compiled loops of the braking scenario, which give the same numbers."""

from dataclasses import dataclass

from pemviz.sampling.frailty import DynamicsAlone
from pemviz.sampling.rollouts.compiled_replay import is_plain
from pemviz.sampling.rollouts.kernels import Loops, are_loaded, compiled_loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.remembering import RememberingSimulator
from pemviz.types import Simulator

FIRST_BY_NUMPY = 10_000_000
"""Steps of rollouts, a few hundred at a time, in which numpy takes as long as loading the loops."""


@dataclass
class _Asked:
    """Steps so far in this process; they decide who computes, never what comes out."""

    steps: int = 0


_asked = _Asked()


def loops_for(steps: int) -> Loops | None:
    """The loops, where they are loaded or have become worth it; ``None``: numpy is to compute.

    Args:
        steps: That are to be taken, over all rollouts.
    """
    _asked.steps += steps
    return compiled_loops() if are_loaded() or _asked.steps > FIRST_BY_NUMPY else None


def plain_beneath(simulator: Simulator) -> VectorizedSimulator | None:
    """The scenario that the loops know, at or beneath one that moves its cars no otherwise."""
    while type(simulator) in (DynamicsAlone, RememberingSimulator):
        assert isinstance(simulator, DynamicsAlone | RememberingSimulator)  # noqa: S101  as asked
        simulator = simulator.scenario
    return simulator if is_plain(simulator) else None
