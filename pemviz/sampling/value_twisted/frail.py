"""The value function where obstacles differ: one for each visibility u, weighted by its posterior.

Given u, outcomes depend on the state alone, so that V(s | u) is the value function of
:mod:`pemviz.sampling.value_twisted.values` for an error model like any other, on one and the same
graph of states. Outcomes so far tell of u alone: the value of a state with a history is

    V(s, history) = sum_j P(u_j | history) V(s | u_j)

with the nodes u_j of :mod:`pemviz.pem.models.frailty`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import FloatArray
from pemviz.sampling.frailty import FrailModel
from pemviz.sampling.value_twisted.merging import Pause, no_pause
from pemviz.sampling.value_twisted.reachable_states import Layer, StateGraph
from pemviz.sampling.value_twisted.values import log_value_at_start
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
    given = [
        log_value_at_start(given_visibility(graph, model, float(u)), pause=pause)
        for u in model.nodes.u
    ]
    return float(np.asarray(logsumexp(np.array(given) + model.nodes.log_weight)))


def given_visibility(graph: StateGraph, model: FrailModel, u: float) -> StateGraph:
    """The graph with the logits of 'detected' of an obstacle of visibility ``u``."""
    return replace(graph, layers=tuple(_layer_given(layer, model, u) for layer in graph.layers))


def _layer_given(layer: Layer, model: FrailModel, u: float) -> Layer:
    last = layer.states.signals.get(LAST_OUTCOME.name, np.zeros(layer.count))
    return replace(layer, pem_logit=model.logit_given(layer.pem_logit, last, u=u))
