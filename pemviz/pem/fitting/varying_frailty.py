"""Time-varying frailty from tracks, by maximum likelihood given P(missed | state).

The likelihood of a track is that of :mod:`pemviz.pem.models.varying_frailty`, by its filter.
Beside it stands that of copied outcomes (:mod:`pemviz.pem.fitting.memory`) of the same tracks:
which law tells them better, and by how much more than sequences differ (Vuong 1989, Econometrica
57:307; sequences, not observations, are independent).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.table import TrackTable
from pemviz.pem.fitting.memory import check_fittable, log_likelihoods
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.varying_frailty import LARGEST, NodeGrid, VaryingFrailty, VaryingNodes
from pemviz.processes import map_in_processes, usable_cpus

GRID = NodeGrid(farthest=6.0, of_lasting=0.5, of_varying=1.2)
"""A likelihood is no tail: this is good for 1e-3 of its logarithm."""
TRACKS = 32
"""Gone through at once: more do not stay in a core's cache."""
TIMES_S = 1e-3
"""Times between frames are rounded to this."""
LOW, HIGH = np.log([0.02, 0.05, 0.02]), np.log([4.0, LARGEST, 8.0])
"""Of f, g and tau [s]."""
STARTS = ((0.7, 1.0, 0.2), (0.7, 1.0, 1.0), (0.7, 2.5, 0.2), (0.7, 2.5, 1.0))
"""The likeliest of these is where the search begins."""
LEAST_START = (0.3, 0.3, 0.05)
"""Near 0 a spread's logarithm has no slope, and a search would stay there."""
NEARLY_NONE = 0.03
"""A frailty below this is taken for none."""

Progress = Callable[[int, int], None]
MOST = 200
"""Evaluations of the likelihood."""
FAR, NEAR = 0.7, 0.35
"""How far a search looks at first, in logarithms of the parameters: from one of ``STARTS``, or from
the law of nearly the same tracks."""
FOUND = 0.04
"""How far at last: no tracks tell a parameter that well."""


@dataclass(frozen=True)
class VaryingFit:
    """A fitted law, beside copied outcomes.

    Attributes:
        law: The likeliest.
        nats: Mean negative log-likelihood of an outcome.
        better_by: How much less that is than with copied outcomes; below 0: more.
        better_by_std_error: Of this, from sequence to sequence.
    """

    law: VaryingFrailty
    nats: float
    better_by: float
    better_by_std_error: float


def fit_varying_frailty(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    memory: Memory,
    on_progress: Progress | None = None,
) -> VaryingFit:
    """Fit f, g and tau.

    Args:
        tracks: n observations.
        logit: Out-of-fold logits of P(detected | state), as of
            :func:`pemviz.pem.fitting.memory.fit_memory`, ``[n]``.
        memory: The law of copied outcomes that was fitted to the same tracks.
        on_progress: Called with evaluations done and the most there may be.

    Raises:
        PemError: Fewer than two sequences, or no obstacle is seen twice.
    """
    check_fittable(tracks)
    law = likeliest_law(tracks, logit, on_progress=on_progress)
    own = sequence_log_likelihoods(tracks, logit, law)
    taus_s, frailties = np.array([memory.tau_s]), np.array([memory.frailty])
    copied = log_likelihoods(tracks, logit, taus_s=taus_s, frailties=frailties)[:, 0, 0]
    apart = own - copied
    spread = float(np.sqrt(apart.size) * apart.std(ddof=1))
    return VaryingFit(
        law=law,
        nats=-float(own.sum()) / len(tracks),
        better_by=float(apart.sum()) / len(tracks),
        better_by_std_error=spread / len(tracks),
    )


def held_out_laws(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    part: IntArray,
    start: VaryingFrailty,
    on_progress: Progress | None = None,
) -> tuple[VaryingFrailty, ...]:
    """The law of each part of the sequences, fitted to the others, in processes.

    Args:
        tracks: n observations.
        logit: As in :func:`fit_varying_frailty`.
        part: Which part each observation is of ``[n]``; a sequence lies in one.
        start: Where each search begins: the law of all.
        on_progress: Called with parts done and parts in all.

    Raises:
        PemError: No obstacle of the other parts is seen twice.
        RunError: A process died.
    """
    parts, done = range(int(part.max()) + 1), 0

    def tell(_: int) -> None:
        nonlocal done
        done += 1
        if on_progress is not None:
            on_progress(done, len(parts))

    fit = partial(_law_without, tracks, logit, part, start)
    return tuple(map_in_processes(fit, parts, workers=usable_cpus(), on_done=tell))


