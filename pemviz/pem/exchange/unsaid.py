"""What a table by distance cannot say of an error model, and how much that is, in words.

How long obstacles are missed on end: with P(missed) = p and rho = exp(-h / tau), k frames h seconds
apart are all missed with p (p + (1 - p) rho)^(k - 1). In the model p is each obstacle's own, by its
state and its visibility u, held for that time; in the table it is the bin's.
"""

from collections.abc import Iterator

import numpy as np
from scipy import stats
from scipy.special import expit

from pemviz.arrays import FloatArray
from pemviz.pem.data.support import cell_of, support_of
from pemviz.pem.exchange.averages import MATCHED_LAG_S, Averages, AxisAverages, Obstacles
from pemviz.pem.models.memory import VisibilityNodes, persistence
from pemviz.pem.models.position_errors import PositionErrorModel
from pemviz.pem.models.protocol import COLUMN, OCCLUSION_NAMES, Pem

RATE_HZ = 10.0
ON_END = 10
"""Frames on end whose misses are told of: one second."""
FAR_LAG_S = 3.0
LAGS_S = (0.1, 1.0, 3.0)
TAIL = 3.0
LEAST_WITH_SD = 2.0
"""Degrees of freedom above which Student's t has a standard deviation."""
CHUNK_ROWS = 4096
"""Obstacles whose visibilities are looked at together; there are about a hundred each."""


def unsaid_of_misses(pem: Pem, obstacles: Obstacles, table: Averages) -> Iterator[str]:
    """Of misses: other features, bursts, frailty, and bins that no obstacle is in."""
    own = expit(-pem.logit(obstacles.salient))
    binned = table.miss[table.bin_of(obstacles.distance_m)]
    spread = float(np.sqrt(np.mean((own - binned) ** 2)))
    observed = obstacles.detected
    counted = "" if observed is None else f" ({np.mean(~observed):.3g} of these were missed)"
    yield (
        f"P(missed) depends on more than distance: {own.mean():.3g} on average{counted}, of single "
        f"ones {spread:.2g} off the bin's (root mean square); {_by_occlusion(pem, obstacles)}"
    )
    memory = table.memory
    rho = float(persistence(1.0 / RATE_HZ, memory.tau_s))
    held, correlation = _over_visibilities(pem, obstacles, frailty=memory.frailty, rho=rho)
    yield (
        f"misses last: {held:.2g} of obstacles are missed for {ON_END / RATE_HZ:g} s on end at "
        f"{RATE_HZ:g} Hz by the model, state{' and frailty' * bool(memory.frailty)} held; "
        f"{float(np.mean(_on_end(binned, rho))):.2g} by what is written"
    )
    if memory.frailty:
        yield (
            f"frailty {memory.frailty:.2g}: by it alone outcomes of one obstacle {FAR_LAG_S:g} s "
            f"apart have the correlation {correlation:.2g}; in what is written "
            f"{float(persistence(FAR_LAG_S, memory.tau_s)):.1g}"
        )
    if memory.tau_s == 0.0:
        yield "the model has no memory: misses are independent from frame to frame"
    counts = support_of(pem)
    if counts is not None:
        unseen = float(np.mean(counts.obstacles[cell_of(obstacles.salient)] == 0))
        if unseen:
            yield (
                f"for {unseen:.1%} of these obstacles P(missed) is a guess: the model's data have "
                "none of their class, occlusion, place and heading"
            )
    empty = table.rows == 0
    if empty.any():
        yield (
            f"no obstacle at {table.words_of(empty)}: there the values of the next bin with "
            "obstacles hold"
        )


def _by_occlusion(pem: Pem, obstacles: Obstacles) -> str:
    """Mean P(missed) by occlusion; of made-up obstacles as if they were occluded."""
    column, shown = COLUMN["occlusion"], list[str]()
    for level, name in enumerate(OCCLUSION_NAMES):
        rows = obstacles.salient[obstacles.salient[:, column] == level]
        if obstacles.detected is None:
            rows = obstacles.salient.copy()
            rows[:, column] = level
        if len(rows):
            shown.append(f"{name} {float(expit(-pem.logit(rows)).mean()):.2g}")
    return f"occluded {', '.join(shown)}; what is written holds for all equally"


