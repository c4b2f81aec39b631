"""What the balance heuristic's estimate rests on, as a run folder keeps it, and the way back."""

from collections.abc import Mapping

import numpy as np

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.sampling.estimates.estimate import (
    ADAPTATION,
    SLOTS_AND_STARTS_ADAPTATION,
    importance_sampling_estimate,
    mixture_estimate,
)
from pemviz.sampling.kept import COUNTS, KeptRepetition, Recounted
from pemviz.sampling.mixture.balance_heuristic import Pool
from pemviz.sampling.rollouts.final_batch import WeighedRollouts
from pemviz.types import Estimate

COMPONENT, LOG_WEIGHT, FINAL_LOG_WEIGHT = "component", "log_weight", "final_log_weight"
OF_COMPONENT, FINAL_OF_COMPONENT = "of_component", "final_of_component"
"""How many rollouts in all, or of the final batch, are drawn from what a rollout is drawn from."""
NOT_KEPT = -1
"""In place of components that no violation was drawn from: they add nothing to an error."""


def adaptation(*, turns: int, starts: int) -> float:
    """The factor on the standard error, by outcomes of a step and latents at the start."""
    return SLOTS_AND_STARTS_ADAPTATION if turns > 1 and starts > 1 else ADAPTATION


def columns_of(pool: Pool, *, final: slice) -> dict[str, AnyArray]:
    """Of each rollout ``[N]``: what it was drawn from, and its weights, under each rule too."""
    component, columns = pool.component, dict[str, AnyArray]()
    columns[COMPONENT] = component
    columns[OF_COMPONENT] = np.bincount(component)[component]
    counts = np.bincount(component[final], minlength=int(component.max()) + 1)
    columns[FINAL_OF_COMPONENT] = counts[component]
    for rule in (None, *pool.rules):
        under, ending = (pool, "") if rule is None else (pool.under_rule(rule), f".{rule}")
        columns[f"{LOG_WEIGHT}{ending}"] = under.judged.log_weight
        among = np.full(pool.drawn, np.nan)
        among[final] = under.weights_among(final)
        columns[f"{FINAL_LOG_WEIGHT}{ending}"] = among
    return columns


def recounted(kept: KeptRepetition) -> Recounted:
    """The average over all stages by the weights that were kept; without them what is counted.

    Raises:
        ValueError: The columns do not fit together.
    """
    names = (COMPONENT, OF_COMPONENT, FINAL_OF_COMPONENT, LOG_WEIGHT, FINAL_LOG_WEIGHT)
    columns = {name: kept.column(name) for name in names}
    found = {name: values for name, values in columns.items() if values is not None}
    if len(found) < len(names):
        every = WeighedRollouts(
            kept.rollouts(), np.arange(kept.stage.size), kept.log_weight, kept.log_p
        )
        simulated = kept.rollouts()
        plain = importance_sampling_estimate(
            every, method=kept.method, rollouts_simulated=simulated
        )
        return Recounted(plain, COUNTS)
    return Recounted(_from_columns(kept, found))


def _from_columns(kept: KeptRepetition, columns: Mapping[str, AnyArray]) -> Estimate:
    """The estimate over as many rollouts as were drawn, of which those that hold only count."""
    final, count, last = kept.in_final, kept.rollouts(), kept.rollouts("final")
    known, first, place = np.unique(columns[COMPONENT], return_index=True, return_inverse=True)
    drawn_last = columns[FINAL_OF_COMPONENT][first]
    drawn_first = columns[OF_COMPONENT][first] - drawn_last
    parts = (~final, count - last, drawn_first), (final, last, drawn_last)

    def spread(values: FloatArray, fill: float) -> FloatArray:
        return np.concatenate([_filled(values[own], size, fill) for own, size, _ in parts])

    return mixture_estimate(
        method=kept.method,
        log_weight=spread(columns[LOG_WEIGHT], np.nan),
        violated=spread(np.ones(final.size), 0.0).astype(np.bool_),
        component=np.concatenate(
            [
                _filled(_strata(known, place[own], drawn, most=size), size, NOT_KEPT)
                for own, size, drawn in parts
            ]
        ),
        log_p=spread(kept.log_p, np.nan),
        frozen_log_weight=_filled(columns[FINAL_LOG_WEIGHT][final], last, np.nan),
        frozen=slice(count - last, None),
        adaptation=adaptation(turns=kept.slots, starts=kept.starts),
    )


def _strata(known: IntArray, place: IntArray, drawn: IntArray, *, most: int) -> IntArray:
    """Components of violations, then as many of each as were drawn and hold.

    Raises:
        ValueError: They are more than ``most``, or more violate than were drawn.
    """
    hold = drawn - np.bincount(place, minlength=known.size)
    if np.any(hold > most) or place.size + hold.sum() > most:
        message = "more rollouts are of a component than there are"
        raise ValueError(message)
    return np.concatenate([known[place], np.repeat(known, hold)])


def _filled(values: AnyArray, size: int, fill: float) -> AnyArray:
    """Values, then others up to ``size``."""
    return np.concatenate([values, np.full(size - values.size, fill, dtype=values.dtype)])
