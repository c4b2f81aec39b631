"""The result of a run: everything that it reports, but for the rollouts themselves.

:mod:`pemviz.runs.result_file` writes it to ``result.json`` and reads it back; the types and
ranges of the fields here, and of the types that they name, say what may stand there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from pemviz.analysis.data_plan import DataPlan
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.model_uncertainty import DataBound, ModelClassAnswer, ModelInterval
from pemviz.analysis.robustness_tail import RobustnessTail
from pemviz.analysis.starts import DangerousStarts
from pemviz.config import ExperimentConfig
from pemviz.config.ranges import AtLeastZero, Confidence, Count, Log10, Range, Share
from pemviz.latents import LatentCounts
from pemviz.pem import Pem
from pemviz.pem.models.cards import FittedMemory, PemCard, fitted_memory, varying_frailty_of
from pemviz.pem.models.predictive_check import ModelCheck, Variant, check_from_mapping
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.method import SurrogateLearning
from pemviz.sampling.slots import single_model
from pemviz.sampling.state.composed import hidden_in, memory_of_pem, own_pem, property_in
from pemviz.sampling.state.varying_visibility import VaryingVisibility
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.simulators.detector_loop import DETECTOR_ITSELF
from pemviz.types import Estimate, ShownInNotebooks, StageKind

RunStatus = Literal["done", "stopped", "failed"]


@dataclass(frozen=True)
class PemInfo:
    """Which perception error model, or position errors, a result rests on."""

    name: str
    """A shipped name, or that of its card."""
    digest: str
    """SHA-256 of its content."""
    data: str
    """What it was trained on."""


@dataclass(frozen=True)
class LostRollout:
    """A rollout that could not be simulated to its end."""

    repetition: Count
    """Zero-based."""
    stage: Count
    """Its stage."""
    rollout: Count
    """Its index in the stage."""
    step: Count
    """At which the simulator raised something, ended its process or stalled."""


@dataclass(frozen=True)
class LostRollouts:
    """Rollouts that could not be simulated to their end, and what they count as."""

    counts_as: Literal["violation", "none"]
    """As a violation, or as none unless they had violated before."""
    count: Count
    """How many."""
    simulated: Count
    """Of so many, in all stages and repetitions."""
    probability: AtLeastZero
    """That a rollout is lost before it violates, by their weights."""
    std_error: AtLeastZero
    """Of that."""
    first: tuple[LostRollout, ...] = ()
    """The first twenty."""

    def ends(self, probability: float) -> tuple[float, float]:
        """An answer if none of them counted as a violation, and if all did."""
        if self.counts_as == "violation":
            return max(probability - self.probability, 0.0), probability
        return probability, probability + self.probability


@dataclass(frozen=True)
class OwnSystem:
    """A simulator of the user's own, and by which code it is."""

    name: str
    """Its own, or its class's."""
    states: int
    """States in a rollout (T)."""
    dt_s: AtLeastZero
    """Time step [s]."""
    code: str
    """The class, with its module."""
    package: str | None = None
    """Which brings it, and its version; of a script none."""
    source_digest: str | None = None
    """SHA-256 of the file that the class stands in."""


@dataclass(frozen=True)
class MeasuredTau:
    """A memory time measured on video [s], with its interval, and the frailty fitted beside it.

    Attributes:
        tau_s: Memory time [s].
        low_s: Lower end of its interval [s].
        high_s: Upper end [s].
        confidence: Level of both intervals.
        frailty: Fitted beside it; ``None`` in older results.
        frailty_low: Lower end of its interval; ``None`` where it was not fitted.
        frailty_high: Upper end; likewise.
    """

    tau_s: AtLeastZero
    low_s: AtLeastZero
    high_s: AtLeastZero
    confidence: Confidence
    frailty: AtLeastZero | None = None
    frailty_low: AtLeastZero | None = None
    frailty_high: AtLeastZero | None = None


@dataclass(frozen=True)
class MeasuredAnswer:
    """The answer with a memory of misses that was measured on video.

    Attributes:
        name: Whose.
        point: The memory, and the failure probability with it.
    """

    name: str
    point: CurvePoint


