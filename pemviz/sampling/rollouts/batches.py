"""Batches of rollouts, and who simulates them: this thread, or workers elsewhere."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pemviz.arrays import LARGEST_NUMBER, FloatArray
from pemviz.faults import SimulationError
from pemviz.latents import StandardNormals
from pemviz.pem.models.protocol import Pem
from pemviz.sampling.rollouts.draw import of_rows, simulate
from pemviz.types import Proposal, RolloutBatch, Simulator

VALUES_CHECKED = 1 << 16
"""At once."""


@dataclass(frozen=True)
class BatchTask:
    """One batch of rollouts to be simulated.

    Attributes:
        proposal: What outcomes are drawn from.
        uniforms: ``[N, T-1]``; see :func:`pemviz.sampling.rollouts.draw.simulate`.
        normals: Of N rollouts of a scenario with latents.
    """

    proposal: Proposal
    uniforms: FloatArray
    normals: StandardNormals | None = None

    def split(self, pieces: int) -> "Sequence[BatchTask]":
        """The same rollouts as at most ``pieces`` tasks, in order."""
        edges = np.linspace(0, len(self.uniforms), min(pieces, len(self.uniforms)) + 1).astype(int)
        return [self._rows(slice(*edge)) for edge in itertools.pairwise(edges.tolist())]

    def _rows(self, rows: slice) -> "BatchTask":
        normals = None if self.normals is None else self.normals.take(rows)
        return BatchTask(of_rows(self.proposal, rows), self.uniforms[rows], normals)


class BatchRunner(Protocol):
    """Simulates batches, here or elsewhere; what comes back does not depend on where."""

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in their order, as they are done."""
        ...


def run_here(simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]) -> Iterator[RolloutBatch]:
    """One batch after the other, in the thread that asks for it."""
    for task in tasks:
        yield by_numpy(simulator, pem, task)


def by_numpy(simulator: Simulator, pem: Pem, task: BatchTask) -> RolloutBatch:
    """A batch's rollouts, in the process that this is called in."""
    return simulate(
        simulator=simulator,
        pem=pem,
        proposal=task.proposal,
        uniforms=task.uniforms,
        normals=task.normals,
    )


def _are_numbers(by_step: FloatArray) -> bool:
    """Whether all of ``[T, N]`` are finite; pieces are in the cache still for the second look."""
    if by_step.size == 0:
        return True
    steps = max(1, VALUES_CHECKED // by_step.shape[1])
    pieces = (by_step[step : step + steps] for step in range(0, len(by_step), steps))
    return all(-LARGEST_NUMBER <= one.min() <= one.max() <= LARGEST_NUMBER for one in pieces)


def check_numbers(rollouts: RolloutBatch, *, simulator: str, turns: int = 1) -> None:
    """Refuse rollouts in which something is no finite number.

    Args:
        rollouts: A batch, whose rollouts are counted from 0 here.
        simulator: Its name, for the message.
        turns: Outcomes of a step.

    Raises:
        SimulationError: Names what, in which rollout and at which step, earliest step first.
    """
    named = [
        *((f"simulator {simulator}: {name}", values) for name, values in rollouts.signals.items()),
        ("error model: logit", rollouts.pem_logit),
    ]
    if rollouts.proposal_logit is not rollouts.pem_logit:
        named.append(("proposal: logit", rollouts.proposal_logit))
    if rollouts.latents is not None:
        latents = rollouts.latents
        moved = latents.start_mean, latents.noise_mean, latents.noise_share
        if not all(np.isfinite(values).all() for values in moved):
            message = "proposal: the mean of a latent is no finite number"
            raise SimulationError(message)
    worst, earliest = None, rollouts.pem_logit.shape[1] + 1
    for what, values in named:
        if _are_numbers(values.T):
            continue
        allowed = np.abs(values) <= LARGEST_NUMBER  # false for NaN, as the comparison above
        by_step = np.argwhere(~allowed.T)
        step, row = by_step[0].tolist()
        if step < earliest:
            earliest = step
            worst = SimulationError(
                f"{what} is {values[row, step]}",
                why="must be a finite number",
                step=step // turns,
                rollouts=range(row, row + 1),
            )
    if worst is not None:
        raise worst
