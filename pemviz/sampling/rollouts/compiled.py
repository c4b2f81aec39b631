"""Plain rollouts by a compiled loop, where the simulator has one and so many are asked for."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from pemviz.arrays import FloatArray
from pemviz.pem.models.card import Carded
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.rollouts.batches import BatchTask, by_numpy
from pemviz.types import RolloutBatch, Simulator

FIRST_BY_NUMPY = 20_000
"""Rollouts after which loading a compiled loop, about half a second, begins to pay."""

Compiled = Callable[[FloatArray], RolloutBatch]
"""Draws ``[N, T-1]`` to rollouts: what :func:`pemviz.sampling.rollouts.draw.simulate` gives."""


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
