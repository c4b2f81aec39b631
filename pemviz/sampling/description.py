"""What the rest of pemviz knows of a method: one description, beside the method's code.

A description is read long before anything is simulated, for instance to explain options: its
module imports nothing that takes long, and :attr:`MethodDescription.build` imports the method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

from pemviz.config import ExperimentConfig

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.budgets import Budget
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.method import Method

Need = Literal["twin", "gap", "single states", "restarts"]
"""``twin``: a fast simulator of the same scenario; ``gap``: a signal of that name;
``single states``: a specification that they decide; ``restarts``: states can be kept and
continued from, outside the batches that worker processes simulate."""
IntervalBasis = Literal["counts", "weights", "runs"]
"""What an estimate and its interval rest on: a count of failures and the exact binomial, an average
of importance weights and their spread, or a mean of independent runs, whose rollouts carry no
weights, and how far the runs differ."""
StageMeaning = Literal["learning", "runs", "parts"]
StageInterval = Literal["log-normal", "binomial", "between runs", "none"]
Counting = Literal["rollouts", "level"]

LEARNING_WORDS = (
    "Black: how likely the detector is to see the car ahead. Orange: what rollouts are drawn from. "
    "It learns to miss where misses cause a violation; older stages fade."
)


@dataclass(frozen=True, kw_only=True)
class MethodDescription:
    """A method: how it is built, what it needs and spends, and what its figures mean.

    Attributes:
        name: As chosen with ``--method``.
        summary: What it is, in one line.
        build: Configuration and back end to the method.
        settings: Fields of the configuration that only some methods look at and this one does.
        budget: Configuration to what one repetition simulates.
        with_budget: Configuration and a number of rollouts to the configuration that spends them;
            raises :class:`pemviz.errors.InputError` where they are too few.
        recount: Forms a repetition's estimate again from the rollouts that a run folder keeps, so
            that the two are held to each other; ``None``: they are not.
        alpha: Exponent of the training weights where the configuration leaves it out; ``None``: the
            method chooses it at each stage, or has none.
        needs: What must be there for it.
        interval_basis: What the estimate and its interval rest on; diagnostics of weights apply
            to ``weights`` alone.
        interval_caveat: Why the method's intervals, even those that no diagnostic speaks against,
            are none at their level; ``None`` where they are.
        remedy: What to try where an answer is not to be trusted, in words.
        remedy_with_latents: The same where the scenario has latents; ``None``: no other.
        stages: What the stages of a repetition are: one ``learning`` from the other, independent
            ``runs``, or ``parts`` of one batch.
        stage_interval: Of a stage's own estimate: ``log-normal`` from its weights, ``binomial``,
            none because its error shows only ``between runs``, or ``none`` because a stage has no
            estimate of its own.
        counting: What progress is counted in: ``rollouts``, or the ``level`` of robustness that
            has been reached on the way to a violation.
        follows_model: Whether rollouts are drawn from the error model itself.
        curve_name: What the proposal is called where it is drawn; ``None``: that of a stage.
        learning_words: What there is to see of the proposal, in a few sentences.
    """

    name: str
    summary: str
    build: Callable[[ExperimentConfig, BackEnd], Method[Any]]
    settings: frozenset[str]
    budget: Callable[[ExperimentConfig], Budget]
    with_budget: Callable[[ExperimentConfig, int], ExperimentConfig]
    recount: Callable[[KeptRepetition], Recounted] | None = None
    alpha: float | None = None
    needs: frozenset[Need] = frozenset()
    interval_basis: IntervalBasis = "weights"
    interval_caveat: str | None = None
    remedy: str = "more rollouts"
    remedy_with_latents: str | None = None
    stages: StageMeaning = "learning"
    stage_interval: StageInterval = "log-normal"
    counting: Counting = "rollouts"
    follows_model: bool = False
    curve_name: str | None = None
    learning_words: str = LEARNING_WORDS

    def __post_init__(self) -> None:
        """Refuse settings that no configuration has.

        Raises:
            ValueError: Naming them.
        """
        unknown = self.settings - {field.name for field in fields(ExperimentConfig)}
        if unknown:
            message = f"settings {', '.join(sorted(unknown))}: a configuration has no such field"
            raise ValueError(message)

    @property
    def has_likelihood_ratios(self) -> bool:
        """Whether each rollout's likelihood is known under what it was drawn from."""
        return self.interval_basis != "runs"

    @property
    def rests_on_weights(self) -> bool:
        """Whether diagnostics of weights tell how far the estimate is to be trusted."""
        return self.interval_basis == "weights"

    @property
    def stage_name(self) -> str:
        """What a stage is called: a run where stages are independent of each other."""
        return "run" if self.stages == "runs" else "stage"
