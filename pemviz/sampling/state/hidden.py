"""A hidden property of perception: what the outcomes so far tell of the next one.

An error model of single outcomes gives P(detected) in a state of the scenario. A hidden property
makes it depend on the outcomes before as well: whether the last one was a miss, how hard to see
the obstacle has proved to be. As a filter it becomes a part of the state: it begins, goes on with
every outcome, shows numbers to proposals and recordings, and says what P(detected) follows. Methods
then see a system like any other (:mod:`pemviz.sampling.state.composed`), and weights are those of
outcomes with whatever is hidden integrated out.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.types import RolloutBatch, Signal, StateBatch

OwnLogit = Callable[[], FloatArray]
"""Logit of P(detected) ``[...]`` without the property, evaluated only where it is needed."""
ModelLogit = Callable[[StateBatch], FloatArray]
"""States ``[...]`` to the logits of P(detected) of the model of single outcomes, ``[...]``."""
CARRIED = "pemviz carries: "
"""Names of memory that is for going on from a state alone begin so; rollouts do not keep it, and
method ``splitting`` restores it (:meth:`HiddenProperty.memory_at`)."""


@dataclass(frozen=True)
class Known:
    """What the outcomes so far tell, of N rollouts.

    Attributes:
        signals: Numbers ``[N]`` by the names of the property's signals.
        memory: What else it takes to go on, ``[N]`` by name; see :data:`CARRIED`.
    """

    signals: Mapping[str, FloatArray]
    memory: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])


class HiddenProperty(ABC):
    """One hidden property; a frozen dataclass whose fields are its settings.

    Attributes:
        signals: What rollouts keep and views show of it.
        follows_model: Whether what is known depends on the error model, too, and not on the
            outcomes alone: then other models of the same rollouts are evaluated by
            :meth:`~pemviz.sampling.state.composed.ChainModel.log_likelihood`.
    """

    signals: ClassVar[tuple[Signal, ...]] = ()
    follows_model: ClassVar[bool] = True

    @property
    def label(self) -> str:
        """Its name in the error model's; empty where the run tells of it otherwise."""
        return ""

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the signals that :meth:`logit` is given; all."""
        return tuple(signal.name for signal in self.signals)

    def owns(self, memory: str) -> bool:
        """Whether memory of that name is the property's."""
        return memory.startswith(CARRIED)

    @abstractmethod
    def begin(self, states: StateBatch, model: ModelLogit) -> Known:
        """What is known before any outcome, at initial states ``[N]``.

        These are with the properties before this one. Only properties that follow the error
        ``model`` may evaluate it.
        """

    @abstractmethod
    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: ModelLogit
    ) -> Known:
        """What is known after outcomes ``detected [N]`` at ``before`` have led to ``states``."""

    @abstractmethod
    def logit(self, shown: FloatArray, own: OwnLogit) -> FloatArray:
        """Logit of P(detected | outcomes so far), ``[...]``.

        From what the signals that are :attr:`shown` say, ``[..., K]``, and the logits of the model
        of single outcomes with the properties before this one.
        """

    def features(self, states: StateBatch) -> tuple[FloatArray, ...]:
        """What proposals look at, each ``[...]``; all signals."""
        return tuple(states.signals[signal.name] for signal in self.signals)

    def matters(self, features: StateFeatures, states: StateBatch) -> BoolArray | None:  # noqa: ARG002
        """Where an outcome may matter, ``[...]``; ``None``: where the rest of the system says.

        Everywhere: an outcome to which the scenario does not react still is known of. ``features``
        are the scenario's own.
        """
        return np.ones(states.shape, dtype=np.bool_)

    def for_proposals(self) -> "HiddenProperty":
        """The same to a proposal, which may leave outcomes to the model that matter little."""
        return self

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

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray | None:  # noqa: ARG002
        """Log likelihood ``[N]`` of chains of outcomes ``[N, T-1]``, from their own logits.

        ``None``: it takes going step by step.
        """
        return None
