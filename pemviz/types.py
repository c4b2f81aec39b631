"""What flows between the parts: states, rollouts, stages, estimates. All frozen."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import (
    AnyArray,
    Batch,
    BoolArray,
    FloatArray,
    IntArray,
    Rows,
    read_only,
    row_sums,
    softplus,
)
from pemviz.config.ranges import AtLeastZero, Confidence, Count, Log10, Share
from pemviz.latents import Latents

StageKind = Literal["pretrain", "learn", "final"]
CERTAIN = "outcome_certain"
"""Memory of states at which perception's outcome is certain; proposals leave it to the model."""
LAST = "last_outcome_"
"""Memory, with a slot's number: its last outcome."""
VIOLATED = "violated"
"""Memory: whether there has been a violation."""
LOST = "lost"
"""Memory of rollouts that cannot be simulated on: whether a state is one that was not reached."""


@dataclass(frozen=True)
class Signal:
    """A measured quantity that specifications may name.

    Attributes:
        name: As written in a specification, e.g. ``gap``.
        key: As written in files, with its unit, e.g. ``gap_m``.
        unit: For axes and tables, e.g. ``m``.
        low: Lower bound that the agm metric normalises by, in ``unit``.
        high: Upper bound, in ``unit``.
    """

    name: str
    key: str
    unit: str
    low: float
    high: float


LAST_OUTCOME = Signal(name="last_outcome", key="last_outcome", unit="", low=-1.0, high=1.0)
"""Missed (-1), detected (1), or none yet (0)."""


@dataclass(frozen=True)
class StateBatch:
    """States of many rollouts.

    Attributes:
        step: Index of the state in its rollout; broadcasts against the signals.
        signals: One array ``[...]`` for each signal, by name.
        memory: What the controller remembers, e.g. its speed integral; arrays ``[...]``.
        beside: What is known beside them, of all rows together, and is not kept: not with rows
            that are taken, nor with rollouts.
    """

    step: IntArray
    signals: Mapping[str, FloatArray]
    memory: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])
    beside: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape ``[...]`` of signals and memory."""
        arrays = (*self.signals.values(), *self.memory.values())
        return np.shape(arrays[0] if arrays else self.step)

    def map(self, function: Callable[[AnyArray], AnyArray]) -> "StateBatch":
        """The states with ``function`` applied to every array, ``step`` among them."""
        return self._changed(function(self.step), function)

    def take(self, rows: Rows) -> "StateBatch":
        """The chosen rows, in the order of choice: views for a slice, otherwise copies."""
        step = self.step[rows] if self._steps_by_row else self.step
        return self._changed(step, lambda values: values[rows])

    @staticmethod
    def concatenate(batches: "Sequence[StateBatch]") -> "StateBatch":
        """All rows of at least one batch, in order."""
        step = batches[0].step
        equal = all(np.array_equal(batch.step, step) for batch in batches)
        if not equal or any(batch._steps_by_row for batch in batches):
            step = np.concatenate([np.broadcast_to(b.step, b.shape) for b in batches])
        first = batches[0]
        return StateBatch(
            step=step,
            signals={n: np.concatenate([b.signals[n] for b in batches]) for n in first.signals},
            memory={n: np.concatenate([b.memory[n] for b in batches]) for n in first.memory},
        )

    @property
    def _steps_by_row(self) -> bool:
        return np.ndim(self.step) == len(self.shape) > 0 and len(self.step) > 1

    def _changed(self, step: IntArray, function: Callable[[AnyArray], AnyArray]) -> "StateBatch":
        return StateBatch(
            step=step,
            signals={name: function(values) for name, values in self.signals.items()},
            memory={name: function(values) for name, values in self.memory.items()},
        )


class SimulatorFacts(Protocol):
    """What every simulator says of itself, whatever its ``initial`` and ``step`` take."""

    @property
    def name(self) -> str:
        """For files and tables."""
        ...

    @property
    def states(self) -> int:
        """States in a rollout (T); perception acts at the first T - 1 of them."""
        ...

    @property
    def dt_s(self) -> float:
        """Time between two states [s]."""
        ...

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that a state carries."""
        ...

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Signals ``[...]`` to what perception depends on: salient variables ``[..., D]``.

        With K slots, those of each: ``[..., K, D]``.
        """
        ...


@runtime_checkable
class Simulator(SimulatorFacts, Protocol):
    """A scenario that moves given, at each step, whether perception detected.

    ``initial`` and ``step`` are pure: a state may be kept and continued from again.
    """

    def initial(self, *, count: int) -> StateBatch:
        """``count`` copies of the state in which every rollout starts, arrays ``[count]``."""
        ...

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The next states, given perception's outcomes ``[N]`` at ``states``."""
        ...


