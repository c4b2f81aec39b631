"""The value function where obstacles differ: one for each visibility u, weighted by its posterior.

Given u, outcomes depend on the state alone, so that V(s | u) is the value function of
:mod:`pemviz.sampling.zero_variance.values` for an error model like any other, on one and the same
graph of states. Outcomes so far tell of u alone: the value of a state with a history is

    V(s, history) = sum_j P(u_j | history) V(s | u_j)

with the nodes u_j of :mod:`pemviz.pem.models.frailty`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import FloatArray, IntArray
from pemviz.chunks import distinct_rows
from pemviz.pem import Pem
from pemviz.pem.models.frailty import VisibilityNodes
from pemviz.sampling.state.composed import ComposedPem, hidden_in, own_pem, property_in
from pemviz.sampling.state.last_outcome import last_outcome
from pemviz.sampling.state.visibility import GivenVisibility, Visibility
from pemviz.sampling.zero_variance.merging import Pause, no_pause
from pemviz.sampling.zero_variance.reachable_states import Layer, StateGraph
from pemviz.sampling.zero_variance.values import log_value_at_start


@dataclass(frozen=True, eq=False)
class FrailModel:
    """An error model of obstacles that differ, taken apart: given u it is one like any other.

    On the system without the visibility
    (:func:`~pemviz.sampling.state.composed.without_following`).

    Attributes:
        single: The model of single outcomes, with the properties beside the visibility.
        visibility: How obstacles differ.
    """

    single: ComposedPem
    visibility: Visibility

    @staticmethod
    def of(pem: Pem) -> "FrailModel | None":
        """The parts of an error model; ``None`` where obstacles are all alike."""
        properties = hidden_in(pem)
        visibility = property_in(properties, Visibility)
        if visibility is None:
            return None
        others = tuple(one for one in properties if one is not visibility)
        return FrailModel(ComposedPem(own_pem(pem), others), visibility)

    @property
    def nodes(self) -> VisibilityNodes:
        """Of the integral over u."""
        return self.visibility.nodes

    def given(self, u: float) -> ComposedPem:
        """The model of obstacles of a visibility."""
        known = GivenVisibility(self.visibility.memory.frailty, u)
        return ComposedPem(self.single.pem, (known, *self.single.properties))

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit ``[...]`` of the model of single outcomes; what came before is left out."""
        return self.single.pem.logit(self.single.own_salient(salient))


def frail_log_probability(
    graph: StateGraph, model: FrailModel, *, pause: Pause = no_pause
) -> float:
    """Log of the failure probability, u integrated out; -inf where it is 0.

    Args:
        graph: Explored with the model.
        model: The error model.
        pause: Called now and then; may raise to stop.
    """
    given = by_visibility(graph, model)
    log_given = [log_value_at_start(given(float(u)), pause=pause) for u in model.nodes.u]
    return float(np.asarray(logsumexp(np.array(log_given) + model.nodes.log_weight)))


def by_visibility(graph: StateGraph, model: FrailModel) -> Callable[[float], StateGraph]:
    """The graph with the logits of 'detected' of an obstacle of a visibility u.

    States whose outcomes are alike are many, and looked for once.
    """
    alike = [_Alike.of(layer) for layer in graph.layers]

    def given(u: float) -> StateGraph:
        layers = (
            replace(layer, pem_logit=same.logit(model, u))
            for layer, same in zip(graph.layers, alike, strict=True)
        )
        return replace(graph, layers=tuple(layers))

    return given


@dataclass(frozen=True, eq=False)
class _Alike:
    """What decides the outcomes of n states: M different things.

    Attributes:
        own: Logits of the model of single outcomes, ``[M]``.
        last: The outcomes before, ``[M]``.
        which: Of each state, ``[n]``; ``None``: all are different.
    """

    own: FloatArray
    last: FloatArray
    which: IntArray | None

    @staticmethod
    def of(layer: Layer) -> "_Alike":
        """Of a layer's states."""
        own = layer.pem_logit
        last = last_outcome(layer.states.signals, otherwise=own)
        found = distinct_rows(np.column_stack([own, last]))
        if found is None:
            return _Alike(own, last, None)
        first, which = found
        return _Alike(own[first], last[first], which)

    def logit(self, model: FrailModel, u: float) -> FloatArray:
        """Of 'detected' given the obstacle's visibility, ``[n]``."""
        logit = model.given(u).after(self.own, self.last[:, None])
        return logit if self.which is None else logit[self.which]
