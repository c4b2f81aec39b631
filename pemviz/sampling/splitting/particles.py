"""Particles of multilevel splitting: rollouts that can be cut and moved on under the error model.

A particle keeps its states at all steps, so that it goes on from any of them without being
replayed. N particles of T states take about N T (8 (signals + memory) + 19) bytes, and up to
three times that while a level's particles are replaced.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, Batch, FloatArray, IntArray
from pemviz.errors import ConfigError
from pemviz.faults import of_no_rollouts, reordered
from pemviz.latents import Latents
from pemviz.sampling.problem import Problem, ranked
from pemviz.sampling.rollouts.runners import check_numbers
from pemviz.sampling.rollouts.simulate import logit_of
from pemviz.sampling.slots import unrolled
from pemviz.sampling.splitting.importance import (
    EVALUATION_COUNT,
    evaluated_at,
    importance,
    importance_at_end,
    is_last_of_step,
    states_at,
)
from pemviz.sampling.state.composed import carried_at, kept_with_rollouts
from pemviz.simulators.latents import begun, latent_counts, salient_of, stepped
from pemviz.simulators.slots import SIGHT
from pemviz.types import RolloutBatch, Simulator, StateBatch


@dataclass(frozen=True)
class Particles(Batch):
    """N rollouts under the error model.

    Attributes:
        rollouts: The rollouts, without logits of a proposal: it is the error model.
        score: ``[N, T]``: the importance function at the states so far, running minimum; see
            :func:`pemviz.sampling.splitting.importance.importance`.
        evaluations: ``[N, T]``: at how many of the states so far it was computed.
        ancestor: ``[N]``: which of the particles at the start of the run each descends from.
    """

    rollouts: RolloutBatch
    score: FloatArray
    evaluations: AnyArray
    ancestor: IntArray

    @property
    def count(self) -> int:
        """Number of particles N."""
        return int(self.ancestor.size)

    @property
    def with_proposal(self) -> RolloutBatch:
        """The rollouts with the logits of what they were sampled from: the error model."""
        return replace(self.rollouts, proposal_logit=self.rollouts.pem_logit)

    @property
    def lowest(self) -> FloatArray:
        """The lowest score of each particle, ``[N]``."""
        return self.score[:, -1]


@dataclass(frozen=True)
class Continuation:
    """Particles of one run that are to go on, each from one of its states.

    Attributes:
        paths: M particles, overwritten after ``cut``.
        cut: The last state that each keeps, ``[M]``, ascending; 0 samples them whole but for the
            latents at their start.
        uniforms: ``[T-1, M]`` from [0, 1) for the outcomes after it.
        noise: Latents of all steps, ``[M, T-1, ...]``, of which those after it count.
    """

    paths: Particles
    cut: IntArray
    uniforms: FloatArray
    noise: FloatArray


def beginning(problem: Problem, *, count: int, generator: np.random.Generator) -> Continuation:
    """``count`` independent rollouts, to be sampled.

    Raises:
        ConfigError: The simulator's states hold more than can be kept.
    """
    states, counts = problem.simulator.states, latent_counts(problem.simulator)
    uniforms = generator.random((states - 1, count))
    normals = generator.standard_normal((count, counts.at_start))
    start = begun(problem.simulator, count=count, start=normals)
    _check_can_be_kept(problem.simulator, start)
    noise = generator.standard_normal((count, (states - 1) // problem.turns, counts.noise))
    latents = None
    if counts:
        still, one = np.ones(noise.shape[:2]), np.ones(noise.shape)
        latents = Latents(normals, 0.0 * normals, np.zeros(count), noise, 0.0 * noise, still, one)

    def first_column(values: AnyArray) -> AnyArray:
        """``[N, T]`` with ``values [N]`` at the first state."""
        result = np.zeros((values.size, states), dtype=values.dtype)
        result[:, 0] = values
        return result

    unknown = np.zeros((count, states - 1))
    memory = kept_with_rollouts(start.memory)
    blank = Particles(
        rollouts=RolloutBatch(
            signals={name: first_column(values) for name, values in start.signals.items()},
            memory={name: first_column(values) for name, values in memory.items()},
            detected=unknown.astype(np.bool_),
            pem_logit=unknown,
            proposal_logit=unknown[:, :0],
            latents=latents,
        ),
        score=np.full((count, states), np.inf),
        evaluations=np.zeros((count, states), dtype=EVALUATION_COUNT),
        ancestor=np.arange(count),
    )
    cut = np.zeros(count, dtype=np.int64)
    return Continuation(blank.map(np.asfortranarray), cut, uniforms, noise)


def restart(
    particles: Particles, *, parent: IntArray, cut: IntArray, generator: np.random.Generator
) -> Continuation:
    """New particles that go on independently from states of others, which stay as they are.

    Each shares the states up to ``cut [M]`` with its ``parent [M]``. They come in the order of
    ``cut``; those with the same keep theirs.
    """
    order, latents = np.argsort(cut, kind="stable"), particles.rollouts.latents
    noise = (0, 0) if latents is None else latents.noise.shape[1:]
    return Continuation(
        paths=particles.take(parent[order]),
        cut=cut[order],
        uniforms=generator.random((particles.rollouts.detected.shape[1], cut.size)),
        noise=generator.standard_normal((cut.size, *noise)),
    )


def continued(problem: Problem, runs: Sequence[Continuation]) -> Sequence[Particles]:
    """The particles of several runs, gone on together: a step of all costs little more than of one.

    What comes out for a run does not depend on the others.

    Raises:
        SimulationError: Something raises, or is no finite number; of which of the particles, those
            of one run after those of the other.
    """
    if len(runs) == 1:
        (run,) = runs
        return [_continued(problem, run)]
    cut = np.concatenate([run.cut for run in runs])
    order = np.argsort(cut, kind="stable")
    all_runs = Continuation(
        paths=Particles.concatenate([run.paths for run in runs]).take(order),
        cut=cut[order],
        uniforms=np.concatenate([run.uniforms for run in runs], axis=1)[:, order],
        noise=np.concatenate([run.noise for run in runs])[order],
    )
    with reordered(order.tolist()):
        together = _continued(problem, all_runs)
    place = np.empty_like(order)
    place[order] = np.arange(order.size)
    ends = np.cumsum([run.cut.size for run in runs])[:-1]
    return [together.take(rows) for rows in np.split(place, ends)]


def _check_can_be_kept(simulator: Simulator, states: StateBatch) -> None:
    kept = {part.name for part in fields(StateBatch)}
    more = [part.name for part in fields(states) if part.name not in kept]
    more += [name for name in states.beside if name != SIGHT]  # which follows from the signals
    if more:
        message = (
            f"simulator {simulator.name}: its states carry {', '.join(more)} beside signals and "
            "memory; splitting goes on from kept states, so all of it must be in the memory"
        )
        raise ConfigError(message)


def _continued(problem: Problem, run: Continuation) -> Particles:
    """A run's particles, gone on after the states ``cut``."""
    paths, cut = run.paths, run.cut
    rollouts = _moved_on(problem, run)
    check_numbers(rollouts, simulator=problem.simulator.name, turns=problem.turns)
    with of_no_rollouts():  # what might have been
        to_evaluate = evaluated_at(problem, rollouts, cut=cut, evaluations=paths.evaluations)
        step, row = np.nonzero(to_evaluate.T)
        fresh = np.full_like(paths.score, np.inf)
        fresh[row, step] = importance(problem, rollouts, row=row, step=step)
    fresh[:, -1] = importance_at_end(ranked(problem, rollouts.signals))
    moments = np.arange(paths.score.shape[1])[:, None]
    shared = (moments <= np.where(cut > 0, cut, -1)).T
    score = np.minimum.accumulate(np.where(shared, paths.score, fresh), axis=1)
    rollouts = replace(rollouts, proposal_logit=rollouts.pem_logit[:, :0])
    return replace(paths, rollouts=rollouts, score=score)


