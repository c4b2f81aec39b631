"""Particles of multilevel splitting moved on under the error model, from where they are."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.draw import logit_of
from pemviz.sampling.slots import unrolled
from pemviz.sampling.state.composed import carried_at
from pemviz.simulators.latents import salient_of, stepped
from pemviz.types import RolloutBatch, StateBatch


@dataclass(frozen=True, eq=False)
class CutRollouts:
    """M rollouts that are to go on, each from one of its states.

    Attributes:
        rollouts: With all that is known of them; overwritten after ``cut``.
        cut: The last state that each keeps, ``[M]``, ascending.
        uniforms: ``[T-1, M]`` draws from [0, 1) for the outcomes after it.
        noise: Latents of all steps, ``[M, T-1, ...]``, of which those after it count.
    """

    rollouts: RolloutBatch
    cut: IntArray
    uniforms: FloatArray
    noise: FloatArray


def moved_on(problem: Problem, started: CutRollouts) -> RolloutBatch:
    """The rollouts to their ends, under the error model; the given ones are overwritten."""
    simulator, rollouts, cut = problem.simulator, started.rollouts, started.cut
    slots = unrolled(simulator)
    arriving = carried_at(simulator, rollouts, step=cut)
    carried = {name: values[:0] for name, values in arriving.items()}
    for step in range(int(cut[0]), rollouts.detected.shape[1]):
        problem.pause()
        active = int(np.searchsorted(cut, step, side="right"))
        before = states_at(rollouts, step, active)
        carried = {
            name: np.concatenate([values, arriving[name][len(values) : active]])
            for name, values in carried.items()
        }
        before = replace(before, memory={**before.memory, **carried})
        before = before if slots is None else slots.seen(before)
        salient = salient_of(simulator, before)
        logit = logit_of(problem.pem, salient, step=step // problem.turns)
        detected = started.uniforms[step, :active] >= expit(-logit)
        noise = _drawn_noise(started, step, active, turns=problem.turns)
        after = stepped(simulator, before, detected, noise)
        rollouts.pem_logit[:active, step] = logit
        rollouts.detected[:active, step] = detected
        carried = {name: v for name, v in after.memory.items() if name not in rollouts.memory}
        for kept, reached in ((rollouts.signals, after.signals), (rollouts.memory, after.memory)):
            for name in kept:
                kept[name][:active, step + 1] = reached[name]
    return replace(rollouts, proposal_logit=rollouts.pem_logit)


def states_at(rollouts: RolloutBatch, step: int, active: int) -> StateBatch:
    """The kept states of the first ``active`` rollouts."""
    return StateBatch(
        step=np.array(step, dtype=np.int64),
        signals={name: values[:active, step] for name, values in rollouts.signals.items()},
        memory={name: values[:active, step] for name, values in rollouts.memory.items()},
    )


def is_last_of_step(rollouts: RolloutBatch, outcome: int, *, turns: int) -> bool:
    """Whether there is noise in the scenario, and an outcome is followed by it."""
    latents = rollouts.latents
    return latents is not None and latents.noise.shape[2] > 0 and (outcome + 1) % turns == 0


def _drawn_noise(started: CutRollouts, step: int, active: int, *, turns: int) -> FloatArray | None:
    """The noise ``[active, M]`` of the step that an outcome belongs to, written to the rollouts."""
    latents = started.rollouts.latents
    if latents is None or not is_last_of_step(started.rollouts, step, turns=turns):
        return None
    latents.noise[:active, step // turns] = started.noise[:active, step // turns]
    return latents.noise[:active, step // turns]
