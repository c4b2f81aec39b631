"""One rollout in a process of its own: what the simulator does there ends nothing else.

The process tells of every step before the simulator is given it, so that the step is known at which
a process died, or stalled.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pemviz.arrays import BoolArray, FloatArray
from pemviz.faults import SimulationError
from pemviz.pem.models.protocol import Pem
from pemviz.processes import ProcessLostError, told_by_process
from pemviz.sampling.rollouts.runners import BatchTask
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.types import RolloutBatch, Simulator, StateBatch


@dataclass(frozen=True)
class GivenStep:
    """What a simulator was given.

    Attributes:
        outcome: Index of the rollout's outcome.
        detected: The outcome; of an unrolled scenario with slots, whether it is the nominal one.
        signals: Of the state that it came at, by name.
        noise: Latents of the step, where the scenario takes any with this outcome.
    """

    outcome: int
    detected: bool
    signals: Mapping[str, float]
    noise: tuple[float, ...] = ()


@dataclass(frozen=True)
class Apart:
    """What came of a rollout.

    Attributes:
        rollouts: The one, if it ran to the end.
        given: What the simulator was given, step by step, up to the one that went wrong.
        fault: What went wrong, in one line; empty if nothing did.
        traceback_text: Of what was raised, from other people's frames on.
    """

    rollouts: RolloutBatch | None = None
    given: tuple[GivenStep, ...] = ()
    fault: str = ""
    traceback_text: str = ""


def simulate_apart(
    simulator: Simulator, pem: Pem, task: BatchTask, *, limit_s: float | None = None
) -> Apart:
    """Simulate the one rollout of a task.

    A step that takes longer than ``limit_s`` is a fault [s]; ``None``: none is.

    Raises:
        RunError: Simulator or error model cannot be pickled.
    """
    found, given = Apart(), list[GivenStep]()
    try:
        for told in told_by_process(_simulate, simulator, pem, task, limit_s=limit_s):
            match told:
                case GivenStep():
                    given.append(told)
                case RolloutBatch():
                    found = Apart(told, tuple(given))
                case fault, traceback_text:
                    found = Apart(None, tuple(given), str(fault), str(traceback_text))
                case _:
                    pass
    except ProcessLostError as error:
        return Apart(None, tuple(given), str(error))
    return found


def _simulate(tell: Callable[[Any], None], simulator: Simulator, pem: Pem, task: BatchTask) -> None:
    """In the process: tell each step, then the rollout, or what was raised."""

    def tell_step(
        outcome: int, states: StateBatch, detected: BoolArray, noise: FloatArray | None
    ) -> None:
        signals = {name: float(values[0]) for name, values in states.signals.items()}
        own = () if noise is None else tuple(noise[0].tolist())
        tell(GivenStep(outcome, bool(detected[0]), signals, own))

    tell("here")  # what comes before, such as imports, has all the time that it takes
    try:
        rollouts = simulate(
            simulator=simulator,
            pem=pem,
            proposal=task.proposal,
            uniforms=task.uniforms,
            normals=task.normals,
            tell=tell_step,
        )
    except SimulationError as error:
        error.rollouts = None  # the one that is simulated
        tell((str(error), error.traceback_text))
        return
    tell(rollouts)
