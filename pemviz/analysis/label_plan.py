"""What to label next, so that the data alone show that the failure probability is small enough.

In every band of distance the data bound P(missed) by Clopper and Pearson's limit; with all bands
at their limits the failure probability has to stay below the target. To show P(missed) <= u_b in
band b costs L_b(u_b) further labelled obstacles (:mod:`pemviz.analysis.binomial_plan`). The
cheapest requirement is::

    minimise  sum_b L_b(u_b)   subject to   log mu(u) <= log target

With u_b in place of log u_b this is close to a geometric program (Boyd, Kim, Vandenberghe,
Hassibi 2007): the failure probability is a sum of products of powers, the costs fall about as
1 / u_b. It is solved in log u_b, from the one factor on all bands that meets the target.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.analysis.band_models import (
    BANDS,
    MOST_CERTAIN,
    BandOutcomes,
    band_outcomes,
    visited_salient,
)
from pemviz.analysis.binomial_plan import (
    MOST_LABELS,
    POWER,
    LabelsNeeded,
    labels_if_none_missed,
    labels_needed,
)
from pemviz.arrays import BoolArray, FloatArray, IntArray, softplus
from pemviz.binomial import exact_upper_bound, exact_upper_bounds
from pemviz.config.ranges import AtLeastZero, Confidence, Count, Share
from pemviz.pem import Pem, SupportSummary
from pemviz.pem.data.support import (
    DISTANCE_EDGES_M,
    cell_in_words,
    cell_of,
    kinds_and_bands,
)
from pemviz.pem.models.pieces import logit_along
from pemviz.pem.models.protocol import as_rows
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.problem import Problem

GRID = 60
SMALLEST = 1e-6
LARGEST = 1.0
NEAREST = 1.02
"""A requirement is at least so many times what the detector is believed to do."""
SLACK = 1e-6
"""By how much the log failure probability may miss the target."""
CONFIDENCE = 0.95
MOST_PASSES = 4
SETTLED = 0.3
"""Log of how far a requirement may lie from the model that its violations were sampled for."""
LARGEST_SAMPLED = 0.999
"""No model that violations are sampled for misses more often."""
FIRST_MARGIN = 0.2
"""By how much the log failure probability stays below the target, for the violations' own error."""
LEAST_POWER, HALVINGS, SIMULATED = 0.2, 6, 300
POWER_MARGIN = 0.02
"""For the error of a probability from SIMULATED samples."""
NEGLIGIBLE = 0.05
"""Elasticity of a band whose requirement hardly matters."""
SEED_KEY = 2**32 - 5


@dataclass(frozen=True)
class LabelledBand:
    """What is known of a band of distance.

    Attributes:
        band: Its index.
        obstacles: Labelled obstacles in it.
        missed: The missed ones.
        assumed: The detector's P(missed) there, as the error model has it.
    """

    band: int
    obstacles: int
    missed: int
    assumed: float

    def needed(self, bound: float, *, confidence: float, power: float) -> LabelsNeeded | None:
        """The smallest further sample that shows P(missed) <= ``bound`` with this power."""
        return labels_needed(
            obstacles=self.obstacles,
            missed=self.missed,
            bound=bound,
            assumed=self.assumed,
            confidence=confidence,
            power=power,
        )


def cheapest_requirement(
    outcomes: BandOutcomes,
    *,
    bands: Sequence[LabelledBand],
    log_target: float,
    confidence: float,
    power: float,
) -> FloatArray | None:
    """P(missed) ``[B]`` that meets the target with the fewest labels; 0 in bands left out.

    If the detector as assumed does not meet the target, the cheapest requirement is the one that
    takes the fewest labels of which none is missed: it has to become better first.

    Args:
        outcomes: Violations drawn for models near the answer.
        bands: Those whose outcomes may matter.
        log_target: Log of the failure probability to stay below [nats].
        confidence: Of each band's bound.
        power: How likely each band's sample must suffice, if the detector is as assumed.

    Returns:
        ``None`` where even P(missed) of SMALLEST everywhere does not meet it.
    """
    assumed = np.array([band.assumed for band in bands])
    ways = ((NEAREST * assumed, power), (np.full(len(bands), SMALLEST), None))
    for lowest, chance in ways:
        allocation = _Allocation(
            outcomes=outcomes,
            index=np.array([band.band for band in bands]),
            lowest=np.log(np.clip(lowest, SMALLEST, LARGEST)),
            costs=tuple(_cost(band, confidence, chance) for band in bands),
            log_target=log_target,
        )
        found = allocation.cheapest()
        if found is not None:
            return allocation.everywhere(found)
    return None


