"""The average over a pool: what it rests on, kept and recounted, and whether its parts agree.

An average of weights has no way to know of a failure mode that its proposals do not draw. What
shows it, if anything does, is that parts of the rollouts disagree: those before the final batch
and the final batch; one half and the other; what fitted proposals draw and what exploration
proposals draw. And where violations begin on several sides of what is likely, the weights of one
side may be as uneven as can be without a trace of it in the weights of all.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.sampling.estimates.diagnostics import (
    exploration_alone,
    parts_disagreement,
    uneven_sides,
)
from pemviz.sampling.estimates.estimators import (
    ADAPTATION,
    HARD_ADAPTATION,
    REPLICATES,
    SEARCHED_ADAPTATION,
    SLOTS_AND_STARTS_ADAPTATION,
    StratifiedError,
    importance_sampling_estimate,
    mixture_estimate,
)
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight, log_sum
from pemviz.sampling.estimates.weight_diagnostics import weight_figures
from pemviz.sampling.kept import COUNTS, KeptRepetition, Recounted
from pemviz.sampling.mixture.balance_heuristic import PLAIN, Pool
from pemviz.sampling.rollouts.large_stages import WeighedRollouts
from pemviz.types import Diagnostic, Estimate

COMPONENT, LOG_WEIGHT, FINAL_LOG_WEIGHT = "component", "log_weight", "final_log_weight"
OF_COMPONENT, FINAL_OF_COMPONENT = "of_component", "final_of_component"
"""How many rollouts in all, or of the final batch, are sampled from what a rollout is."""
REPLICATE = "replicate"
"""Which rollouts of a proposal have starts that are drawn together; where starts are moved."""
ERROR_FACTOR, CORRECTION_ERROR = "error_factor", "correction_error"
"""The factor on the standard error, and what else it is made of, of all alike."""
NOT_KEPT = -1
"""In place of components that no violation was sampled from: they add nothing to an error."""
FEW_STARTS = 3
"""So many latents at the start have their sides told apart together, more of them each alone."""
LEAST_SIDE = 0.1
"""Of the estimate, on a side whose weights are looked at for themselves."""
FEWEST_REPLICATED = 32
"""Rollouts of a proposal; fewer are drawn together and taken for independent."""
PARTS_ADAPTATION = math.sqrt(2.0)
"""Factor on the standard error of a part, which strata of few rollouts tell too small."""
LogEstimate = tuple[float, float]
"""Log of an estimate and of its standard error."""


def adaptation(*, turns: int, starts: int, searched: bool, hard: bool) -> float:
    """The factor on the standard error, by outcomes of a step and latents at the start.

    ``searched`` is whether chains have searched the latents, ``hard`` whether proposals are
    hard to learn (:attr:`~pemviz.sampling.mixture.stages.MixtureState.is_hard_to_learn`).
    """
    if hard:
        return HARD_ADAPTATION
    if turns > 1 and starts > 1:
        return SLOTS_AND_STARTS_ADAPTATION
    return SEARCHED_ADAPTATION if searched else ADAPTATION


def replicates(component: IntArray) -> IntArray:
    """Which rollouts of each fitted proposal have starts drawn together, ``[N]``; -1 of others.

    ``component`` is what each was sampled from, ``[N]``, in the order in which they were. Where a
    proposal's rollouts are sampled in several parts, those of a part that are drawn together get
    the same number, and others of it get others.
    """
    found = np.full(component.size, -1, dtype=np.int64)
    for fitted in np.unique(component[component > PLAIN]):
        rows = np.flatnonzero(component == fitted)
        if rows.size >= FEWEST_REPLICATED:
            found[rows] = np.arange(rows.size) % REPLICATES
    return found


def columns_of(pool: Pool, *, final: slice, factor: float) -> dict[str, AnyArray]:
    """Of each rollout ``[N]``: what it was sampled from, and its weights, under each rule too.

    ``factor`` is that on the standard error.
    """
    component, columns = pool.component, dict[str, AnyArray]()
    columns[COMPONENT] = component
    columns[ERROR_FACTOR] = np.full(component.size, factor)
    columns[OF_COMPONENT] = np.bincount(component)[component]
    counts = np.bincount(component[final], minlength=int(component.max()) + 1)
    columns[FINAL_OF_COMPONENT] = counts[component]
    for rule in (None, *pool.rules):
        under, ending = (pool, "") if rule is None else (pool.under_rule(rule), f".{rule}")
        columns[f"{CORRECTION_ERROR}{ending}"] = np.full(component.size, under.correction_error)
        columns[f"{LOG_WEIGHT}{ending}"] = under.judged.log_weight
        among = np.full(pool.sampled, np.nan)
        among[final] = under.weights_among(final)
        columns[f"{FINAL_LOG_WEIGHT}{ending}"] = among
    return columns


def recounted(kept: KeptRepetition) -> Recounted:
    """The average over all stages by the weights that were kept; without them what is counted.

    Raises:
        ValueError: The columns do not fit together.
    """
    of_components = COMPONENT, OF_COMPONENT, FINAL_OF_COMPONENT
    names = (*of_components, LOG_WEIGHT, FINAL_LOG_WEIGHT, ERROR_FACTOR)
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
    corrected = kept.column(CORRECTION_ERROR)  # none in files from before
    correction_error = 0.0 if corrected is None else float(corrected.max(initial=0.0))
    estimate = _from_columns(kept, found, kept.column(REPLICATE), correction_error)
    return Recounted(estimate)


def _from_columns(
    kept: KeptRepetition,
    columns: Mapping[str, AnyArray],
    replicate: AnyArray | None,
    correction_error: float,
) -> Estimate:
    """The estimate over as many rollouts as were sampled, of which those that hold only count."""
    final, count, last = kept.in_final, kept.rollouts(), kept.rollouts("final")
    known, first, place = np.unique(columns[COMPONENT], return_index=True, return_inverse=True)
    drawn_last = columns[FINAL_OF_COMPONENT][first]
    drawn_first = columns[OF_COMPONENT][first] - drawn_last
    parts = (~final, count - last, drawn_first), (final, last, drawn_last)

    def spread(values: AnyArray, fill: float) -> AnyArray:
        return np.concatenate([_filled(values[own], size, fill) for own, size, _ in parts])

    return mixture_estimate(
        method=kept.method,
        log_weight=spread(columns[LOG_WEIGHT], np.nan),
        violated=spread(np.ones(final.size), 0.0).astype(np.bool_),
        component=np.concatenate(
            [
                _filled(_strata(known, place[own], sampled, most=size), size, NOT_KEPT)
                for own, size, sampled in parts
            ]
        ),
        replicate=None if replicate is None else spread(replicate, -1),
        log_p=spread(kept.log_p, np.nan),
        frozen_log_weight=_filled(columns[FINAL_LOG_WEIGHT][final], last, np.nan),
        frozen=slice(count - last, None),
        # without a violation there is no error
        adaptation=float(columns[ERROR_FACTOR].max(initial=ADAPTATION)),
        correction_error=correction_error,
    )


def _strata(known: IntArray, place: IntArray, sampled: IntArray, *, most: int) -> IntArray:
    """Components of violations, then as many of each as were sampled and hold.

    Raises:
        ValueError: They are more than ``most``, or more violate than were sampled.
    """
    hold = sampled - np.bincount(place, minlength=known.size)
    if np.any(hold > most) or place.size + hold.sum() > most:
        message = "more rollouts are of a component than there are"
        raise ValueError(message)
    return np.concatenate([known[place], np.repeat(known, hold)])


def _filled(values: AnyArray, size: int, fill: float) -> AnyArray:
    """Values, then others up to ``size``."""
    return np.concatenate([values, np.full(size - values.size, fill, dtype=values.dtype)])


def disagreements(pool: Pool, *, final: slice) -> Sequence[Diagnostic]:
    """Of a pool whose last rollouts, ``final`` of all, are the final batch."""
    judged = pool.judged
    late = [
        _of(pool.weights_among(part), judged.violated[part], judged.component[part])
        for part in (slice(0, final.start), final)
    ]
    odd = np.arange(pool.sampled) % 2 == 1
    halves = [
        _of(judged.log_weight[half], judged.violated[half], judged.component[half])
        for half in (odd, ~odd)
    ]
    # of the estimate, from failures for which exploration was most of what could draw them
    by_exploration = 0.0
    if pool.violated.any():
        log_weight, alone = pool.log_weight[pool.violated], pool.by_exploration
        if alone.any():
            by_exploration = float(np.exp(log_sum(log_weight[alone]) - log_sum(log_weight)))
    return (
        *parts_disagreement(late=_errors_apart(*late), halves=_errors_apart(*halves)),
        *exploration_alone(by_exploration),
        *uneven_sides([weight_figures(side, of=pool.sampled) for side in _sides(pool)]),
    )


def _sides(pool: Pool) -> Iterator[FloatArray]:
    """Log weights of the violations on each side of the starts' medians that has a share of all."""
    if pool.start is None or not pool.violated.any():
        return
    upper, log_weight = pool.start[pool.violated] >= 0.0, pool.log_weight[pool.violated]
    latents = upper.shape[1]
    number = upper @ (1 << np.arange(latents)) if latents <= FEW_STARTS else None
    sides = upper.T if number is None else number == np.unique(number)[:, None]
    for side in sides if number is not None else np.concatenate([sides, ~sides]):
        share = math.exp(log_sum(log_weight[side]) - log_sum(log_weight)) if side.any() else 0.0
        if LEAST_SIDE <= share < 1.0:
            yield log_weight[side]


def _of(log_weight: FloatArray, violated: BoolArray, component: IntArray) -> LogEstimate:
    return (
        log_mean_failing_weight(log_weight, violated),
        StratifiedError.of(log_weight, violated, component).log_error,
    )


def _errors_apart(first: LogEstimate, second: LogEstimate) -> float:
    """Distance of two estimates in joint standard errors; 0 where neither saw a failure."""
    largest = max(first[0], second[0])
    if not np.isfinite(largest):
        return 0.0
    (one, error), (other, other_error) = np.exp(np.array([first, second]) - largest)
    joint = PARTS_ADAPTATION * float(np.hypot(error, other_error))
    return abs(float(one - other)) / joint if joint > 0.0 else 0.0
