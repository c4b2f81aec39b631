"""A hidden property of perception: what the outcomes so far tell of the next one.

An error model of single outcomes gives P(detected) in a state of the scenario. A hidden property
makes it depend on the outcomes before as well: whether the last one was a miss, how hard to see
the obstacle has proved to be. As a filter it becomes a part of the state: it begins, goes on with
every outcome, shows numbers to proposals and recordings, and says what P(detected) follows. Methods
then see a system like any other (:mod:`pemviz.sampling.state.composed`), and weights are those of
outcomes with whatever is hidden integrated out.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.state.component import Component
from pemviz.types import StateBatch

OwnLogit = Callable[[], FloatArray]
"""Logit of P(detected) ``[...]`` without the property, evaluated only where it is needed."""


class HiddenProperty(Component):
    """One hidden property; a frozen dataclass whose fields are its settings.

    Where what is known depends on the error model, as it does unless a property says otherwise,
    other models of the same rollouts are evaluated by
    :meth:`~pemviz.sampling.state.composed.ChainModel.log_likelihood`.
    """

    follows_model: ClassVar[bool] = True
    in_name: ClassVar[bool] = True
    """Whether the error model's name has its label, as where no setting says it."""
    has_few_states: ClassVar[bool] = True
    """Whether equal signals are equal states, so that a twin can be gone through state by state."""

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

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray | None:  # noqa: ARG002
        """Log likelihood ``[N]`` of chains of outcomes ``[N, T-1]``, from their own logits.

        ``None``: it takes going step by step.
        """
        return None
