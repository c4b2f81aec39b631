"""Batches of rollouts, and who simulates them: this thread, a compiled loop or workers."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import LARGEST_NUMBER, FloatArray
from pemviz.faults import SimulationError
from pemviz.latents import StandardNormals
from pemviz.pem.models.cards import Carded
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.rollouts.simulate import of_rows, simulate
from pemviz.types import Proposal, RolloutBatch, Simulator

VALUES_CHECKED = 1 << 16
"""At once."""
FIRST_BY_NUMPY = 20_000
"""Rollouts after which loading a compiled loop, about half a second, begins to pay."""

Compiled = Callable[[FloatArray], RolloutBatch]
"""Uniforms ``[N, T-1]`` to the rollouts of :func:`pemviz.sampling.rollouts.simulate.simulate`."""


@dataclass(frozen=True)
class BatchTask:
    """One batch of rollouts to be simulated.

    Attributes:
        proposal: What outcomes are sampled from.
        uniforms: ``[N, T-1]``; see :func:`pemviz.sampling.rollouts.simulate.simulate`.
        normals: Of N rollouts of a scenario with latents.
        stays_from: As there.
    """

    proposal: Proposal
    uniforms: FloatArray
    normals: StandardNormals | None = None
    stays_from: int | None = None

    def split(self, pieces: int) -> "Sequence[BatchTask]":
        """The same rollouts as at most ``pieces`` tasks, in order."""
        count = len(self.uniforms)
        edges = np.linspace(0, count, min(pieces, count) + 1).astype(int)
        return [
            self.take(rows) for rows in itertools.starmap(slice, itertools.pairwise(edges.tolist()))
        ]

    def take(self, rows: slice) -> "BatchTask":
        """Some of the rollouts."""
        normals = None if self.normals is None else self.normals.take(rows)
        own = of_rows(self.proposal, rows)
        return BatchTask(own, self.uniforms[rows], normals, self.stays_from)


BatchRunner = Callable[[Simulator, Pem, Iterable[BatchTask]], Iterator[RolloutBatch]]
"""Simulates batches in their order, here or elsewhere; what comes back is the same anywhere."""


def run_here(simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]) -> Iterator[RolloutBatch]:
    """One batch after the other, in the thread that wants it."""
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
        stays_from=task.stays_from,
    )


@runtime_checkable
class CompilesRollouts(Protocol):
    """A simulator whose plain rollouts a compiled loop gives too, to the last bit the same."""

    def compiled_rollouts(self, logit: Callable[[FloatArray], FloatArray]) -> Compiled | None:
        """The loop for an error model's ``logit``, which takes each row of salient variables alone.

        ``None`` where it does not serve, or is absent.
        """
        ...


@dataclass
class CompiledRunner:
    """Simulates batches here, most of many by the compiled loop; a :data:`BatchRunner`.

    Attributes:
        first_by_numpy: Rollouts that numpy simulates before the loop is compiled or loaded.
    """

    first_by_numpy: int = FIRST_BY_NUMPY
    _done: int = field(default=0, init=False)
    _known: tuple[Simulator, Pem, Compiled | None] | None = field(default=None, init=False)

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in order."""
        for task in tasks:
            compiled = self._compiled(simulator, pem, task)
            yield compiled(task.uniforms) if compiled else by_numpy(simulator, pem, task)

    def _compiled(self, simulator: Simulator, pem: Pem, task: BatchTask) -> Compiled | None:
        if type(task.proposal) is not PemProposal or not isinstance(pem, Carded):
            return None
        if not isinstance(simulator, CompilesRollouts):
            return None
        self._done += len(task.uniforms)
        if self._done <= self.first_by_numpy:
            return None
        known = self._known
        if known is None or known[0] is not simulator or known[1] is not pem:
            self._known = known = simulator, pem, simulator.compiled_rollouts(pem.logit)
        return known[2]


def check_numbers(rollouts: RolloutBatch, *, simulator: str, turns: int = 1) -> None:
    """Refuse rollouts in which something is no finite number.

    The message names the ``simulator``; a step has as many outcomes as ``turns``.

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
        narrow = latents.noise_narrow_mean, latents.noise_narrow_share
        moved = latents.start_mean, latents.noise_mean, latents.noise_share, *narrow
        if not all(values is None or np.isfinite(values).all() for values in moved):
            message = "proposal: the mean of a latent is no finite number"
            raise SimulationError(message)
    check_values(named, turns=turns)


def check_values(named: Sequence[tuple[str, FloatArray]], *, turns: int = 1) -> None:
    """Refuse values ``[N, T]``, each with what it is, that are no finite numbers.

    Raises:
        SimulationError: As :func:`check_numbers` has it.
    """
    worst, earliest = None, math.inf
    for what, values in named:
        if _are_numbers(values.T):
            continue
        allowed = np.abs(values) <= LARGEST_NUMBER  # false for NaN, as in _are_numbers
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


def _are_numbers(by_step: FloatArray) -> bool:
    """Whether all of ``[T, N]`` are finite; pieces are in the cache still for the second look."""
    if by_step.size == 0:
        return True
    steps = max(1, VALUES_CHECKED // by_step.shape[1])
    pieces = (by_step[step : step + steps] for step in range(0, len(by_step), steps))
    return all(-LARGEST_NUMBER <= one.min() <= one.max() <= LARGEST_NUMBER for one in pieces)
