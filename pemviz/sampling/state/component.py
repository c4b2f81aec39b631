"""A part of a system's state: what the outcomes and states so far tell, beside the scenario's own.

It begins, goes on with every outcome and, where something is to be seen of it, shows numbers to the
error model, to proposals and to recordings; :mod:`pemviz.sampling.state.composed` puts the parts
together. Violations (:mod:`pemviz.sampling.state.violated`) are one; hidden properties of
perception (:mod:`pemviz.sampling.state.hidden`) also say what P(detected) follows.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.types import RolloutBatch, Signal, StateBatch

ModelLogit = Callable[[StateBatch], FloatArray]
"""States ``[...]`` to the logits of P(detected) of the model of single outcomes, ``[...]``."""
CARRIED = "pemviz carries: "
"""Names of memory that is for going on from a state alone begin so; rollouts do not keep it, and
method ``splitting`` restores it (:meth:`Component.memory_at`)."""


@dataclass(frozen=True)
class Known:
    """What the outcomes so far tell, of N rollouts.

    Attributes:
        signals: Numbers ``[N]`` by the names of the component's signals.
        memory: What else it takes to go on, ``[N]`` by name; see :data:`CARRIED`.
        beside: What else there is beside the states; see :class:`pemviz.StateBatch`.
    """

    signals: Mapping[str, FloatArray]
    memory: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])
    beside: Mapping[str, Any] = field(default_factory=dict[str, Any])


class Component(ABC):
    """One part of a system's state; a frozen dataclass whose fields are its settings.

    Attributes:
        signals: What rollouts keep and views show of it.
        follows_model: Whether what is known depends on the error model, too, and not on the
            outcomes and states alone.
    """

    signals: ClassVar[tuple[Signal, ...]] = ()
    follows_model: ClassVar[bool] = False

    @property
    def label(self) -> str:
        """Its name in the error model's; empty where the run tells of it otherwise."""
        return ""

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the signals that the error model is given; all."""
        return tuple(signal.name for signal in self.signals)

    def owns(self, memory: str) -> bool:
        """Whether memory of that name is the component's."""
        return memory.startswith(CARRIED)

    @abstractmethod
    def begin(self, states: StateBatch, model: ModelLogit) -> Known:
        """What is known before any outcome, at initial states ``[N]``.

        These are with the components before this one. Only one that follows the error ``model``
        may evaluate it.
        """

    @abstractmethod
    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: ModelLogit
    ) -> Known:
        """What is known after outcomes ``detected [N]`` at ``before`` have led to ``states``."""

    def memory_at(
        self,
        rollouts: RolloutBatch,  # noqa: ARG002
        *,
        step: IntArray,  # noqa: ARG002
        model: ModelLogit,  # noqa: ARG002
    ) -> Mapping[str, AnyArray]:
        """The :data:`CARRIED` memory ``[N]`` at states of rollouts that led there; none.

        The rollouts are whole up to their states ``step [N]``, ascending.
        """
        return {}
