"""Rollouts drawn from fitted proposals as plain loops, compiled where numba is there.

The scenario's arithmetic is :mod:`pemviz.simulators.braking.loops`, in the order of numpy, so that
equal outcomes lead to equal states to the last bit; so is whatever else decides something: whether
the scenario reacts, what is tracked, what violates. Logits agree within 1e-12 of their size: where
a draw is too close to the probability of a miss for that, the rollout is doubtful, and numpy's.

Functions that look at arrays take a block of rollouts through a part of one step, since handing
arrays to a function takes as long as ten steps. Imported when it is time to compile: see
:mod:`pemviz.sampling.fitted.drawing`.
"""

import math

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.compiling import inlined, translated
from pemviz.proposals.offset_logistic import LARGEST_SHIFT, STANDARD_RANGE
from pemviz.proposals.pilots import CEILING_LOGIT
from pemviz.sampling.fitted.numbers import (
    ALONG_GAP,
    DIVIDED,
    Block,
    Chained,
    Fitted,
    Pieces,
    Rules,
    Scene,
    Step,
    Tracking,
    Written,
)
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.loops import Numbers

USED_AS_OF = "13356106328fe9d0"
"""Of what other files give: what numba keeps of this one is made anew when that changes."""
BLOCK = 128
"""Rollouts that are taken through all steps together: their draws fit the processor's cache."""
DOUBT = 1e-9
"""A draw this close to the probability of a miss decides nothing."""
FARTHEST_LOGIT = 600.0
"""Beyond, odds come near what is no double any more: such rollouts are numpy's too."""

moved = inlined(loops.moved)
Track = tuple[int, int, bool, float]
"""Window, misses, confirmed and position [m]."""


@inlined
def remembered(own: float, before: float, rho: float, log_rest: float) -> float:
    """The error model's logit of 'detected' after an outcome ``before``, of that without.

    With odds a = e^own of a detection they become (1 - rho) a / (1 + rho a) after a miss, and
    (a + rho) / (1 - rho) after a hit.
    """
    if before == 0.0 or rho == 0.0:
        return own
    small = math.exp(-abs(own))
    if (own > 0.0) == (before > 0.0):
        changed = math.log1p(rho * small)
        return own + changed - log_rest if before > 0.0 else own - changed + log_rest
    return math.log(small + rho) - log_rest if before > 0.0 else log_rest - math.log(small + rho)


@inlined
def counted(window: int, outcomes: int) -> int:
    """Hits among the latest ``outcomes`` of a window."""
    hits = 0
    for place in range(outcomes):
        hits += (window >> place) & 1
    return hits


@inlined
def tracked(track: Track, detected: bool, gap: float, tracking: Tracking) -> Track:
    """A track after one more outcome."""
    window, misses, before, position = track
    window = (window << 1) | (1 if detected else 0)
    misses = misses + 1 if before and not detected else 0
    if before:
        confirmed = misses <= tracking.coast_steps
    else:
        confirmed = counted(window, tracking.window) >= tracking.hits
    window = 0 if confirmed or before else window & ((1 << (tracking.window - 1)) - 1)
    position = gap if detected else position
    return window, misses if confirmed else 0, confirmed, position if confirmed else 0.0


@inlined
def since_hit(track: Track, tracking: Tracking) -> int:
    """Misses in a row; without a track as many as forget one."""
    window, misses, confirmed, _ = track
    if confirmed:
        return misses
    if window == 0:
        return tracking.none_since
    since = 0
    while (window >> since) & 1 == 0:
        since += 1
    return since


@inlined
def by_fit(own: float, raised: float, share: float) -> float:
    """Logit of 'detected' under a fit, mixed with the error model."""
    model = math.exp(own)
    model_miss = 1.0 / (1.0 + model)
    fitted = math.exp(own - raised)
    miss = 1.0 / (1.0 + fitted)
    hit = (1.0 - share) * (fitted * miss) + share * (model * model_miss)
    return math.log(hit / ((1.0 - share) * miss + share * model_miss))


@inlined
def by_pilot(own: float, strength: float) -> float:
    """Logit of 'detected' under a pilot."""
    if strength > 0.0:
        return own - strength * max(CEILING_LOGIT + own, 0.0)
    return own - strength * max(CEILING_LOGIT - own, 0.0)


@translated
def copy(values: FloatArray | BoolArray, target: FloatArray | BoolArray) -> None:
    """Write ``values [n]`` to ``target``; a loop is compiled sooner than a slice's assignment."""
    for n in range(values.size):
        target[n] = values[n]