def _on_end(miss: FloatArray, rho: float) -> FloatArray:
    return miss * (miss + (1.0 - miss) * rho) ** (ON_END - 1)


def _over_visibilities(
    pem: Pem, obstacles: Obstacles, *, frailty: float, rho: float
) -> tuple[float, float]:
    """Share missed on end, and the correlation of far outcomes that frailty alone gives."""
    nodes = VisibilityNodes(frailty)
    weight = np.exp(nodes.log_weight)
    logit, parts = pem.logit(obstacles.salient), list[FloatArray]()
    for start in range(0, len(logit), CHUNK_ROWS):
        miss = np.exp(nodes.log_outcomes(logit[start : start + CHUNK_ROWS])[0])
        mean = miss @ weight
        moments = _on_end(miss, rho) @ weight, (miss**2) @ weight - mean**2, mean * (1.0 - mean)
        parts.append(np.stack(moments))
    on_end, between, whole = np.concatenate(parts, axis=1).mean(axis=1).tolist()
    return on_end, between / whole


def unsaid_of_positions(
    errors: PositionErrorModel | None, obstacles: Obstacles, table: Averages
) -> Iterator[str]:
    """Of position errors: tails, what of them lasts, other features, and other kinds of error."""
    if errors is None:
        yield "position errors: the model has none, none are written (--position-errors)"
        return
    for place, axis in enumerate(table.axes):
        name = axis.name.replace("_", "-")
        if axis.name == "speed":
            size = float(np.mean(axis.deviation))
            yield f"errors of speed are left out: standard deviation {size:.2g} m/s"
            continue
        own = errors.half_width(obstacles.salient)[:, place]
        binned = axis.half_width[table.bin_of(obstacles.distance_m)]
        apart = float(np.sqrt(np.mean((own / binned - 1.0) ** 2)))
        yield (
            f"{name} errors: their size depends on bearing and aspect too, "
            f"{apart:.0%} off their bin's (root mean square)"
        )
        yield from _tails(axis, name)
        if axis.memory.lasting_share:
            yield (
                f"{name} errors: a share of {axis.memory.lasting_share:.2g} lasts, which no memory "
                f"time says; that of {axis.tau_s:.2g} s is right {MATCHED_LAG_S:g} s apart: "
                f"correlations, and those written, {_lags(axis)}"
            )
    share = float(errors.correlation[0, 1])
    if share:
        yield f"range and cross-range errors of a frame have the correlation {share:.2g}, written 0"


def _tails(axis: AxisAverages, name: str) -> Iterator[str]:
    nu = axis.degrees_of_freedom
    if np.isinf(nu):
        return
    family = f"{name} errors: Student's t with {nu:.2g} degrees of freedom is written as a Gaussian"
    if nu <= LEAST_WITH_SD:
        yield f"{family} of equal central 68 %, for it has no standard deviation"
        return
    sd_factor = np.sqrt(nu / (nu - 2.0))
    within = float(stats.t.ppf(stats.norm.cdf(1.0), nu) / sd_factor)
    beyond = 2.0 * float(stats.t.sf(TAIL * sd_factor, nu))
    yield (
        f"{family} of equal standard deviation: 68 % of errors lie within {within:.2f} of that, of "
        f"those written within 1; {beyond:.2%} beyond {TAIL:g} of it, of those written "
        f"{2.0 * float(stats.norm.sf(TAIL)):.2%}"
    )


def _lags(axis: AxisAverages) -> str:
    """The model's correlations beside those that are written."""
    return ", ".join(
        f"{lag:g} s apart {float(axis.memory.correlation(lag)):.2f} "
        f"({float(persistence(lag, axis.tau_s)):.2f})"
        for lag in LAGS_S
    )