@dataclass(frozen=True)
class _Allocation:
    outcomes: BandOutcomes
    index: IntArray
    lowest: FloatArray
    costs: tuple[Callable[[float], float], ...]
    log_target: float

    def everywhere(self, log_miss: FloatArray) -> FloatArray:
        miss = np.zeros(self.outcomes.misses.shape[1])
        miss[self.index] = np.exp(log_miss)
        return miss

    def excess(self, log_miss: FloatArray) -> float:
        """Log failure probability over the target; at most 0 is wanted."""
        return self.outcomes.log_probability(self.everywhere(log_miss)) - self.log_target

    def log_cost(self, log_miss: FloatArray) -> float:
        each = (cost(value) for cost, value in zip(self.costs, log_miss.tolist(), strict=True))
        return math.log1p(sum(each))

    def cheapest(self) -> FloatArray | None:
        """The best ``log_miss``; ``None`` where the lowest does not meet the target."""
        if self.excess(self.lowest) > 0.0:
            return None
        every = np.full(self.lowest.size, math.log(LARGEST))
        if self.excess(every) <= 0.0:
            return every
        start = self._meeting(self.lowest, every)
        starts = [start]
        for band in range(start.size):  # ask nothing of one band, where others can make up for it
            low, high = self.lowest.copy(), start.copy()
            low[band] = high[band] = math.log(LARGEST)
            if self.excess(low) < 0.0 < self.excess(high):
                starts.append(self._meeting(low, high))
        best = start
        for found in map(self._improved, starts):
            if self.log_cost(found) < self.log_cost(best):
                best = found
        return best

    def _meeting(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Where the line from ``low``, which meets the target, to ``high`` no longer does."""
        from scipy.optimize import brentq  # noqa: PLC0415  slow to import

        def excess(share: float) -> float:
            return self.excess(low + share * (high - low))

        share = float(np.asarray(brentq(excess, 0.0, 1.0, xtol=1e-9)))
        return low + share * (high - low)

    def _improved(self, start: FloatArray) -> FloatArray:
        """A cheaper requirement near ``start`` that still meets the target, or ``start``."""
        from scipy.optimize import minimize  # noqa: PLC0415  slow to import

        def spare(log_miss: FloatArray) -> float:
            return -self.excess(log_miss)

        found = minimize(
            self.log_cost,
            start,
            method="SLSQP",
            bounds=[(low, math.log(LARGEST)) for low in self.lowest],
            constraints={"type": "ineq", "fun": spare},
            options={"maxiter": 100, "ftol": 1e-6},
        )
        end = np.clip(np.asarray(found.x), self.lowest, math.log(LARGEST))
        return end if np.isfinite(end).all() and self.excess(end) <= SLACK else start


def _cost(band: LabelledBand, confidence: float, power: float | None) -> Callable[[float], float]:
    """Labels by log of what is to be shown, between exact figures on a grid.

    They suffice with ``power`` if the detector is as assumed; ``None``: if none of them is missed.
    """
    lowest = SMALLEST if power is None else max(NEAREST * band.assumed, SMALLEST)
    places = np.linspace(min(math.log(lowest), -1e-6), math.log(LARGEST), GRID)
    labels: list[float] = []
    for bound in map(math.exp, places.tolist()):
        if power is None:
            needed = labels_if_none_missed(
                obstacles=band.obstacles, missed=band.missed, bound=bound, confidence=confidence
            )
        else:
            found = band.needed(bound, confidence=confidence, power=power)
            needed = MOST_LABELS if found is None else found.labels
        labels.append(float(needed))

    def cost(log_miss: float) -> float:
        return float(np.interp(log_miss, places, labels))

    return cost


@dataclass(frozen=True)
class BandPlan:
    """What to do in one band of distance z, from the camera to the obstacle's centre.

    Attributes:
        low_m: Lower edge of z [m]; ``None`` behind the camera.
        high_m: Upper edge [m]; ``None`` for the farthest band.
        obstacles: Labelled obstacles like those that the scenario shows.
        missed: The missed ones among them.
        model: The error model's mean P(missed) where its outcome may matter.
        allowed: The largest P(missed) that the data allow.
        required: The largest P(missed) with which the target is met.
        fewest_labels: More labelled obstacles that show it if none of them is missed.
        labels: More labelled obstacles; with the other bands' they show the target with the plan's
            power, if the detector is as the error model says. ``None`` where it misses too often.
        most_missed: With so many of these missed, or fewer, ``required`` is shown; more can be
            made up for by fewer in other bands. ``None`` likewise.
    """

    low_m: float | None
    high_m: float | None
    obstacles: Count
    missed: Count
    model: Share
    allowed: Share
    required: Share
    fewest_labels: Count
    labels: Count | None
    most_missed: Count | None


@dataclass(frozen=True)
class LabelPlan:
    """Labels that would show a failure probability below a target.

    Attributes:
        target: The failure probability.
        obstacle: What kind of obstacle to label, in words.
        confidence: Of all bands' bounds together.
        power: How likely all bands' samples together show the target, if the detector is as the
            model says.
        bands: Where outcomes may matter, near to far.
        warning: What to keep in mind about the requirement; ``None`` if nothing.
    """

    target: AtLeastZero
    obstacle: str
    confidence: Confidence
    power: Share
    bands: tuple[BandPlan, ...]
    warning: str | None = None


@dataclass(frozen=True)
class Labelled:
    """Labelled obstacles like those that a scenario shows.

    Attributes:
        obstacle: The kinds, in words.
        obstacles: By band of distance, ``[B]``.
        missed: The missed ones among them, ``[B]``.
        visited: Bands that rollouts come through, ``[B]``.
    """

    obstacle: str
    obstacles: IntArray
    missed: IntArray
    visited: BoolArray


def labelled(salient: FloatArray, support: SupportSummary) -> Labelled:
    """What is labelled of what a scenario shows.

    Args:
        salient: Variables of the steps that it visits, ``[..., 11]``.
        support: Counts of the labelled obstacles.
    """
    rows, _ = as_rows(salient)
    kinds, band = kinds_and_bands(rows)
    return Labelled(
        obstacle="; ".join(cell_in_words(*(int(part) for part in kind)) for kind in kinds),
        obstacles=support.obstacles[tuple(kinds.T)].sum(axis=0),
        missed=support.missed[tuple(kinds.T)].sum(axis=0),
        visited=np.bincount(band, minlength=BANDS) > 0,
    )


def model_misses(pem: Pem, salient: FloatArray) -> FloatArray:
    """Mean P(missed) of a model in each band ``[B]`` over rows ``[M, 11]``; 0 where none is."""
    rows, _ = as_rows(salient)
    band = cell_of(rows)[-1]
    missed = np.exp(-softplus(logit_along(pem, rows)))
    rows_in = np.bincount(band, minlength=BANDS)
    return np.bincount(band, weights=missed, minlength=BANDS) / np.maximum(rows_in, 1)


@dataclass(frozen=True)
class Task:
    """What a plan is made for.

    Attributes:
        problem: On a fast simulator; its error model is taken for what the detector does.
        features: Says at which states perception's outcome may matter.
        known: What is labelled.
        target: The failure probability to stay below.
    """

    problem: Problem
    features: StateFeatures
    known: Labelled
    target: float

    def bands(self, outcomes: BandOutcomes) -> list[LabelledBand]:
        """Bands in which some violation's outcome may have mattered."""
        counted = outcomes.misses.sum(axis=0) + outcomes.hits.sum(axis=0)
        assumed = model_misses(self.problem.pem, outcomes.salient)
        return [
            LabelledBand(
                band=band,
                obstacles=int(self.known.obstacles[band]),
                missed=int(self.known.missed[band]),
                assumed=float(assumed[band]),
            )
            for band in np.flatnonzero(counted).tolist()
        ]

    def confidence(self, bands: Sequence[LabelledBand]) -> float:
        """Of each band's bound once the sample is there, so that all hold together."""
        filled = self.known.visited & (self.known.obstacles > 0)
        filled[[band.band for band in bands]] = True
        return 1.0 - (1.0 - CONFIDENCE) / int(filled.sum())


def label_plan(
    problem: Problem,
    *,
    features: StateFeatures,
    support: SupportSummary,
    target: float,
    log_probability: float,
    elasticity: float | None,
    seed: int,
) -> tuple[LabelPlan, BandOutcomes] | None:
    """The cheapest labels that show a failure probability below ``target``.

    Args:
        problem: On a fast simulator; its error model is taken for what the detector does.
        features: Says at which states perception's outcome may matter.
        support: Counts of the labelled obstacles.
        target: The failure probability.
        log_probability: Log of the present answer [nats].
        elasticity: d log(answer) / d log(P(missed)), all distances equally; ``None``: not known.
        seed: Root of all randomness.

    Returns:
        The plan with the violations that it rests on; ``None`` where nothing violates, or even
        a detector that hardly misses does not meet the target.
    """
    task = Task(problem, features, labelled(visited_salient(problem), support), target)
    # first guess: the model's P(missed), changed equally everywhere
    own = model_misses(problem.pem, visited_salient(problem))
    factor = math.exp((math.log(target) - log_probability) / max(elasticity or 0.0, 1.0))
    start = np.where(own > 0.0, own * factor, LARGEST_SAMPLED)
    found = _required(task, start=start, seed=seed)
    if found is None:
        return None
    outcomes, required = found
    bands = task.bands(outcomes)
    confidence = task.confidence(bands)
    samples = _samples(
        outcomes,
        bands,
        required=required,
        confidence=confidence,
        log_target=math.log(target) - FIRST_MARGIN,
    )
    effective = outcomes.effective_failures(required)
    plan = LabelPlan(
        target=target,
        obstacle=task.known.obstacle,
        confidence=CONFIDENCE,
        power=POWER,
        bands=tuple(
            _band_plan(band, sample, confidence=confidence, bound=float(required[band.band]))
            for band, sample in zip(bands, samples, strict=True)
        ),
        warning=None
        if effective >= SMALL_ESS
        else "few of the simulated violations look like those at the requirement: a rough plan",
    )
    return plan, outcomes


def _required(
    task: Task, *, start: FloatArray, seed: int
) -> tuple[BandOutcomes, FloatArray] | None:
    """Violations drawn near the cheapest requirement, and that requirement ``[B]``."""
    seeds = np.random.SeedSequence(seed, spawn_key=(SEED_KEY,)).generate_state(MOST_PASSES)
    drawn_for, margin = np.clip(start, MOST_CERTAIN, LARGEST_SAMPLED), FIRST_MARGIN
    found = None
    for pass_seed in seeds.tolist():
        outcomes = band_outcomes(
            task.problem, miss=drawn_for, features=task.features, seed=pass_seed
        )
        bands = task.bands(outcomes)
        required = cheapest_requirement(
            outcomes,
            bands=bands,
            log_target=math.log(task.target) - margin,
            confidence=task.confidence(bands),
            power=each_power(len(bands)),
        )
        if required is None:
            break
        found = (outcomes, required)
        wanted = np.where(required > 0.0, required, drawn_for)
        wanted = np.clip(wanted, MOST_CERTAIN, LARGEST_SAMPLED)
        away = np.abs(np.log(wanted / drawn_for))[np.abs(outcomes.slopes(required)) > NEGLIGIBLE]
        if away.size == 0 or float(away.max()) <= SETTLED:
            break
        drawn_for = wanted
        margin = 2.0 / math.sqrt(max(outcomes.effective_failures(required), SMALL_ESS))
    return found


def each_power(bands: int) -> float:
    """What each band's sample must suffice with, so that all do with POWER."""
    return POWER ** (1.0 / max(bands, 1))


def _samples(
    outcomes: BandOutcomes,
    bands: Sequence[LabelledBand],
    *,
    required: FloatArray,
    confidence: float,
    log_target: float,
) -> list[LabelsNeeded | None]:
    """The smallest samples with which the target is shown with POWER, all bands together.

    More misses than planned in one band are made up for by fewer in another: each band's own
    power may be smaller, and is lowered as far as simulated samples allow.
    """

    def at(power: float) -> list[LabelsNeeded | None]:
        return [
            band.needed(float(required[band.band]), confidence=confidence, power=power)
            for band in bands
        ]

    high = each_power(len(bands))
    best = at(high)
    if any(sample is None for sample in best):
        return best
    low = LEAST_POWER
    for _ in range(HALVINGS):
        power = 0.5 * (low + high)
        chance = _chance(outcomes, bands, at(power), confidence=confidence, log_target=log_target)
        low, high = (low, power) if chance >= POWER + POWER_MARGIN else (power, high)
    return at(high)


def _chance(
    outcomes: BandOutcomes,
    bands: Sequence[LabelledBand],
    samples: Sequence[LabelsNeeded | None],
    *,
    confidence: float,
    log_target: float,
) -> float:
    """How likely the samples show the target, if the detector is as assumed: by simulation."""
    generator = np.random.default_rng(SEED_KEY)
    miss = np.zeros((SIMULATED, BANDS))
    for band, sample in zip(bands, samples, strict=True):
        labels = 0 if sample is None else sample.labels
        missed = band.missed + generator.binomial(labels, band.assumed, size=SIMULATED)
        detected = band.obstacles + labels - missed
        miss[:, band.band] = exact_upper_bounds(missed, detected, confidence=confidence)
    shown = [outcomes.log_probability(row) <= log_target for row in miss]
    return float(np.mean(shown))


def _band_plan(
    band: LabelledBand, sample: LabelsNeeded | None, *, confidence: float, bound: float
) -> BandPlan:
    edges = (None, *DISTANCE_EDGES_M, None)
    return BandPlan(
        low_m=edges[band.band],
        high_m=edges[band.band + 1],
        obstacles=band.obstacles,
        missed=band.missed,
        model=band.assumed,
        allowed=exact_upper_bound(band.missed, band.obstacles, confidence=confidence),
        required=bound,
        fewest_labels=labels_if_none_missed(
            obstacles=band.obstacles, missed=band.missed, bound=bound, confidence=confidence
        ),
        labels=None if sample is None else sample.labels,
        most_missed=None if sample is None else sample.most_missed,
    )
