"""Which slots' errors cause the violations of a scenario that has several.

Violations come as methods know them, with an outcome a step; here they are told in the scenario's
own steps, with names of slots. An error is a miss of an obstacle, or a report of a ghost.
"""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.analysis.causes import Chain, Failures
from pemviz.analysis.outcome_likelihood import OutcomeLikelihood
from pemviz.analysis.sensitivity import mean_sum
from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero, Share
from pemviz.sampling.folding import Folding


@dataclass(frozen=True)
class SlotErrors:
    """Errors of one slot, over violations weighted by how likely each is.

    Attributes:
        name: Of the slot.
        nominal: Its harmless outcome: True for an obstacle, False for a ghost.
        errors: How many a violation has on average.
        share: Share of all slots' errors.
        probability_by_step: Of an error that may matter, given a violation.
        elasticity: d log(failure probability) / d log(P(error)): ten per cent fewer errors here
            bring about ``elasticity`` times ten per cent fewer violations. ``None`` as in
            :class:`pemviz.analysis.sensitivity.BandSensitivity`.
        std_error: Of the elasticity; ``None`` likewise.
    """

    name: str
    nominal: bool
    errors: AtLeastZero
    share: Share
    probability_by_step: tuple[Share, ...]
    elasticity: float | None
    std_error: AtLeastZero | None


def slot_errors(
    failures: Failures, *, folding: Folding, likelihood: OutcomeLikelihood
) -> tuple[SlotErrors, ...]:
    """Errors by slot.

    Args:
        failures: Weighted violations, unrolled.
        folding: To the scenario's own steps.
        likelihood: That of the violations' outcomes.
    """
    by_step = np.clip(failures.share @ np.ascontiguousarray(failures.missed), 0.0, 1.0)
    by_slot = by_step.reshape(-1, folding.turns).T
    every = float(by_slot.sum())
    slope = likelihood.slope()
    rows: list[SlotErrors] = []
    for number, slot in enumerate(folding.simulator.slots):
        inside = np.zeros_like(failures.deciding)
        inside[:, number :: folding.turns] = failures.deciding[:, number :: folding.turns]
        elasticity, error = mean_sum(failures, slope, inside)
        errors = float(by_slot[number].sum())
        rows.append(
            SlotErrors(
                name=slot.name,
                nominal=slot.nominal,
                errors=errors,
                share=errors / every if every > 0.0 else 0.0,
                probability_by_step=tuple(by_slot[number].tolist()),
                elasticity=elasticity,
                std_error=error,
            )
        )
    return tuple(rows)


def any_error_by_step(failures: Failures, *, folding: Folding) -> FloatArray:
    """Probability that some slot errs where it may matter, given a violation, ``[T-1]``."""
    some = np.ascontiguousarray(failures.missed).reshape(
        -1, _steps(failures, folding), folding.turns
    )
    return np.clip(failures.share @ some.any(axis=2), 0.0, 1.0)


def in_steps(chain: Chain, *, folding: Folding) -> Chain:
    """A chain of unrolled steps in the scenario's own, with the slot of each error."""
    steps = [divmod(step, folding.turns) for step in chain.missed_steps]
    slots = folding.simulator.slots
    return replace(
        chain,
        missed_steps=tuple(step for step, _ in steps),
        slots=tuple(slots[slot].name for _, slot in steps),
    )


def _steps(failures: Failures, folding: Folding) -> int:
    return failures.deciding.shape[1] // folding.turns
