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
from pemviz.sampling.frailty import FrailModel
from pemviz.sampling.zero_variance.merging import Pause, no_pause
from pemviz.sampling.zero_variance.reachable_states import Layer, StateGraph
from pemviz.sampling.zero_variance.values import log_value_at_start
from pemviz.simulators.remembering import LAST_OUTCOME


@dataclass(frozen=True, eq=False)
class OwnOutcomes:
    """The model of single outcomes beneath frailty, on the scenario beneath it."""

    model: FrailModel

    def logit(self, salient: FloatArray) -> FloatArray:
        """Its logit ``[...]``; the last outcome is left out."""
        own = salient[..., :-1] if self.model.memory.tau_s > 0.0 else salient
        return self.model.pem.logit(own)


def frail_log_probability(
    graph: StateGraph, model: FrailModel, *, pause: Pause = no_pause
) -> float:
    """Log of the failure probability, u integrated out; -inf where it is 0.

    Args:
        graph: Explored with :class:`OwnOutcomes` of the model.
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
        last = layer.states.signals.get(LAST_OUTCOME.name, np.zeros(layer.count))
        found = distinct_rows(np.column_stack([own, last]))
        if found is None:
            return _Alike(own, last, None)
        first, which = found
        return _Alike(own[first], last[first], which)

    def logit(self, model: FrailModel, u: float) -> FloatArray:
        """Of 'detected' given the obstacle's visibility, ``[n]``."""
        logit = model.logit_given(self.own, self.last, u=u)
        return logit if self.which is None else logit[self.which]
