"""Frailty: scenario and error model with what outcomes tell of the obstacle as part of the state.

:mod:`pemviz.pem.models.frailty` gives the formulas. The state carries the posterior of the
obstacle's visibility u, and P(detected | outcomes so far) is a function of the state: methods need
to know nothing of u, and weights are those of outcomes with u integrated out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import FEWEST, distinct_rows
from pemviz.errors import ConfigError
from pemviz.pem.models.frailty import VisibilityNodes, log_sums, remembered_outcomes
from pemviz.pem.models.memory import frail_logit, remembering_logit
from pemviz.pem.models.with_memory import PemWithMemory
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.simulators.episodic import kept_memory
from pemviz.simulators.latched import WrappedSimulator
from pemviz.simulators.latents import begun, stepped
from pemviz.simulators.remembering import LAST_OUTCOME
from pemviz.types import RolloutBatch, Signal, Simulator, StateBatch

VISIBILITY = Signal(name="visibility", key="visibility", unit="", low=-1e3, high=1e3)
"""Posterior mean of u; the larger, the harder to see the obstacle has proved."""
SEEN_LOGIT = Signal(name="seen_logit", key="seen_logit", unit="", low=-1e6, high=1e6)
"""Logit of P(detected | outcomes so far)."""
OWN_SIGNALS = (VISIBILITY, SEEN_LOGIT)
NEXT = "visibility_next"
"""Memory: log posterior of u_j if the next outcome is a miss, and if it is a detection, ``[N]``
records of ``missed [J]`` and ``detected [J]`` and of the posteriors' means; for going on from a
state, not kept with rollouts."""

CHUNK_ROWS = 256
"""States at a time, so that what is known by node stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class FrailModel(PemWithMemory):
    """An error model of whole chains of outcomes: with frailty above 0, and perhaps memory."""

    @cached_property
    def nodes(self) -> VisibilityNodes:
        """Of the integral over u."""
        return VisibilityNodes(self.memory.frailty)

    def logit(self, salient: FloatArray) -> FloatArray:  # noqa: ARG002
        """It depends on all outcomes so far: see :meth:`logit_along`, :class:`FrailPem`.

        Raises:
            TypeError: Always.
        """
        message = "with frailty, what an error model says depends on all outcomes so far"
        raise TypeError(message)

    def own_salient(self, salient: FloatArray) -> FloatArray:
        """What the model of single outcomes sees ``[..., D]`` of a frail scenario's salient."""
        return salient[..., : -2 if self.memory.tau_s > 0.0 else -1]

    def log_outcomes(self, own: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log P(missed) and log P(detected) by node, ``[N, J]``.

        Args:
            own: Logits of the model of single outcomes, ``[N]``.
            last: :data:`LAST_OUTCOME`, ``[N]``.
        """
        return remembered_outcomes(self.nodes.log_outcomes(own), last=last, rho=self.rho)

    def logit_given(self, own: FloatArray, last: FloatArray, *, u: float) -> FloatArray:
        """Logit of 'detected' ``[N]`` of an obstacle of visibility ``u``; arguments as above."""
        frail = frail_logit(own, visibility=np.asarray(u), frailty=self.memory.frailty)
        if self.rho == 0.0:
            return frail
        remembered = remembering_logit(frail, missed_before=last < 0.0, rho=self.rho)
        return np.where(last == 0.0, frail, remembered)

    def log_outcome(self, own: FloatArray, last: FloatArray, missed: BoolArray) -> FloatArray:
        """Log probability by node ``[N, J]`` of outcomes ``[N]`` alone."""
        moved = self.nodes.moved(own)
        log_p = log_ndtr(np.where(missed[:, None], moved, -moved))
        if self.rho == 0.0:
            return log_p
        log_p += np.where(last == 0.0, 0.0, np.log1p(-self.rho))[:, None]
        again = (last != 0.0) & (missed == (last < 0.0))
        log_p[again] = np.logaddexp(log_p[again], np.log(self.rho))
        return log_p

    def log_likelihood(self, salient: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of rollouts' outcomes together ``[N]``; arguments as below."""
        own = self.pem.logit(self.own_salient(salient))
        log_joint = np.tile(self.nodes.log_weight, (len(detected), 1))
        last = np.zeros(len(detected))
        for step in range(detected.shape[1]):
            log_joint += self.log_outcome(own[:, step], last, ~detected[:, step])
            last = np.where(detected[:, step], 1.0, -1.0)
        return log_sums(log_joint)

    def logit_along(self, salient: FloatArray, detected: BoolArray) -> FloatArray:
        """Logit of P(detected | outcomes before) along rollouts, ``[N, T-1]``.

        Args:
            salient: Of a frail scenario, ``[N, T-1, D + 1 or 2]``; of another model's too.
            detected: The outcomes, ``[N, T-1]``.
        """
        own = self.pem.logit(self.own_salient(salient))
        count, steps = detected.shape
        result = np.empty((count, steps))
        log_posterior = np.broadcast_to(self.nodes.log_weight, (count, self.nodes.u.size))
        last = np.zeros(count)
        for step in range(steps):
            miss, hit = (log_posterior + each for each in self.log_outcomes(own[:, step], last))
            log_miss, log_hit = log_sums(miss), log_sums(hit)
            result[:, step] = log_hit - log_miss
            seen = detected[:, step]
            log_posterior = np.where(seen[:, None], hit, miss)
            log_posterior -= np.where(seen, log_hit, log_miss)[:, None]
            last = np.where(seen, 1.0, -1.0)
        return result


@dataclass(frozen=True, eq=False)
class FrailPem(FrailModel):
    """The same as an error model on the scenario whose states carry its own posterior."""

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected | outcomes so far) ``[...]``: the scenario says it."""
        return salient[..., -1]


@dataclass(frozen=True)
class FrailSimulator(WrappedSimulator):
    """The same scenario, whose states know what outcomes tell of the obstacle.

    Attributes:
        model: Whose posterior it is.
    """

    model: FrailModel

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The back end's signals, the posterior mean of u and the logit that follows from it."""
        return (*self.scenario.signals, *OWN_SIGNALS)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The back end's initial states, before any outcome."""
        log_weight = self.model.nodes.log_weight
        everywhere = np.broadcast_to(log_weight, (count, log_weight.size))
        states = begun(self.scenario, count=count, start=start)
        return self._seen(states, everywhere, np.zeros(count))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The back end's next states after outcomes ``[N]``."""
        after = states.memory[NEXT]
        log_posterior = np.where(detected[:, None], after["detected"], after["missed"])
        mean = np.where(detected, after["mean_detected"], after["mean_missed"])
        reached = stepped(self.scenario, scenario_states(states), detected, noise)
        return self._seen(reached, log_posterior, mean)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The back end's salient variables and the logit of the next outcome, ``[..., D + 1]``."""
        own = self.scenario.salient(_without(signals, OWN_SIGNALS))
        return np.concatenate((own, signals[SEEN_LOGIT.name][..., None]), -1)

    def _seen(self, states: StateBatch, log_posterior: FloatArray, mean: FloatArray) -> StateBatch:
        after, logit = self._next(*self._own(states.signals), log_posterior)
        return replace(
            states,
            signals={**states.signals, VISIBILITY.name: mean, SEEN_LOGIT.name: logit},
            memory={**states.memory, NEXT: after},
        )

    def known_at(self, rollouts: RolloutBatch, *, step: IntArray) -> AnyArray:
        """What :data:`NEXT` holds at states of rollouts that led there, ``[N]``.

        Args:
            rollouts: N, whole up to these states.
            step: Which of each, ``[N]``, ascending.
        """
        log_joint = np.tile(self.model.nodes.log_weight, (rollouts.count, 1))
        for moment in range(int(step[-1])):
            later = slice(int(np.searchsorted(step, moment, side="right")), None)
            own, last = self._own({n: v[later, moment] for n, v in rollouts.signals.items()})
            missed = ~rollouts.detected[later, moment]
            log_joint[later] += self.model.log_outcome(own, last, missed)
        log_joint -= log_sums(log_joint)[:, None]
        row = np.arange(rollouts.count)
        own, last = self._own({n: v[row, step] for n, v in rollouts.signals.items()})
        return self._next(own, last, log_joint)[0]

    def _own(self, signals: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Logits of the model of single outcomes, and outcomes before, at states ``[...]``."""
        own = self.scenario.salient(_without(signals, OWN_SIGNALS))
        own = own[..., :-1] if self.model.memory.tau_s > 0.0 else own
        logit = self.model.pem.logit(own)
        return logit, signals.get(LAST_OUTCOME.name, np.zeros(logit.shape))

    def _next(
        self, own: FloatArray, last: FloatArray, log_posterior: FloatArray
    ) -> tuple[AnyArray, FloatArray]:
        """Posteriors after the next outcome, ``[N]`` records, and its logit ``[N]``."""
        nodes, log_outcomes = self.model.nodes, _log_outcomes(self.model, own, last)
        after, logit = np.empty(own.size, dtype=_record(nodes.u.size)), np.empty(own.size)
        for start in range(0, own.size, CHUNK_ROWS):
            rows = slice(start, start + CHUNK_ROWS)
            miss, hit = log_outcomes(rows)
            log_miss = _put(after[rows], "missed", log_posterior[rows] + miss, nodes.u)
            logit[rows] = _put(after[rows], "detected", log_posterior[rows] + hit, nodes.u)
            logit[rows] -= log_miss
        return after, logit


@dataclass(frozen=True)
class DynamicsAlone(WrappedSimulator):
    """A frail scenario for outcomes that are given: what they tell of the obstacle is left out.

    Attributes:
        scenario: The back end beneath.
    """

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The back end's initial states."""
        return begun(self.scenario, count=count, start=start)

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The back end's next states."""
        return stepped(self.scenario, scenario_states(states), detected, noise)


@dataclass(frozen=True)
class FrailFeatures:
    """What a scenario offers to look at, and what the outcomes have told of the obstacle.

    Attributes:
        features: The scenario's own, or those with the last outcome.
        everywhere: Whether outcomes to which the scenario does not react are of interest too:
            they bring no violation nearer, but they tell something of the obstacle, and so change
            what the next ones are.
    """

    features: StateFeatures
    everywhere: bool = False

    def values(self, states: StateBatch) -> FloatArray:
        """The features beneath and the posterior mean of u, ``[..., D + 1]``."""
        mean, own = states.signals[VISIBILITY.name], self.features.values(states)
        return np.concatenate((own, np.broadcast_to(mean, own.shape[:-1])[..., None]), -1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the features beneath say so, unless it is ``everywhere``."""
        if not self.everywhere:
            return self.features.reacts(states)
        return np.ones_like(states.signals[VISIBILITY.name], dtype=np.bool_)


def frail(simulator: Simulator, model: FrailModel) -> FrailSimulator:
    """A back end that carries the posterior of the obstacle's visibility.

    Raises:
        ConfigError: It has a signal of one of these names of its own.
    """
    taken = {name for signal in simulator.signals for name in (signal.name, signal.key)}
    for signal in OWN_SIGNALS:
        if signal.name in taken:
            message = (
                f"simulator {simulator.name!r}: the signal {signal.name!r} is pemviz's own where "
                "frailty is above 0; choose another name"
            )
            raise ConfigError(message)
    return FrailSimulator(simulator, model)


def frail_part(simulator: Simulator) -> FrailSimulator | None:
    """The frail scenario at or beneath ``simulator``; ``None`` if there is none."""
    part: object = simulator
    while isinstance(part, WrappedSimulator):
        if isinstance(part, FrailSimulator):
            return part
        part = part.scenario
    return None


def without_frailty(simulator: Simulator) -> Simulator:
    """The back end beneath a frail scenario; others as they are."""
    return simulator.scenario if isinstance(simulator, FrailSimulator) else simulator


def dynamics_of(simulator: Simulator) -> Simulator:
    """What steps a frail scenario's states where nobody asks the error model; others themselves."""
    found = frail_part(simulator)
    return simulator if found is None else DynamicsAlone(found.scenario)


def scenario_states(states: StateBatch) -> StateBatch:
    """A frail scenario's states as those of the back end beneath."""
    return replace(
        states,
        signals=_without(states.signals, OWN_SIGNALS),
        memory={name: values for name, values in states.memory.items() if name != NEXT},
    )


def _without(signals: Mapping[str, FloatArray], left_out: tuple[Signal, ...]) -> dict[str, Any]:
    names = {signal.name for signal in left_out}
    return {name: values for name, values in signals.items() if name not in names}


def _log_outcomes(
    model: FrailModel, own: FloatArray, last: FloatArray
) -> Callable[[slice], tuple[FloatArray, FloatArray]]:
    """What :meth:`FrailModel.log_outcomes` gives some of states ``[N]``, of a chunk at a time.

    Rollouts meet few gaps, since equal outcomes lead to equal states: alike states are asked once.
    """
    alike = distinct_rows(np.stack([own, last], axis=1)) if own.size >= FEWEST else None
    if alike is None:
        return lambda rows: model.log_outcomes(own[rows], last[rows])
    first, place = alike
    miss, hit = np.empty((2, first.size, model.nodes.u.size))
    for start in range(0, first.size, CHUNK_ROWS):
        rows = slice(start, start + CHUNK_ROWS)
        miss[rows], hit[rows] = model.log_outcomes(own[first[rows]], last[first[rows]])
    return lambda rows: (miss[place[rows]], hit[place[rows]])


def _record(nodes: int) -> np.dtype[Any]:
    outcomes, of_node, number = ("missed", "detected"), (np.float64, (nodes,)), (np.float64, ())
    return np.dtype(
        [(name, *of_node) for name in outcomes] + [(f"mean_{name}", *number) for name in outcomes]
    )


def _put(after: AnyArray, outcome: str, log_joint: FloatArray, u: FloatArray) -> FloatArray:
    """Write the posterior after an ``outcome``; its log probability ``[N]``."""
    largest = log_joint.max(axis=1)
    share = np.exp(log_joint - largest[:, None])
    total = share.sum(axis=1)
    log_p = np.log(total) + largest
    np.subtract(log_joint, log_p[:, None], out=after[outcome])
    after[f"mean_{outcome}"] = (share * u).sum(axis=1) / total
    return log_p


def carried_at(
    simulator: Simulator, rollouts: RolloutBatch, *, step: IntArray
) -> Mapping[str, AnyArray]:
    """Memory ``[N]`` that is not kept with rollouts, at their states ``step [N]``, ascending."""
    found = frail_part(simulator)
    return {} if found is None else {NEXT: found.known_at(rollouts, step=step)}


def kept_with_rollouts(memory: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """What of a state's memory rollouts hold: all but what is for going on alone."""
    return {name: values for name, values in kept_memory(memory).items() if name != NEXT}