@translated
def along(pieces: Pieces, numbers: FloatArray, values: FloatArray) -> None:
    """Write the function's values at ``numbers [n]``."""
    edge, value, slope, begins = pieces.edge, pieces.value, pieces.slope, pieces.first
    low, cells_per_unit, last_cell = edge[0], pieces.cells_per_unit, begins.size - 1.0
    for n in range(numbers.size):
        cell = min(max((numbers[n] - low) * cells_per_unit, 0.0), last_cell)
        piece = begins[int(cell)]
        while piece + 2 < edge.size and edge[piece + 1] < numbers[n]:
            piece += 1
        values[n] = slope[piece] * (numbers[n] - edge[piece]) + value[piece]


@translated
def under_pem(model: Chained, gap: FloatArray, before: FloatArray, own: FloatArray) -> None:
    """Write the error model's logits at a step of a block."""
    along(model.own, gap, own)
    if model.remembers:
        for n in range(own.size):
            own[n] = remembered(own[n], before[n], model.rho, model.log_rest)


@translated
def where_acting(state: Step, fit: Fitted, numbers: Numbers, tracking: Tracking) -> None:
    """Write where pilots and fits may leave the error model."""
    gap, ego, violated, acts = state.gap, state.ego, state.violated, state.acts
    for n in range(gap.size):
        near = gap[n]
        if tracking.tracks:
            closing = ego[n] - state.lead
            near -= max(closing * tracking.known_s + tracking.known_m, 0.0)
        acts[n] = fit.everywhere or near < numbers.close
    for n in range(violated.size):
        acts[n] = acts[n] and not violated[n]


@translated
def under_pilots(state: Step, fit: Fitted, first: int) -> bool:
    """Write pilots' logits at a step of the block that begins with rollout ``first``.

    Whether fits act at all is what comes back.
    """
    others = False
    own, logit, acts = state.own, state.logit, state.acts
    piloted, begin, stop, strength = fit.piloted, fit.begin, fit.stop, fit.strength
    for n in range(own.size):
        row = first + n
        within = begin[row] <= state.step < stop[row]
        if piloted[row] and acts[n] and within:
            logit[n] = by_pilot(own[n], strength[row])
        else:
            logit[n] = own[n]
        acts[n] = acts[n] and not piloted[row]
        others |= acts[n]
    return others


@translated
def look_at(state: Step, fit: Fitted, numbers: Numbers, tracking: Tracking, block: Block) -> None:
    """Write what fits look at: gap, closing speed, time; tracks; the outcome before."""
    gap, ego, before, seen, acts = state.gap, state.ego, state.before, block.seen, state.acts
    window, misses, confirmed = state.window, state.misses, state.confirmed
    for n in range(gap.size):
        seen[0, n], seen[1, n], seen[2, n] = gap[n], ego[n] - state.lead, state.step * numbers.dt
        if tracking.tracks and acts[n]:
            track = window[n], misses[n], confirmed[n], 0.0
            hits = tracking.hits if confirmed[n] else counted(window[n], tracking.window)
            seen[3, n], seen[4, n] = hits, since_hit(track, tracking)
    if before.size:
        last = seen.shape[0] - 1
        for n in range(gap.size):
            seen[last, n] = before[n]
    for feature in range(seen.shape[0]):
        mean, spread = fit.mean[feature], fit.spread[feature]
        for n in range(gap.size):
            standard = (seen[feature, n] - mean) / spread
            seen[feature, n] = min(max(standard, -STANDARD_RANGE), STANDARD_RANGE)


@translated
def under_fits(state: Step, fit: Fitted, block: Block) -> None:
    """Write fits' logits at a step of a block."""
    own, logit, acts = state.own, state.logit, state.acts
    seen, monomial, raised, coefficients = block.seen, block.monomial, block.raised, block.by_row
    for n in range(own.size):
        monomial[0, n], raised[n] = 1.0, coefficients[0, n]
    for column in range(1, monomial.shape[0]):
        lower, feature = fit.lower[column - 1], fit.feature[column - 1]
        for n in range(own.size):
            product = monomial[lower, n] * seen[feature, n]
            monomial[column, n] = product
            raised[n] += coefficients[column, n] * product
    for n in range(own.size):
        if acts[n]:
            shift = min(max(raised[n], -LARGEST_SHIFT), LARGEST_SHIFT)
            logit[n] = by_fit(own[n], shift, fit.share)


@translated
def decided(state: Step, draws: FloatArray, doubtful: BoolArray) -> None:
    """Write a step's outcomes, and whose draw was too close to call."""
    logit, own, detected = state.logit, state.own, state.detected
    for n in range(logit.size):
        far = max(abs(own[n]), abs(logit[n])) > FARTHEST_LOGIT
        miss = 1.0 / (1.0 + math.exp(min(logit[n], FARTHEST_LOGIT)))
        detected[n] = draws[n] >= miss
        if far or abs(draws[n] - miss) < DOUBT:
            doubtful[n] = True


