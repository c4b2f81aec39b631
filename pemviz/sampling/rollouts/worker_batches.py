"""Batches of rollouts simulated by processes elsewhere, for simulators that are slow."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass
from typing import Any

from pemviz.pem.models.protocol import Pem
from pemviz.processes import DIED
from pemviz.sampling.rollouts.batches import BatchTask, Simulated, SimulationError, by_numpy
from pemviz.types import RolloutBatch, Simulator

BATCHES_AHEAD = 1  # so that workers need not wait until a batch is scored

Pieces = list[Future[RolloutBatch]]


@dataclass(frozen=True)
class PooledRunner:
    """Cuts every batch into pieces, one for each worker; see :class:`BatchRunner`.

    A rollout does not depend on the others of its batch: the pieces, put together in their
    order, are to the last bit what one process would have simulated.

    Attributes:
        submit: Takes a function and its arguments, all of which can be pickled, to a worker,
            as :meth:`concurrent.futures.Executor.submit` does.
        workers: How many there are.
        simulated: What they do with a piece; can be pickled likewise.
    """

    submit: Callable[..., Future[Any]]
    workers: int
    simulated: Simulated = by_numpy

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in their order, as they are done.

        Raises:
            SimulationError: A worker died.
        """
        ahead: deque[Pieces] = deque()
        try:
            for task in tasks:
                ahead.append(self._handed_in(simulator, pem, task))
                if len(ahead) > BATCHES_AHEAD:
                    yield _joined(ahead[0])
                    ahead.popleft()
            while ahead:
                yield _joined(ahead[0])
                ahead.popleft()
        except BrokenExecutor as error:
            raise SimulationError(f"a {DIED}") from error
        finally:
            for piece in (piece for pieces in ahead for piece in pieces):
                piece.cancel()

    def _handed_in(self, simulator: Simulator, pem: Pem, task: BatchTask) -> Pieces:
        pieces = task.split(self.workers)
        return [self.submit(self.simulated, simulator, pem, piece) for piece in pieces]


def _joined(pieces: Pieces) -> RolloutBatch:
    return RolloutBatch.concatenate([piece.result() for piece in pieces])