@dataclass(frozen=True)
class RunMemory:
    """The memory of misses behind an answer.

    Attributes:
        tau_s: Memory time that the answer is for [s]; 0: misses independent given the state.
        fitted: The error model's own memory time; ``None`` where the model was fitted to single
            frames, which say nothing of it.
        curve: The failure probability over memory times, ascending; empty without.
        frailty: Spread of obstacles' own visibility that the answer is for; 0: all are equal.
        frailty_curve: The failure probability over frailties, likewise.
        hidden: Labels of the user's own hidden properties that the answer is for.
        measured: The answer with memories that were measured: of other detectors, or the error
            model's own; if the answer is for that, at the ends of its intervals.
        unmeasured: Why there is none of these; empty where there is, and in older results.
        check: What predictive checks found of the error model with this memory; without a variant
            where they looked at others alone, ``None`` where the model was not checked.
        visibility: Label of the visibility that comes and goes which the answer is for, one of
            ``hidden``; empty without.
        carried: Likewise of that which the error model carries.
    """

    tau_s: AtLeastZero
    fitted: MeasuredTau | None = None
    curve: tuple[CurvePoint, ...] = ()
    frailty: AtLeastZero = 0.0
    frailty_curve: tuple[CurvePoint, ...] = ()
    hidden: tuple[str, ...] = ()
    measured: tuple[MeasuredAnswer, ...] = ()
    unmeasured: str = ""
    check: ModelCheck | None = None
    visibility: str = ""
    carried: str = ""

    @property
    def is_independent(self) -> bool:
        """Whether misses are independent given the state."""
        return self.tau_s == 0.0 and self.frailty == 0.0 and not self.hidden

    @property
    def is_own(self) -> bool:
        """Whether it is the error model's own, memory time and frailty."""
        own = self.fitted
        return (
            own is not None
            and not self.visibility
            and (own.tau_s, own.frailty or 0.0) == (self.tau_s, self.frailty)
        )

    @property
    def is_own_visibility(self) -> bool:
        """Whether it is the visibility that was fitted for the error model, and nothing else."""
        if self.fitted is None or not self.carried:
            return False
        return self.hidden == (self.visibility,) == (self.carried,)

    @property
    def left_out(self) -> str:
        """Label of the visibility that the model carries and the answer is not for, or empty."""
        return "" if self.visibility else self.carried


def memory_of(pem: Pem) -> RunMemory:
    """The memory that a run with this error model assumes."""
    single = single_model(own_pem(pem))
    assumed, own, properties = memory_of_pem(pem), own_memory(single), hidden_in(pem)
    hidden = tuple(one.label for one in properties if one.label)
    taken, carried = property_in(properties, VaryingVisibility), varying_frailty_of(single)
    run = RunMemory(
        tau_s=assumed.tau_s,
        frailty=assumed.frailty,
        hidden=hidden,
        visibility="" if taken is None else taken.label,
        carried="" if carried is None else carried.label,
    )
    if own is not None:
        low_s, high_s = own.tau_interval_s
        low, high = own.frailty_interval or (None, None)
        fitted = MeasuredTau(
            tau_s=own.memory.tau_s,
            low_s=low_s,
            high_s=high_s,
            confidence=own.confidence,
            frailty=own.memory.frailty,
            frailty_low=low,
            frailty_high=high,
        )
        run = replace(run, fitted=fitted)
    return replace(run, check=_own_check(single, _variant_of(run)))


def _variant_of(run: RunMemory) -> Variant | None:
    if run.is_own_visibility:
        return "visibility"
    if run.hidden:
        return None
    return "independent" if run.is_independent else "both" if run.is_own else None


def _own_check(pem: Pem, assumed: Variant | None) -> ModelCheck | None:
    """What a model's card says of predictive checks, of the variant that a run assumes.

    Raises:
        PemError: The card is damaged.
    """
    card: object = getattr(pem, "card", None)
    if not isinstance(card, PemCard):
        return None
    check = check_from_mapping(card.check, where=pem.name)
    if check is None:
        return None
    return replace(check, variants=tuple(one for one in check.variants if one.name == assumed))


def own_memory(pem: Pem) -> FittedMemory | None:
    """The memory that a model's card reports; ``None`` for a model of single frames.

    Raises:
        PemError: The card is damaged.
    """
    card: object = getattr(pem, "card", None)
    return fitted_memory(card.memory, where=pem.name) if isinstance(card, PemCard) else None


@dataclass(frozen=True)
class RuleAnswer:
    """How likely one of several rules is broken, whatever becomes of the others."""

    name: str
    """The rule's."""
    formula: str
    """What it says."""
    estimate: Estimate
    """How likely it is broken."""
    measured: tuple[MeasuredAnswer, ...] = ()
    """As :attr:`RunMemory.measured`."""
    refits: ModelInterval | None = None
    """As :attr:`RunResult.pem_interval`."""


@dataclass(frozen=True)
class StageSummary:
    """A stage without its rollouts; see :class:`pemviz.types.StageResult`.

    Attributes:
        rollouts: How many it sampled.
        threshold: Its level of robustness; ``None`` where there is none, or where it is infinite:
            where the specification does not depend on the rollout.
    """

    repetition: Count
    stage: Count
    kind: StageKind
    rollouts: Count
    threshold: float | None
    elites: Count
    failures: Count
    probability: AtLeastZero
    log10_probability: Log10 | None
    ess: AtLeastZero | None
    loss: float | None