def _law_without(
    tracks: TrackTable,
    logit: FloatArray,
    part: IntArray,
    start: VaryingFrailty,
    left_out: int,
) -> VaryingFrailty:
    others = part != left_out
    seen = tracks.only(others)
    if not seen.follows.any():
        where = f"without part {left_out + 1} of {int(part.max()) + 1}"
        raise PemError(f"no obstacle is seen twice {where}: fewer folds, or more tracks")
    return likeliest_law(seen, logit[others], start=start)


def likeliest_law(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    start: VaryingFrailty | None = None,
    on_progress: Progress | None = None,
) -> VaryingFrailty:
    """The law under which tracks are likeliest.

    It is sought from ``start`` on, ``None``: from the likeliest of ``STARTS``; the rest is as of
    :func:`fit_varying_frailty`.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  slow to import

    done = 0

    def negative_log_likelihood(place: FloatArray) -> float:
        nonlocal done
        done += 1
        if on_progress is not None:
            on_progress(min(done, MOST), MOST)
        return -float(sequence_log_likelihoods(tracks, logit, _law(place)).sum())

    starts = STARTS if start is None else [(start.frailty, start.varying, start.varying_s)]
    places = [np.log(np.maximum(one, LEAST_START)) for one in starts]
    begin = min(places, key=negative_log_likelihood) if len(places) > 1 else places[0]
    radius = FAR if start is None else NEAR
    options = {"maxfev": MOST, "initial_tr_radius": radius, "final_tr_radius": FOUND}
    bounds = list(zip(LOW, HIGH, strict=True))
    # by values alone: a slope would cost three of them, and the ridge is long
    found = minimize(
        negative_log_likelihood, begin, method="COBYQA", bounds=bounds, options=options
    )
    law = _law(np.asarray(found.x))
    if on_progress is not None:
        on_progress(MOST, MOST)
    if law.frailty < NEARLY_NONE:
        law = VaryingFrailty(0.0, law.varying, law.varying_s)
    return law


def _law(place: FloatArray) -> VaryingFrailty:
    frailty, varying, varying_s = np.exp(np.clip(place, LOW, HIGH)).tolist()
    return VaryingFrailty(frailty, min(varying, LARGEST), varying_s)


def sequence_log_likelihoods(
    tracks: TrackTable, logit: FloatArray, law: VaryingFrailty
) -> FloatArray:
    """Log likelihood of each sequence ``[S]`` [nats], from logits of P(detected) ``[n]``."""
    sequences, of_sequence = np.unique(tracks.sequence, return_inverse=True)
    starts = np.flatnonzero(~tracks.follows)
    length = np.diff(np.append(starts, len(tracks)))
    since_s = np.where(tracks.follows, tracks.since_s, 0.0)
    since_s = np.maximum(np.round(since_s / TIMES_S), 1.0) * TIMES_S
    nodes = VaryingNodes(law, float(np.quantile(since_s[tracks.follows], 0.05)), GRID)
    moves = {one: nodes.moved_on(one) for one in np.unique(since_s[tracks.follows]).tolist()}
    found, longest_first = np.zeros(sequences.size), np.argsort(-length, kind="stable")
    for first in range(0, starts.size, TRACKS):
        which = longest_first[first : first + TRACKS]
        log_p = _tracks_log_likelihood(
            tracks, logit, since_s, starts[which], length[which], nodes=nodes, moves=moves
        )
        np.add.at(found, of_sequence[starts[which]], log_p)
    return found


def _tracks_log_likelihood(
    tracks: TrackTable,
    logit: FloatArray,
    since_s: FloatArray,
    starts: IntArray,
    length: IntArray,
    *,
    nodes: VaryingNodes,
    moves: dict[float, FloatArray],
) -> FloatArray:
    """Of tracks that begin at ``starts``, the longest first."""
    log_p, shares = np.zeros(starts.size), nodes.begun(starts.size)
    for place in range(int(length[0])):
        going = int(np.count_nonzero(length > place))
        rows, shares = starts[:going] + place, shares[:going]
        if place:
            later = np.empty_like(shares)
            for one in np.unique(since_s[rows]).tolist():
                chosen = since_s[rows] == one
                later[chosen] = nodes.later(shares[chosen], moves[one])
            shares = later
        log_outcomes = nodes.log_outcomes(logit[rows], ~tracks.detected[rows])
        shares, told = nodes.after(shares, log_outcomes)
        log_p[:going] += told
    return log_p
