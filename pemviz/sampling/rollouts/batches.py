"""Batches of rollouts, and who simulates them: this thread, a compiled loop or workers."""

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, runtime_checkable

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

Result = TypeVar("Result")


def call_within(limit_s: float | None, call: Callable[[], Result]) -> Result:
    """The result of ``call``, or what it raises, within ``limit_s`` seconds; no limit if None.

    A call that takes longer is left behind in a thread of its own, which does not keep the
    process alive: Python cannot end it.

    Raises:
        TimeoutError: There is no result yet.
    """
    if limit_s is None:
        return call()
    results: list[Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:  # handed on to the caller
            errors.append(error)

    thread = threading.Thread(target=work, name="pemviz-batch", daemon=True)
    thread.start()
    thread.join(limit_s)
    if errors:
        raise errors[0]
    if not results:
        raise TimeoutError
    return results[0]


VALUES_CHECKED = 1 << 16
"""At once."""


@dataclass(frozen=True)
class BatchTask:
    """One batch of rollouts to be simulated.

    Attributes:
        proposal: What outcomes are drawn from.
        uniforms: ``[N, T-1]``; see :func:`pemviz.sampling.rollouts.simulate.simulate`.
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


BATCHES_AHEAD = 1  # so that workers need not wait until a batch is scored


@dataclass(frozen=True)
class PooledRunner:
    """Cuts every batch into pieces, one for each worker; see :class:`BatchRunner`.

    A rollout does not depend on the others of its batch: the pieces, put together in their
    order, are to the last bit what one process would have simulated.

    Attributes:
        submit: Takes a function and its arguments, all of which can be pickled, to a worker,
            as :meth:`concurrent.futures.Executor.submit` does.
        workers: How many there are.
    """

    submit: Callable[..., Future[Any]]
    workers: int

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in their order, as they are done.

        Raises:
            SimulationError: A worker died, or what it asked raised something.
        """
        ahead: deque[_Batch] = deque()
        try:
            for task in tasks:
                ahead.append(self._handed_in(simulator, pem, task))
                if len(ahead) > BATCHES_AHEAD:
                    yield ahead[0].joined()
                    ahead.popleft()
            while ahead:
                yield ahead[0].joined()
                ahead.popleft()
        except BrokenExecutor as error:
            what, why = DIED.split(": ", 1)
            raise SimulationError(f"a {what}", why=why) from error
        finally:
            for piece in (piece for batch in ahead for piece in batch.pieces):
                piece.cancel()

    def _handed_in(self, simulator: Simulator, pem: Pem, task: BatchTask) -> "_Batch":
        tasks = task.split(self.workers)
        return _Batch(
            [self.submit(by_numpy, simulator, pem, piece) for piece in tasks],
            [len(piece.uniforms) for piece in tasks],
        )


@dataclass(frozen=True)
class _Batch:
    """A batch that is under way, in pieces of known sizes."""

    pieces: Sequence[Future[RolloutBatch]]
    sizes: Sequence[int]

    def joined(self) -> RolloutBatch:
        """All of it, once it is there."""
        parts: list[RolloutBatch] = []
        firsts = itertools.accumulate(self.sizes, initial=0)
        for first, piece in zip(firsts, self.pieces, strict=False):
            with counted_from(first):
                parts.append(piece.result())
        return RolloutBatch.concatenate(parts)


FIRST_BY_NUMPY = 20_000
"""Rollouts after which loading a compiled loop, about half a second, begins to pay."""

Compiled = Callable[[FloatArray], RolloutBatch]
"""Draws ``[N, T-1]`` to rollouts: what :func:`pemviz.sampling.rollouts.simulate.simulate` gives."""


@runtime_checkable
class CompilesRollouts(Protocol):
    """A simulator of which a compiled loop draws plain rollouts too, to the last bit the same."""

    def compiled_rollouts(self, logit: Callable[[FloatArray], FloatArray]) -> Compiled | None:
        """The loop for an error model's ``logit``; ``None`` where it does not serve, or is absent.

        Args:
            logit: Answers each row of salient variables by itself.
        """
        ...


@dataclass
class CompiledRunner:
    """Simulates batches here, most of many by the compiled loop; a ``BatchRunner``.

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
            by_loop = None if compiled is None else compiled(task.uniforms)
            yield by_numpy(simulator, pem, task) if by_loop is None else by_loop

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
