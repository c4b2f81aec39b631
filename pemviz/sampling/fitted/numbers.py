"""What the loop of fitted proposals is given: a scenario, an error model, a proposal as numbers.

All arrays of a kind have as many axes and the same order in memory whether they are used or not, so
that one translation of the loop serves all. An array that is not used is empty.
"""

from typing import Any, NamedTuple

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.simulators.braking.loops import Numbers

ERROR_MODEL, ALONG_GAP, DIVIDED = 0, 1, 2
"""What outcomes are drawn from: the error model, a network of the gap, or a pilot or fit each."""


class Pieces(NamedTuple):
    """A function of one number that is linear between its edges.

    Attributes:
        edge: Ascending ``[K]``.
        value: There, ``[K]``.
        slope: From each to the next, ``[K]``; 0 at the last.
        first: Of equal cells from ``edge[0]`` on, the piece in which each begins, or one before,
            ``[G]``.
        cells_per_unit: G over the whole width.
    """

    edge: FloatArray
    value: FloatArray
    slope: FloatArray
    first: IntArray
    cells_per_unit: float


class Chained(NamedTuple):
    """The error model: along the gap, and how its misses hang together.

    Attributes:
        own: Logit of 'detected' of single outcomes by gap [m].
        remembers: Whether there is an outcome before.
        rho: Correlation with it, from 0 to below 1.
        log_rest: log(1 - rho).
    """

    own: Pieces
    remembers: bool
    rho: float
    log_rest: float


class Rules(NamedTuple):
    """Which single states violate the specification: those that break one of R rules.

    Attributes:
        latched: Whether states remember it.
        first: First step of each, ``[R]``.
        last: Its last, ``[R]``.
        signal: Gap (0), ego's speed (1) or lead car's (2), ``[R]``.
        is_lower: Whether ``bound`` is a lower one, ``[R]``.
        bound: ``[R]``.
    """

    latched: bool
    first: IntArray
    last: IntArray
    signal: IntArray
    is_lower: BoolArray
    bound: FloatArray


class Tracking(NamedTuple):
    """A tracker whose tracks stand where their last hit was; see ``pemviz.simulators.tracking``.

    Attributes:
        tracks: Whether there is one.
        hits: Needed for a confirmation.
        window: Outcomes that they are counted over.
        coast_steps: Misses in a row that a confirmed track outlives.
        none_since: Steps since the last hit, as it is told where there is no track.
        known_s: For how long an outcome is known of [s].
        known_m: By how much the gap may shrink more than at a constant speed meanwhile [m].
    """

    tracks: bool
    hits: int
    window: int
    coast_steps: int
    none_since: int
    known_s: float
    known_m: float


class Fitted(NamedTuple):
    """What outcomes of N rollouts are drawn from.

    Attributes:
        kind: One of the three above.
        network: Logit of 'detected' by gap [m].
        everywhere: Whether proposals may act where the scenario does not react.
        strength: Of pilots ``[N]``.
        begin: First step of their windows ``[N]``.
        stop: The step after their last ``[N]``.
        piloted: Which rollouts are pilots' ``[N]``.
        coefficients: Of monomials ``[N, B]``, or ``[N, 0]``.
        mean: Of features ``[D]``.
        spread: Of features ``[D]``.
        lower: Of each monomial but the constant the one that it is a feature times, ``[B - 1]``.
        feature: That feature, ``[B - 1]``.
        share: Of the error model in what fits draw.
    """

    kind: int
    network: Pieces
    everywhere: bool
    strength: FloatArray
    begin: IntArray
    stop: IntArray
    piloted: BoolArray
    coefficients: FloatArray
    mean: FloatArray
    spread: FloatArray
    lower: IntArray
    feature: IntArray
    share: float


class Written(NamedTuple):
    """N rollouts, time-major; their first states are there, the rest is written.

    Attributes:
        gap_m: ``[T, N]`` [m].
        ego_mps: Speeds of the ego ``[T, N]`` [m/s].
        integral_m: Its speed error integral ``[T, N]`` [m].
        outcome: The outcome before, ``[T, N]``.
        window: Of tracks, ``[T, N]``; see ``pemviz.simulators.tracking.tracker.TrackerState``.
        misses: Likewise.
        confirmed: Likewise.
        position_m: Likewise [m].
        violated: ``[T, N]``.
        detected: ``[T-1, N]``.
        under_pem: Logit of 'detected' ``[T-1, N]``.
        under_proposal: Likewise.
        lead_mps: Speeds of the lead car ``[T]`` [m/s], alike in all.
        doubtful: Which have come too close to a decision to tell it by rounded numbers, ``[N]``.
    """

    gap_m: FloatArray
    ego_mps: FloatArray
    integral_m: FloatArray
    outcome: FloatArray
    window: IntArray
    misses: IntArray
    confirmed: BoolArray
    position_m: FloatArray
    violated: BoolArray
    detected: BoolArray
    under_pem: FloatArray
    under_proposal: FloatArray
    lead_mps: FloatArray
    doubtful: BoolArray


class Scene(NamedTuple):
    """Numbers of the scenario, of its tracker and of the specification."""

    numbers: Numbers
    tracking: Tracking
    rules: Rules


class Step(NamedTuple):
    """A step of n rollouts: its number, the lead car's speed [m/s] there, the rest ``[n]``.

    ``acts`` says where pilots and fits may leave the error model; ``own`` is the error model's
    logit, ``logit`` that of what the outcome ``detected`` is drawn from. Others as in
    :class:`Written`; what is not kept is empty.
    """

    step: int
    lead: float
    gap: FloatArray
    ego: FloatArray
    held: FloatArray
    before: FloatArray
    window: IntArray
    misses: IntArray
    confirmed: BoolArray
    position: FloatArray
    violated: BoolArray
    acts: BoolArray
    own: FloatArray
    logit: FloatArray
    detected: BoolArray


class Block(NamedTuple):
    """Room for n rollouts at one step.

    Attributes:
        acts: Where pilots and fits may leave the error model ``[n]``.
        seen: Standardised features ``[D, n]``.
        monomial: Of them ``[B, n]``.
        raised: By how much fits raise the logit of a miss ``[n]``.
        by_row: Coefficients ``[B, n]``.
    """

    acts: BoolArray
    seen: FloatArray
    monomial: FloatArray
    raised: FloatArray
    by_row: FloatArray


def pieces_of(edge: FloatArray, value: FloatArray, *, cells: int) -> Pieces:
    """The function that is ``value [K]`` at ``edge [K]``, K at least 2, and linear in between."""
    slope: Any = np.zeros(edge.size)
    slope[:-1] = np.diff(value) / np.diff(edge)
    begins = np.linspace(edge[0], edge[-1], cells, endpoint=False)
    first = np.searchsorted(edge, begins, side="right") - 2  # one early: rounding may be in between
    return Pieces(
        edge=edge,
        value=value,
        slope=slope,
        first=first.clip(0, edge.size - 2),
        cells_per_unit=cells / float(edge[-1] - edge[0]),
    )
