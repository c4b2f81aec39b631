"""When splitting uses the compiled loops of the braking scenario, which give the same numbers."""

from pemviz.compiling import LoadedInTime
from pemviz.sampling.frailty import DynamicsAlone
from pemviz.sampling.rollouts.compiled_replay import is_plain
from pemviz.sampling.rollouts.kernels import Loops, compiled_loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.remembering import RememberingSimulator
from pemviz.types import Simulator

FIRST_BY_NUMPY = 10_000_000
"""Steps of rollouts, a few hundred at a time, in which numpy takes as long as loading the loops."""
FIRST_WHERE_LOADED = 500_000
"""The same where numba has been imported: what is compiled is read in some 50 ms."""


STEPS_ASKED = LoadedInTime(compiled_loops, FIRST_BY_NUMPY, FIRST_WHERE_LOADED)
"""By how many steps were to be taken."""


def loops_for(steps: int) -> Loops | None:
    """The loops, where they have become worth it; ``None``: numpy is to compute.

    Args:
        steps: That are to be taken, over all rollouts.
    """
    return STEPS_ASKED.loops_for(steps)


def plain_beneath(simulator: Simulator) -> VectorizedSimulator | None:
    """The scenario that the loops know, at or beneath one that moves its cars no otherwise."""
    while type(simulator) in (DynamicsAlone, RememberingSimulator):
        assert isinstance(simulator, DynamicsAlone | RememberingSimulator)  # noqa: S101  as asked
        simulator = simulator.scenario
    return simulator if is_plain(simulator) else None