@translated
def moved_on(state: Step, after: Step, numbers: Numbers, tracking: Tracking) -> None:
    """Write the states after a step's outcomes."""
    gap, ego, held, detected = state.gap, state.ego, state.held, state.detected
    for n in range(gap.size):
        present, told = detected[n], gap[n]
        if tracking.tracks:
            track = state.window[n], state.misses[n], state.confirmed[n], state.position[n]
            track = tracked(track, detected[n], gap[n], tracking)
            after.window[n], after.misses[n], after.confirmed[n], after.position[n] = track
            present, told = after.confirmed[n], after.position[n]
        one = moved((gap[n], ego[n], held[n]), state.lead, present, told, numbers)
        after.gap[n], after.ego[n], after.held[n] = one
    for n in range(after.before.size):
        after.before[n] = 1.0 if detected[n] else -1.0


@translated
def latch(state: Step, rules: Rules) -> None:
    """Add which states violate to what is written of those that have before."""
    violated = state.violated
    for place in range(rules.first.size):
        bound, sign = rules.bound[place], 1.0 if rules.is_lower[place] else -1.0
        if rules.first[place] <= state.step <= rules.last[place]:
            values = state.gap if rules.signal[place] == 0 else state.ego
            for n in range(violated.size):
                value = state.lead if rules.signal[place] == 2 else values[n]
                violated[n] |= sign * value < sign * bound


@translated
def step_of(written: Written, acts: BoolArray, step: int, first: int, last: int) -> Step:
    """A step of a block of rollouts."""
    outcome = min(step, written.detected.shape[0] - 1)  # the last state has none
    return Step(
        step=step,
        lead=written.lead_mps[step],
        gap=written.gap_m[step, first:last],
        ego=written.ego_mps[step, first:last],
        held=written.integral_m[step, first:last],
        before=written.outcome[step, first:last],
        window=written.window[step, first:last],
        misses=written.misses[step, first:last],
        confirmed=written.confirmed[step, first:last],
        position=written.position_m[step, first:last],
        violated=written.violated[step, first:last],
        acts=acts[: last - first],
        own=written.under_pem[outcome, first:last],
        logit=written.under_proposal[outcome, first:last],
        detected=written.detected[outcome, first:last],
    )


@translated
def propose(state: Step, fit: Fitted, scene: Scene, first: int, block: Block) -> None:
    """Write the logits of what outcomes are drawn from, of the block that begins with ``first``."""
    if fit.kind == ALONG_GAP:
        along(fit.network, state.gap, state.logit)
        return
    if fit.kind != DIVIDED:
        copy(state.own, state.logit)
        return
    where_acting(state, fit, scene.numbers, scene.tracking)
    if under_pilots(state, fit, first) and fit.lower.size:
        look_at(state, fit, scene.numbers, scene.tracking, block)
        under_fits(state, fit, block)


@translated
def block_of(fit: Fitted) -> Block:
    """Room for what is known of a block's rollouts at one step."""
    features, monomials = fit.mean.size, fit.coefficients.shape[1]
    return Block(
        acts=np.empty(BLOCK, dtype=np.bool_),
        seen=np.zeros((features, BLOCK)),
        monomial=np.empty((monomials, BLOCK)),
        raised=np.empty(BLOCK),
        by_row=np.empty((monomials, BLOCK)),
    )


@translated
def turn(rows: FloatArray, columns: FloatArray) -> None:
    """Write ``rows [n, B]`` to ``columns [B, n or more]``."""
    for n in range(rows.shape[0]):
        for place in range(rows.shape[1]):
            columns[place, n] = rows[n, place]


@translated
def draw(
    written: Written,
    model: Chained,
    fit: Fitted,
    scene: Scene,
    uniforms: FloatArray,
) -> None:
    """Take rollouts from their first states through all steps.

    Args:
        written: N rollouts, of which the first states are there.
        model: The error model's numbers.
        fit: The proposal's.
        scene: The scenario's, the tracker's, the specification's.
        uniforms: Draws ``[N, T-1]``.
    """
    steps, count = written.detected.shape
    numbers, tracking, rules = scene.numbers, scene.tracking, scene.rules
    block = block_of(fit)
    for first in range(0, count, BLOCK):
        last = min(first + BLOCK, count)
        turn(fit.coefficients[first:last], block.by_row)
        doubtful = written.doubtful[first:last]
        state = step_of(written, block.acts, 0, first, last)
        latch(state, rules)
        for step in range(steps):
            under_pem(model, state.gap, state.before, state.own)
            propose(state, fit, scene, first, block)
            decided(state, uniforms[first:last, step], doubtful)
            after = step_of(written, block.acts, step + 1, first, last)
            moved_on(state, after, numbers, tracking)
            copy(state.violated, after.violated)
            latch(after, rules)
            state = after