@runtime_checkable
class Proposal(Protocol):
    """A distribution of perception's outcomes that rollouts are sampled from."""

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of the probability of 'detected', given the model's own at states ``[...]``."""
        ...

    def arrays(self) -> Mapping[str, AnyArray]:
        """The parameters by name, as they are stored."""
        ...


@runtime_checkable
class MovesLatents(Proposal, Protocol):
    """A proposal that also moves the means of latents; others leave them at 0."""

    def start_mean(self, count: int) -> FloatArray:
        """Of the latents at the start of ``count`` rollouts, ``[N, S]``."""
        ...

    def noise_mean(self, states: StateBatch, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Of the latents of the step that follows states ``[N]`` and outcomes ``[N]`` there.

        Returns:
            Means ``[N, M]`` and shares ``[N]``, see :class:`pemviz.latents.Latents`.
        """
        ...


@dataclass(frozen=True)
class RolloutBatch(Batch):
    """N rollouts of T states and T - 1 outcomes.

    In memory a step of all rollouts lies in one piece (``array.T`` is in C order): so they are
    drawn, so specifications are evaluated, and so they come back from files and workers. Results
    do not depend on it: sums over steps go through :func:`pemviz.arrays.row_sums`.

    Attributes:
        signals: ``[N, T]`` by signal name.
        memory: ``[N, T]`` by name; see :class:`StateBatch`.
        detected: ``[N, T-1]`` perception's outcomes. Where observers and files get those of a
            scenario with K slots, K above 1, these and their logits are ``[N, T-1, K]``.
        pem_logit: ``[N, T-1]`` logit of 'detected' under the perception error model.
        proposal_logit: ``[N, T-1]`` logit of 'detected' under the distribution sampled from.
        latents: Of a scenario that takes some.
    """

    signals: Mapping[str, FloatArray]
    memory: Mapping[str, AnyArray]
    detected: BoolArray
    pem_logit: FloatArray
    proposal_logit: FloatArray
    latents: Latents | None = None

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.detected.shape[0])

    @cached_property
    def log_p(self) -> FloatArray:
        """Log likelihood ``[N, T-1]`` of each outcome under the perception error model [nats]."""
        return read_only(outcome_log_likelihood(self.pem_logit, self.detected))

    @cached_property
    def log_q(self) -> FloatArray:
        """Log likelihood ``[N, T-1]`` of each outcome under the proposal [nats]."""
        if self._is_plain:
            return self.log_p
        return read_only(outcome_log_likelihood(self.proposal_logit, self.detected))

    @cached_property
    def log_weight(self) -> FloatArray:
        """Log importance weight ``[N]``: sum over outcomes and latents of log p - log q [nats]."""
        of_outcomes = np.zeros(self.count)
        if not self._is_plain:
            of_outcomes = row_sums(np.subtract(self.log_p, self.log_q, order="C"))
        if self.latents is None:
            return read_only(of_outcomes)
        return read_only(of_outcomes + self.latents.log_weight)

    @cached_property
    def _is_plain(self) -> bool:
        """Whether the model itself was sampled from."""
        one, other = self.proposal_logit, self.pem_logit
        return one is other or np.array_equal(one, other)

    def decision_states(self) -> StateBatch:
        """The states at which perception acted, arrays ``[N, T-1]``."""
        steps = self.detected.shape[1]
        return StateBatch(
            step=np.arange(steps, dtype=np.int64)[None, :],
            signals={name: values[:, :steps] for name, values in self.signals.items()},
            memory={name: values[:, :steps] for name, values in self.memory.items()},
        )


def violated_rule(rule: str) -> str:
    """The memory that says whether a rollout has broken one of several rules."""
    return f"{VIOLATED} {rule}"


def tells_violation(memory: str) -> bool:
    """Whether memory of that name is :data:`VIOLATED`, or :func:`violated_rule` of a rule."""
    return memory == VIOLATED or memory.startswith(violated_rule(""))


def outcome_log_likelihood(logit: FloatArray, detected: BoolArray) -> FloatArray:
    """Log likelihood of outcomes ``[...]`` under a logit ``[...]`` of 'detected' [nats]."""
    loss = softplus(np.where(detected, -logit, logit))
    return np.negative(loss, out=loss)


@dataclass(frozen=True)
class ScoredRollouts(Batch):
    """Rollouts with their scores.

    Attributes:
        rollouts: The N rollouts.
        robustness: ``[N]`` under the chosen metric.
        violated: ``[N]`` whether the specification is violated, by its Boolean semantics.
        rule_robustness: ``[N]`` likewise of each rule, by name, where there are rules.
        broken: ``[N]`` whether each rule is violated, by name; ``violated`` is any of them.
        timings_s: Wall time by part of the work [s]: of the batch that rows were taken from;
            of batches put together the sum.
    """

    rollouts: RolloutBatch
    robustness: FloatArray
    violated: BoolArray
    rule_robustness: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    broken: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])
    timings_s: Mapping[str, float] = field(default_factory=dict[str, float])

    @classmethod
    def _beside_rows(cls, batches: Sequence[Any]) -> Mapping[str, Any]:
        parts = batches[0].timings_s
        return {"timings_s": {part: sum(b.timings_s[part] for b in batches) for part in parts}}


DiagnosticKind = Literal[
    "no-failure",
    "few-failures",
    "large-weight",
    "few-effective-samples",
    "heavy-tail",
    "below-doubles",
    "died-out",
    "few-runs",
    "runs-differ",
    "few-ancestors",
    "wide-interval",
    "not-absorbing",
    "not-repeatable",
    "lost-rollouts",
    "lost-matter",
    "called-safe",
    "parts-disagree",
    "exploration-alone",
    "plain-disagrees",
    "hardly-sampled",
    "uneven-side",
    "chains-disagree",
    "not-searched",
    "reference-disagrees",
    "reference-unreliable",
    "unclassified",
]
"""What can be wrong with an estimate; ``sampling/estimates/diagnostics.py`` says what it means."""


@dataclass(frozen=True)
class Diagnostic:
    """One thing that is wrong with an estimate.

    Attributes:
        kind: What.
        value: The figure that tells; ``None`` where no figure does.
        limit: What that figure was compared with; ``None`` likewise.
        text: A warning in words.
    """

    kind: DiagnosticKind
    value: float | None
    limit: float | None
    text: str


VIEWS = {"RunResult": "result_html", "Estimate": "estimate_html", "Rollout": "rollout_html"}


class ShownInNotebooks:
    """A type that a notebook shows as HTML (IPython evaluates ``_repr_html_``).

    The functions lie in parts that import the types, and are imported when a notebook needs them.
    """

    def _repr_html_(self) -> str:
        """Itself as HTML; all that others wrote is escaped."""
        view = next(VIEWS[kind.__name__] for kind in type(self).__mro__ if kind.__name__ in VIEWS)
        return str(getattr(import_module("pemviz.reports.notebook"), view)(self))


@dataclass(frozen=True)
class Estimate(ShownInNotebooks):
    """A failure probability with what is needed to judge it.

    Undefined values are ``None``. Importance weights may carry an estimate, and any bound, above 1.

    Attributes:
        method: Which formed it.
        probability: That a rollout violates the specification.
        log10_probability: Its decimal logarithm, also where the probability is below what a
            float64 holds; ``None`` if nothing failed.
        std_error: Standard error of the probability, sampling alone.
        ci_low: Lower end at ``confidence``; ``None`` if nothing failed.
        ci_high: Upper end; if nothing failed only Monte Carlo has one.
        rollouts_simulated: All that were, those that the estimate leaves out too.
        rollouts_in_estimate: Those that it is formed from.
        failures: Of these, those that violate.
        nll_mean: Mean negative log likelihood of the violations under the error model [nats].
        nll_log_mean: Negative logarithm of their mean likelihood [nats].
        ess: Effective sample size: how many equally weighted violations the estimate is worth.
        pareto_k: Shape of the tail of the violations' weights, k-hat; ``None`` of too few.
        max_weight_share: Share of the estimate that the heaviest rollout carries.
        unbiased_probability: Of rollouts alone whose proposals were fixed before they were sampled.
        unbiased_std_error: Of that.
        diagnostics: What is wrong with the estimate.
        confidence: Level of the interval.
    """

    method: str
    probability: AtLeastZero
    log10_probability: Log10 | None
    std_error: AtLeastZero | None
    ci_low: AtLeastZero | None
    ci_high: AtLeastZero | None
    rollouts_simulated: Count
    rollouts_in_estimate: Count
    failures: Count
    nll_mean: float | None
    nll_log_mean: float | None
    ess: AtLeastZero | None
    pareto_k: float | None
    max_weight_share: Share | None
    unbiased_probability: AtLeastZero | None
    unbiased_std_error: AtLeastZero | None
    diagnostics: tuple[Diagnostic, ...] = ()
    confidence: Confidence = 0.95

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with it, in words."""
        return tuple(diagnostic.text for diagnostic in self.diagnostics)

    @property
    def relative_half_width(self) -> float:
        """Of the interval, as a share of the probability; infinite where there is none."""
        if self.ci_low is None or self.ci_high is None or self.probability == 0.0:
            return math.inf
        return 0.5 * (self.ci_high - self.ci_low) / self.probability


@dataclass(frozen=True)
class SampledRollouts:
    """What is known of all N rollouts of a large stage that holds M of them, read-only.

    Attributes:
        row: Which it holds, ascending, ``[M]``.
        every: Among them is every so many-th, from the first on: an even sample of all.
        robustness: Of all, ``[N]``.
        violated: ``[N]``.
        log_weight: ``[N]`` [nats].
    """

    row: IntArray
    every: int
    robustness: FloatArray
    violated: BoolArray
    log_weight: FloatArray

    def __post_init__(self) -> None:
        """Observers get it: they must not change what a run computes."""
        for name in ("row", "robustness", "violated", "log_weight"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)

    @property
    def even(self) -> BoolArray:
        """Which of those held are the even sample, ``[M]``."""
        return self.row % self.every == 0


def place_of(rollout: int, sampled: SampledRollouts | None) -> int:
    """Where a rollout stands among those that its stage holds; ``None``: it holds all."""
    return rollout if sampled is None else int(np.searchsorted(sampled.row, rollout))


def numbers_of(count: int, sampled: SampledRollouts | None) -> IntArray:
    """Index in its stage of each of ``count`` rollouts held, ``[count]``."""
    return np.arange(count, dtype=np.int64) if sampled is None else sampled.row


@dataclass(frozen=True)
class StageResult:
    """One stage of a repetition.

    Attributes:
        repetition: Zero-based.
        stage: 0 is pre-training, 1 to K learn, K + 1 is final, or the first part of a large
            final batch; where nothing is learned, the parts count from 0.
        kind: What the stage is for.
        scored: Its rollouts; of a large one that is learned from perhaps the least robust alone.
        sampled_from: The proposal that they were drawn from.
        learned: The proposal fitted to them; ``None`` in a final stage.
        threshold: The stage's level of robustness; ``None`` where there is none.
        elites: Rollouts learned from.
        failures: Rollouts that violate.
        probability: The stage's own importance sampling estimate.
        log10_probability: Its decimal logarithm; ``None`` if nothing failed.
        ess: Effective sample size of the failing weights; ``None`` if nothing failed.
        loss: Training loss at the end of the fit [nats a step]; ``None`` without a fit.
        timings_s: Wall time by part of the work [s].
        kept: What the method needs beside the rollouts to go on from here in another process,
            by name; what it computes again at no cost is left out.
        sampled: What is known of all rollouts where ``scored`` holds some of them; else ``None``.
    """

    repetition: int
    stage: int
    kind: StageKind
    scored: ScoredRollouts
    sampled_from: Proposal
    learned: Proposal | None
    threshold: float | None
    elites: int
    failures: int
    probability: float
    log10_probability: float | None
    ess: float | None
    loss: float | None
    timings_s: Mapping[str, float] = field(default_factory=dict[str, float])
    kept: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])
    sampled: SampledRollouts | None = None

    @property
    def count(self) -> int:
        """How many rollouts were drawn."""
        return self.scored.rollouts.count if self.sampled is None else self.sampled.count
