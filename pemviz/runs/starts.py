"""What a run keeps of its violations' starts, stage by stage, until it can tell which count."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.analysis.starts import DangerousStarts, Violations, dangerous_starts
from pemviz.arrays import FloatArray, IntArray
from pemviz.runs.experiment import Experiment
from pemviz.simulators.latents import latent_counts
from pemviz.simulators.starts import NamesStarts, named_starts
from pemviz.types import StageResult, numbers_of

MOST_VIOLATIONS = 20_000
"""Of a stage that are kept; of more an evenly spaced part, each standing for several."""
LN10 = math.log(10.0)


@dataclass(frozen=True)
class StageStarts:
    """A stage's violations.

    Attributes:
        violations: With a stage's own log weights, of splitting log parts, in place of parts.
        rollout: Index of each among the stage's rollouts, ``[V]``.
        rollouts: How many the stage has.
        log_stands_for: Log of how many violations each stands for.
    """

    violations: Violations
    rollout: IntArray
    rollouts: int
    log_stands_for: float


def starts_simulator(experiment: Experiment) -> NamesStarts | None:
    """The scenario, if it names its starts and any of them is random."""
    found = named_starts(experiment.problem.simulator)
    return None if found is None or not latent_counts(found).start else found


def stage_starts(experiment: Experiment, stage: StageResult) -> StageStarts | None:
    """What a stage tells; ``None`` where the scenario does not name its starts."""
    rollouts, latents = stage.scored.rollouts, stage.scored.rollouts.latents
    simulator = starts_simulator(experiment)
    if latents is None or simulator is None:
        return None
    named = latent_counts(simulator).start
    rows = np.flatnonzero(stage.scored.violated)
    count = rows.size
    if count > MOST_VIOLATIONS:
        rows = rows[np.arange(MOST_VIOLATIONS) * count // MOST_VIOLATIONS]
    if experiment.has_likelihood_ratios:
        log_part = rollouts.log_weight[rows]
    else:  # all that violate of splitting's particles carry the same
        log10 = stage.log10_probability
        even = -math.inf if log10 is None or not count else log10 * LN10 - math.log(count)
        log_part = np.full(rows.size, even)
    place = np.full((rows.size, 3), (stage.repetition, stage.stage, 0), dtype=np.int64)
    place[:, 2] = number = numbers_of(rollouts.count, stage.drawn)[rows]
    return StageStarts(
        violations=Violations(
            latents=latents.start[rows, :named],
            log_part=log_part,
            place=place,
            broken={name: broken[rows] for name, broken in stage.scored.broken.items()},
        ),
        rollout=number,
        rollouts=stage.count,
        log_stands_for=math.log(count / rows.size) if count else 0.0,
    )


def repetition_starts(
    stages: Sequence[StageStarts], *, log_weight: FloatArray | None, weighted: bool
) -> Violations:
    """A repetition's violations with their parts of its estimate.

    Args:
        stages: Those that its estimate averages, at least one.
        log_weight: Of all their rollouts; ``None``: each stage's own.
        weighted: Whether rollouts carry weights; parts of splitting's runs are averaged.
    """
    rollouts = sum(stage.rollouts for stage in stages)
    of = math.log(rollouts if weighted else len(stages))
    first, parts = 0, list[Violations]()
    for stage in stages:
        own = stage.violations
        log_part = own.log_part if log_weight is None else log_weight[first + stage.rollout]
        shown = log_part + stage.log_stands_for - of
        parts.append(Violations(own.latents, shown, own.place, own.broken))
        first += stage.rollouts
    return joined(parts)


def joined(parts: Sequence[Violations]) -> Violations:
    """All of at least one part."""
    return Violations(
        latents=np.concatenate([part.latents for part in parts]),
        log_part=np.concatenate([part.log_part for part in parts]),
        place=np.concatenate([part.place for part in parts]),
        broken={
            name: np.concatenate([part.broken[name] for part in parts]) for name in parts[0].broken
        },
    )


def starts_of_run(
    experiment: Experiment, repetitions: Sequence[Violations]
) -> tuple[DangerousStarts, ...]:
    """Which starts are dangerous, by all repetitions that are done, at least one."""
    simulator = starts_simulator(experiment)
    if simulator is None:
        return ()
    violations = joined(repetitions)
    averaged = violations.log_part - math.log(len(repetitions))
    return dangerous_starts(
        simulator,
        Violations(violations.latents, averaged, violations.place, violations.broken),
        rules=[rule.name for rule in experiment.config.rules],
    )
