"""Batches of rollouts, and who simulates them: this thread, a compiled loop or workers."""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import LARGEST_NUMBER, FloatArray
from pemviz.faults import SimulationError, counted_from
from pemviz.latents import StandardNormals
from pemviz.pem.models.cards import Carded
from pemviz.pem.models.protocol import Pem
from pemviz.processes import DIED
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.rollouts.simulate import of_rows, simulate
from pemviz.types import Proposal, RolloutBatch, Simulator

VALUES_CHECKED = 1 << 16
"""At once."""
BATCHES_AHEAD = 1  # so that workers need not wait until a batch is scored
MOST_DEATHS = 3
"""Of workers that were at a rollout."""
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
    """

    proposal: Proposal
    uniforms: FloatArray
    normals: StandardNormals | None = None

    def split(self, pieces: int) -> "Sequence[BatchTask]":
        """The same rollouts as at most ``pieces`` tasks, in order."""
        count = len(self.uniforms)
        edges = np.linspace(0, count, min(pieces, count) + 1).astype(int)
        return [
            BatchTask(
                of_rows(self.proposal, rows),
                self.uniforms[rows],
                None if self.normals is None else self.normals.take(rows),
            )
            for rows in itertools.starmap(slice, itertools.pairwise(edges.tolist()))
        ]


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
    )


@dataclass
class PooledRunner:
    """Cuts every batch into pieces, one for each worker process; a :data:`BatchRunner`.

    A rollout does not depend on the others of its batch: the pieces, put together in their
    order, are to the last bit what one process would have simulated. So what was lost with a worker
    that died is simulated again.

    Attributes:
        submit: Takes a function and its arguments, all of which can be pickled, to a worker,
            as :meth:`concurrent.futures.Executor.submit` does.
        workers: How many there are.
        renew: Starts workers anew where one has died; ``None``: what submits sees to it itself.
        deaths: How many have died so far.
    """

    submit: Callable[..., Future[Any]]
    workers: int
    renew: Callable[[], None] | None = None
    deaths: int = field(default=0, init=False)

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in their order, as they are done.

        Raises:
            SimulationError: Something raised in a worker, or a rollout ends whichever is at it.
        """
        ahead: deque[Sequence[_Piece]] = deque()
        try:
            for task in tasks:
                pieces = task.split(self.workers)
                ahead.append([_Piece(self, simulator, pem, piece) for piece in pieces])
                if len(ahead) > BATCHES_AHEAD:
                    yield _joined(ahead)
                    ahead.popleft()
            while ahead:
                yield _joined(ahead)
                ahead.popleft()
        finally:
            for piece in itertools.chain.from_iterable(ahead):
                piece.future.cancel()

    def lost(self, error: BrokenExecutor) -> None:
        """Count a worker that died, and start others.

        Raises:
            SimulationError: No others can be started.
        """
        self.deaths += 1
        if self.renew is None:
            what, why = DIED.split(": ", 1)
            raise SimulationError(f"a {what}", why=why) from error
        self.renew()


class _Piece:
    """A part of a batch that is under way."""

    def __init__(
        self, runner: PooledRunner, simulator: Simulator, pem: Pem, task: BatchTask
    ) -> None:
        self.task = task
        self.runner, self._simulator, self._pem = runner, simulator, pem
        self.hand_in()

    def hand_in(self) -> None:
        self.future: Future[RolloutBatch] = self._submit(self.task)

    def _submit(self, task: BatchTask) -> Future[RolloutBatch]:
        return self.runner.submit(by_numpy, self._simulator, self._pem, task)

    def hand_in_if_lost(self) -> None:
        """Again, where it was under way, or handed in, when a worker died."""
        done = self.future.done() and not self.future.cancelled()
        if not done or isinstance(self.future.exception(), BrokenExecutor):
            self.hand_in()

    def alone(self, task: BatchTask, *, deaths: int) -> RolloutBatch:
        """A task that was lost so often, with nothing beside it, the smaller the oftener it is.

        So it is found out whether it was at fault, and which of its rollouts.
        """
        try:
            return self._submit(task).result()
        except BrokenExecutor as error:
            self.runner.lost(error)
            deaths += 1
            if len(task.uniforms) == 1 and deaths >= MOST_DEATHS:
                what = f"{deaths} worker processes died one after the other"
                why = "killed, or the machine is out of memory"
                raise SimulationError(what, why=why, rollouts=range(1)) from error
        parts: list[RolloutBatch] = []
        for half in task.split(2):
            with counted_from(sum(part.count for part in parts)):
                parts.append(self.alone(half, deaths=deaths))
        return RolloutBatch.concatenate(parts)


def _joined(ahead: Sequence[Sequence[_Piece]]) -> RolloutBatch:
    """The first of the batches that are under way."""
    parts: list[RolloutBatch] = []
    for piece in ahead[0]:
        with counted_from(sum(part.count for part in parts)):
            try:
                parts.append(piece.future.result())
            except BrokenExecutor as error:
                piece.runner.lost(error)
                parts.append(piece.alone(piece.task, deaths=1))
                for other in itertools.chain.from_iterable(ahead):
                    if other is not piece:
                        other.hand_in_if_lost()
    return RolloutBatch.concatenate(parts)


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
        moved = latents.start_mean, latents.noise_mean, latents.noise_share
        if not all(np.isfinite(values).all() for values in moved):
            message = "proposal: the mean of a latent is no finite number"
            raise SimulationError(message)
    worst, earliest = None, rollouts.pem_logit.shape[1] + 1
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