def _moved_on(problem: Problem, run: Continuation) -> RolloutBatch:
    """The rollouts to their ends, under the error model; the given ones are overwritten."""
    simulator, rollouts, cut = problem.simulator, run.paths.rollouts, run.cut
    slots, latents = unrolled(simulator), rollouts.latents
    arriving = carried_at(simulator, rollouts, step=cut)
    carried = {name: values[:0] for name, values in arriving.items()}
    for step in range(int(cut[0]), rollouts.detected.shape[1]):
        problem.pause()
        active = int(np.searchsorted(cut, step, side="right"))
        before = states_at(rollouts, step, slice(active))
        carried = {
            name: np.concatenate([values, arriving[name][len(values) : active]])
            for name, values in carried.items()
        }
        before = replace(before, memory={**before.memory, **carried})
        before = before if slots is None else slots.seen(before)
        salient = salient_of(simulator, before)
        logit = logit_of(problem.pem, salient, step=step // problem.turns)
        detected = run.uniforms[step, :active] >= expit(-logit)
        noise = None
        if latents is not None and is_last_of_step(rollouts, step, turns=problem.turns):
            latents.noise[:active, step // problem.turns] = run.noise[
                :active, step // problem.turns
            ]
            noise = latents.noise[:active, step // problem.turns]
        after = stepped(simulator, before, detected, noise)
        rollouts.pem_logit[:active, step] = logit
        rollouts.detected[:active, step] = detected
        carried = {name: v for name, v in after.memory.items() if name not in rollouts.memory}
        for kept, reached in ((rollouts.signals, after.signals), (rollouts.memory, after.memory)):
            for name in kept:
                kept[name][:active, step + 1] = reached[name]
    return replace(rollouts, proposal_logit=rollouts.pem_logit)
