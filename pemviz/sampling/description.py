"""What the rest of pemviz knows of a method: one description, beside the method's code.

A description is read long before anything is simulated, for instance to explain options: its
module imports nothing that takes long, and :attr:`MethodDescription.build` imports the method. What
several descriptions name stands here too: how many rollouts a method simulates, settings with which
it simulates a given number, and how an estimate that rests on the final stages alone is formed
again from what a run folder keeps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.estimates.diagnostics import IntervalBasis
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.method import Method
    from pemviz.sampling.rollouts.large_stages import WeighedRollouts

Need = Literal["twin", "gap", "single states", "restarts"]
"""``twin``: a fast simulator of the same scenario; ``gap``: a signal of that name;
``single states``: a specification that they decide; ``restarts``: states can be kept and
continued from, outside the batches that worker processes simulate."""
StageMeaning = Literal["learning", "runs", "parts"]
StageInterval = Literal["log-normal", "binomial", "between runs", "none"]
Counting = Literal["rollouts", "level"]

LEARNING_WORDS = (
    "Black: how likely the detector is to see what it looks for. Orange: what rollouts are "
    "sampled from. It learns to miss where misses cause a violation; older stages fade."
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
        is_checked: Whether to hold other methods against it is a remedy too.
        narrows: What halves the interval, in words.
        stages: What the stages of a repetition are: one ``learning`` from the other, independent
            ``runs``, or ``parts`` of one batch.
        stage_interval: Of a stage's own estimate: ``log-normal`` from its weights, ``binomial``,
            none because its error shows only ``between runs``, or ``none`` because a stage has no
            estimate of its own.
        counting: What progress is counted in: ``rollouts``, or the ``level`` of robustness that
            has been reached on the way to a violation.
        follows_model: Whether rollouts are drawn from the error model itself.
        curve_name: What the proposal is called where it is drawn; ``None``: that of a stage.
        most: Configuration to the rollouts at most of a method that goes on until its answer is
            precise, so that ``budget`` is what it begins with; ``None``: it does not.
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
    is_checked: bool = False
    narrows: str = "four times the rollouts"
    stages: StageMeaning = "learning"
    stage_interval: StageInterval = "log-normal"
    counting: Counting = "rollouts"
    follows_model: bool = False
    curve_name: str | None = None
    most: Callable[[ExperimentConfig], int] | None = None
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


LEAST_ROLLOUTS = 2
"""In a stage, a final batch or a run; as few as a configuration may ask for."""
LARGE_BUDGET = 2400
"""From here on the final batch of a method that learns takes half of the rollouts."""


@dataclass(frozen=True)
class Budget:
    """What one repetition simulates.

    Attributes:
        rollouts: How many rollouts; with splitting, how many particles, each of which is cut and
            continued as often as it takes.
        words: The same for reports, e.g. ``11 stages of 100 and 100 final rollouts``.
    """

    rollouts: int
    words: str


def learning_budget(config: ExperimentConfig) -> Budget:
    """A first stage, K learning stages, and a final batch."""
    stages = config.stages + 1
    return Budget(
        rollouts=stages * config.rollouts + config.final_rollouts,
        words=f"{stages} stages of {config.rollouts} and {config.final_rollouts} final rollouts",
    )


def with_learning_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that spend ``rollouts`` on K + 1 stages alike, and the rest on a final batch.

    At 1,200 with K = 10 that is the paper's twelve times 100; from 2,400 on the final batch
    takes half.

    Raises:
        InputError: Too few rollouts for the stages.
    """
    stages = config.stages + 1
    parts = stages + 1 if rollouts < LARGE_BUDGET else 2 * stages
    share = _share(config, rollouts, parts=parts, least=LEAST_ROLLOUTS * (stages + 1))
    return replace(config, rollouts=share, final_rollouts=rollouts - share * stages)


def final_budget(config: ExperimentConfig) -> Budget:
    """A final batch alone."""
    return Budget(rollouts=config.final_rollouts, words=f"{config.final_rollouts} rollouts")


def with_final_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that spend ``rollouts`` on a final batch.

    Raises:
        InputError: Too few rollouts.
    """
    _share(config, rollouts, parts=1, least=LEAST_ROLLOUTS)
    return replace(config, final_rollouts=rollouts)


def particle_budget(config: ExperimentConfig) -> Budget:
    """Independent runs of particles."""
    return Budget(
        rollouts=config.stages * config.rollouts,
        words=f"{config.stages} runs of {config.rollouts} particles",
    )


def with_particle_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that share ``rollouts`` particles, as far as they go evenly, among the runs.

    Raises:
        InputError: Too few particles for the runs.
    """
    least = LEAST_ROLLOUTS * config.stages
    return replace(config, rollouts=_share(config, rollouts, parts=config.stages, least=least))


def _share(config: ExperimentConfig, rollouts: int, *, parts: int, least: int) -> int:
    if rollouts < least:
        message = f"rollouts = {rollouts}: must be at least {least} for {config.method}"
        raise InputError(message)
    return rollouts // parts


def _final_weighed(kept: KeptRepetition) -> WeighedRollouts:
    """The final stages' rollouts as an average needs them; where each stands does not matter."""
    import numpy as np  # noqa: PLC0415  slow to import

    from pemviz.sampling.rollouts.large_stages import WeighedRollouts  # noqa: PLC0415  as above

    chosen = kept.in_final
    return WeighedRollouts(
        count=kept.rollouts("final"),
        row=np.arange(int(chosen.sum())),
        log_weight=kept.log_weight[chosen],
        log_p=kept.log_p[chosen],
    )


def counted(kept: KeptRepetition) -> Recounted:
    """The share of violations among the final stages' rollouts."""
    from pemviz.sampling.estimates.estimators import monte_carlo_estimate  # noqa: PLC0415  slow
    from pemviz.sampling.kept import Recounted  # noqa: PLC0415  as above

    return Recounted(monte_carlo_estimate(_final_weighed(kept), method=kept.method))


def averaged(kept: KeptRepetition) -> Recounted:
    """The average weight of violations, likewise."""
    from pemviz.sampling.estimates.estimators import importance_sampling_estimate  # noqa: PLC0415
    from pemviz.sampling.kept import Recounted  # noqa: PLC0415

    return Recounted(
        importance_sampling_estimate(
            _final_weighed(kept), method=kept.method, rollouts_simulated=kept.rollouts()
        )
    )


def between_runs(kept: KeptRepetition) -> Recounted:
    """The mean of independent runs, likewise."""
    from pemviz.sampling.particles.estimate import recounted  # noqa: PLC0415  slow to import

    return recounted(kept)
