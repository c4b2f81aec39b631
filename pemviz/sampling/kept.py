"""What a run folder keeps of a repetition, from which its estimate can be formed again.

A method's description says how (``recount`` of
:class:`pemviz.sampling.description.MethodDescription`), with the estimator that the method itself
uses. What that needs of each rollout beside its verdict and its likelihoods, the method gives away
when a repetition is done (:class:`KeepsColumns`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.types import Estimate, StageKind

State_contra = TypeVar("State_contra", contravariant=True)

COUNTS = ("failures", "rollouts_in_estimate", "nll_mean", "nll_log_mean")
FIGURES = ("probability", "log10_probability", *COUNTS)
WEIGHTS = ("ess", "max_weight_share", "unbiased_probability", "unbiased_std_error")
EVERY = (*FIGURES, "std_error", "ci_low", "ci_high", *WEIGHTS)
"""Fields of an estimate that rollouts decide; k-hat is fitted, and versions may fit otherwise."""


@runtime_checkable
class KeepsColumns(Protocol[State_contra]):
    """A method whose estimate rests on more of each rollout than every run folder keeps."""

    def kept_columns(self, state: State_contra) -> Mapping[str, AnyArray]:
        """What that is of all rollouts of a repetition that is done, ``[N]`` by name, in order.

        What is otherwise under a rule has the rule's name after its own and a dot.
        """
        ...


@dataclass(frozen=True)
class KeptStage:
    """A stage's figures.

    Attributes:
        kind: What it is for.
        rollouts: How many it sampled.
        failures: How many of them violate.
        log_probability: Of its own estimate [nats]; -inf if nothing failed.
    """

    kind: StageKind
    rollouts: int
    failures: int
    log_probability: float


@dataclass(frozen=True)
class KeptRepetition:
    """What a run folder keeps of a repetition: its stages, and the F rollouts that violate.

    Attributes:
        method: Name of the method.
        stages: In order.
        stage: Which of them each of the F belongs to, ``[F]``.
        log_weight: ``[F]`` [nats].
        log_p: Log likelihood under the error model, ``[F]`` [nats].
        columns: What the method itself keeps, ``[F]`` by name.
        rule: Which the F break; ``None``: any.
    """

    method: str
    stages: Sequence[KeptStage]
    stage: IntArray
    log_weight: FloatArray
    log_p: FloatArray
    columns: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])
    rule: str | None = None

    @property
    def in_final(self) -> BoolArray:
        """Which of the F belong to a final stage, ``[F]``."""
        final = np.array([stage.kind == "final" for stage in self.stages], dtype=np.bool_)
        return final[self.stage]

    def rollouts(self, kind: StageKind | None = None) -> int:
        """How many were sampled, in stages of a kind or in all."""
        return sum(stage.rollouts for stage in self.stages if kind in (None, stage.kind))

    def column(self, name: str) -> AnyArray | None:
        """A column ``[F]``, under the rule at hand; ``None`` where it is not kept."""
        return self.columns.get(f"{name}.{self.rule}", self.columns.get(name))

    def under_rule(self, rule: str, broken: BoolArray) -> "KeptRepetition":
        """Those of the F that break one rule, ``broken [F]``."""
        return replace(
            self,
            stage=self.stage[broken],
            log_weight=self.log_weight[broken],
            log_p=self.log_p[broken],
            columns={name: values[broken] for name, values in self.columns.items()},
            rule=rule,
        )


@dataclass(frozen=True)
class Recounted:
    """An estimate formed again, of which ``names`` could be: fields of it."""

    estimate: Estimate
    names: tuple[str, ...] = EVERY


def log_of(log10_probability: float | None) -> float:
    """A decimal logarithm in nats; -inf for ``None``."""
    return -math.inf if log10_probability is None else log10_probability * math.log(10.0)
