"""A scenario so small that its failure probability is known exactly: an anchor for methods.

A gap on the integers shrinks by one at every miss and grows by one, up to a limit, at every
detection. A rollout fails once the gap is 0. There are 2^(T-1) chains of outcomes, which can
be enumerated, and one number of states a step, over which a recursion is exact.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit, logsumexp

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem import Pem
from pemviz.sampling.problem import Problem
from pemviz.types import Signal, Simulator, StateBatch, outcome_log_likelihood

GAP = "gap"


@dataclass(frozen=True, kw_only=True)
class ToySimulator:
    """The lattice walk.

    Attributes:
        initial_gap: Where the walk starts.
        largest_gap: Detections do not lead beyond it.
        states: States in a rollout (T).
    """

    initial_gap: int = 5
    largest_gap: int = 8
    states: int = 15

    @property
    def name(self) -> str:
        """Back end's name."""
        return "toy"

    @property
    def dt_s(self) -> float:
        """Time step [s]; the walk knows no time but its steps."""
        return 1.0

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The gap alone."""
        return (Signal(name=GAP, key="gap_m", unit="m", low=0.0, high=float(self.largest_gap)),)

    def initial(self, *, count: int) -> StateBatch:
        """``count`` walks at the start."""
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={GAP: np.full(count, float(self.initial_gap))},
        )

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """One step nearer where missed ``[N]``, one step away where detected."""
        moved = states.signals[GAP] + np.where(detected, 1.0, -1.0)
        return StateBatch(
            step=states.step + 1, signals={GAP: np.minimum(moved, float(self.largest_gap))}
        )

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The gap, ``[..., 1]``."""
        return signals[GAP][..., None]


@dataclass(frozen=True, kw_only=True)
class ToyPem:
    """Detection is likelier the smaller the gap: logit = at_zero - slope * gap."""

    at_zero: float = 3.0
    slope: float = 0.2

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]`` for salient variables ``[..., 1]``."""
        return self.at_zero - self.slope * salient[..., 0]


def toy_unsafe(states: StateBatch) -> BoolArray:
    """Whether the walk has arrived at 0, ``[N]``."""
    return states.signals[GAP] <= 0.0


def toy_robustness(signals: Mapping[str, FloatArray]) -> FloatArray:
    """Smallest gap of each rollout ``[N, T]``, less one half so that 0 is not robust."""
    return np.min(signals[GAP], axis=1) - 0.5


def toy_violated(signals: Mapping[str, FloatArray]) -> BoolArray:
    """Which rollouts ``[N, T]`` arrive at 0."""
    return toy_robustness(signals) < 0.0


def toy_problem_of(simulator: Simulator, pem: Pem, **options: Any) -> Problem:
    """The question how likely the walk is to arrive at 0."""
    return Problem(
        simulator, pem, toy_robustness, toy_violated, **{"unsafe": toy_unsafe, **options}
    )


def toy_probability_by_recursion(simulator: ToySimulator, pem: ToyPem) -> float:
    """Failure probability by backward recursion over gaps; 0 is absorbing.

    ``V_t(g) = p_miss(g) V_{t+1}(g - 1) + p_hit(g) V_{t+1}(min(g + 1, largest))``.
    """
    gaps = np.arange(simulator.largest_gap + 1)
    missed = expit(-pem.logit(gaps[:, None].astype(np.float64)))
    value = (gaps == 0).astype(np.float64)
    for _ in range(simulator.states - 1):
        nearer = value[np.maximum(gaps - 1, 0)]
        away = value[np.minimum(gaps + 1, simulator.largest_gap)]
        value = np.where(gaps == 0, 1.0, missed * nearer + (1.0 - missed) * away)
    return float(value[simulator.initial_gap])


def toy_probability_by_enumeration(simulator: ToySimulator, pem: ToyPem) -> float:
    """Failure probability by summing the likelihoods of all failing chains of outcomes."""
    steps = simulator.states - 1
    detected = np.array(list(itertools.product((False, True), repeat=steps)))
    states = simulator.initial(count=detected.shape[0])
    failed = toy_unsafe(states)
    log_p = np.zeros(detected.shape[0])
    for step in range(steps):
        logit = pem.logit(simulator.salient(states.signals))
        log_p += outcome_log_likelihood(logit, detected[:, step])
        states = simulator.step(states, detected[:, step])
        failed |= toy_unsafe(states)
    return float(np.exp(np.asarray(logsumexp(log_p[failed])))) if failed.any() else 0.0