@dataclass(frozen=True)
class RankedRollout:
    """One of the least robust rollouts of a run.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        robustness: Under the run's metric; infinite where the specification does not depend
            on the rollout, below 0 if it is violated then.
        violated: Whether the formula fails, see :func:`pemviz.stl.violated`.
        nll: Its negative log-likelihood under the perception error model [nats].
        log_weight: Its log importance weight [nats].
        misses: How many steps missed.
        share: What it contributes to its stage's estimate, if it is among the rollouts that carry
            that (:mod:`pemviz.analysis.causes`); ``None`` if it is not, or if the estimate
            does not rest on its stage.
        broken: The rules that it breaks, by name, where there are rules.
    """

    repetition: Count
    stage: Count
    rollout: Count
    robustness: float
    violated: bool
    nll: float
    log_weight: float
    misses: Count
    share: Share | None = None
    broken: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DrivenDistance:
    """How far the ego drives in a rollout.

    Attributes:
        mean_km: On average, under the error model [km].
        std_error_km: Of that [km].
        rollouts: By how many.
    """

    mean_km: Annotated[float, Range(low=1e-6, high=1e9)]
    std_error_km: AtLeastZero
    rollouts: Count


@dataclass(frozen=True, kw_only=True)
class RunResult(ShownInNotebooks):
    """Everything a run reports, but for the rollouts themselves.

    Attributes:
        run_id: The run's name, that of its folder.
        status: ``stopped`` also while it goes on, as that is what a kill would leave.
        config: The configuration.
        pem: The perception error model.
        versions: Of pemviz and of what the figures may depend on, by package.
        simulator: The user's own, if it is none that is shipped; ``None`` in older results too.
        assumptions: What the answer takes for granted, in words.
        estimate: The answer; of several repetitions, their mean.
        repetitions: The estimate of each repetition that is done.
        rules: The answer to each rule, where there are rules; ``estimate`` then says how likely
            any of them is broken.
        stages: Every stage that is done.
        least_robust: The least robust of the rollouts that carry the estimate, least robust
            first, then the least robust of the others; of all as long as nothing carries one.
        least_robust_by_rule: Likewise of each rule by name, where there are rules: ranked by the
            robustness in that rule, shares of the answer to it.
        memory: What was assumed of how misses hang together, and what the model's own data say
            of it; ``None`` in older results.
        latents: How many standard normals the simulator took; ``None`` if none.
        position_errors: By which the scenario measured; ``None``: it measured exactly.
        driven: How far a rollout is, where it is a stretch of driving in free traffic.
        lost: Rollouts that could not be simulated to their end; ``None`` if there are none.
        surrogate: What proposals were learned on first; ``None`` if nothing was.
        reference: The answer by the zero-variance reference, or over all states where they are few.
        pem_interval: The answer's range over other models that fit the same data.
        starts: Which starts are dangerous, where the simulator names random ones: of violations
            in all, then of each rule's.
        model_classes: The answer under other model classes that learned from the same data.
        data_bound: What the model's training data alone allow.
        plan: What to measure next, if that was to be planned.
        explanation: Where and when the detector misses before violations, and what would help.
        robustness_tail: Robustness expected and in the worst hundredth, under the error model;
            ``None`` where the rollouts do not say.
        warnings: About the model and its data; those about sampling are the estimates' own.
        timings_s: Wall time by part of the work [s].
        message: Why the run failed, if it did.
    """

    run_id: str
    status: RunStatus
    config: ExperimentConfig
    pem: PemInfo
    versions: Mapping[str, str]
    assumptions: tuple[str, ...]
    estimate: Estimate | None = None
    repetitions: tuple[Estimate, ...] = ()
    rules: tuple[RuleAnswer, ...] = ()
    stages: tuple[StageSummary, ...] = ()
    least_robust: tuple[RankedRollout, ...] = ()
    least_robust_by_rule: Mapping[str, tuple[RankedRollout, ...]] = field(
        default_factory=dict[str, tuple[RankedRollout, ...]]
    )
    memory: RunMemory | None = None
    latents: LatentCounts | None = None
    position_errors: PemInfo | None = None
    simulator: OwnSystem | None = None
    driven: DrivenDistance | None = None
    lost: LostRollouts | None = None
    surrogate: SurrogateLearning | None = None
    reference: Reference | None = None
    pem_interval: ModelInterval | None = None
    starts: tuple[DangerousStarts, ...] = ()
    model_classes: tuple[ModelClassAnswer, ...] = ()
    data_bound: DataBound | None = None
    plan: DataPlan | None = None
    explanation: Explanation | None = None
    robustness_tail: RobustnessTail | None = None
    warnings: tuple[str, ...] = ()
    timings_s: Mapping[str, AtLeastZero] = field(default_factory=dict[str, float])
    message: str | None = None

    def __repr__(self) -> str:
        """Which run it is and what it says, in a line; all fields would be pages."""
        told: dict[str, object] = {"run_id": self.run_id, "status": self.status}
        if self.estimate is not None:
            named = "method", "probability", "ci_low", "ci_high", "rollouts_simulated"
            told |= {name: getattr(self.estimate, name) for name in named}
        words = [f"{name}={value!r}" for name, value in told.items()]
        return f"{type(self).__name__}({', '.join(words)}, ...)"

    @property
    def is_of_detector_itself(self) -> bool:
        """Whether outcomes are what the detector itself said, without an error model."""
        return self.pem.name == DETECTOR_ITSELF and not self.pem.digest  # a model may have the name
