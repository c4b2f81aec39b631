"""Batches of rollouts simulated by processes elsewhere, for simulators that are slow."""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass
from typing import Any

from pemviz.faults import SimulationError, counted_from
from pemviz.pem.models.protocol import Pem
from pemviz.processes import DIED
from pemviz.sampling.rollouts.batches import BatchTask, by_numpy
from pemviz.types import RolloutBatch, Simulator

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
