"""The states that a scenario can be in, step by step, and their probability of violation.

Perception decides one bit a step, and the dynamics are deterministic: the scenario lives on
a graph. Chains that lead to the same state merge, states from which nothing can go wrong any
more are left out, and what remains is often small enough to hold in full. Probabilities of
violation then follow by one backward recursion, exact up to rounding.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.twisted_cells import cell_keys
from pemviz.types import Simulator, StateBatch, outcome_log_likelihood

Unsafe = Callable[[StateBatch], BoolArray]
"""States ``[N]`` to whether being in them violates the specification ``[N]``."""

Pause = Callable[[], None]
"""Called now and then during long work; may raise to stop it."""

SAFE_NODE = -1
UNSAFE_NODE = -2
MERGE_DISTANCE = 1e-6
FIRST_COARSE_SHARE = 3e-4
COARSENING = 1.5
COARSE_LAYER_SHARE = 0.25
LIVENESS_CHECKS = 100


@dataclass(frozen=True)
class Layer:
    """The states of one step that are neither safe for good nor unsafe already.

    Attributes:
        states: Arrays ``[n]``.
        pem_logit: Logit of 'detected' under the error model, ``[n]``.
        after_miss: Index ``[n]`` in the next layer, or SAFE_NODE or UNSAFE_NODE.
        after_hit: The same after a detection.
        exact: Whether only states closer than MERGE_DISTANCE were taken for one.
    """

    states: StateBatch
    pem_logit: FloatArray
    after_miss: IntArray
    after_hit: IntArray
    exact: bool

    @property
    def count(self) -> int:
        """Number of states n."""
        return int(self.pem_logit.size)


@dataclass(frozen=True)
class Values:
    """Log probabilities over the layers [nats].

    Attributes:
        log_value: By layer ``[n]``, the log probability of violation from each state.
        log_reached: By layer ``[n]``, the log probability of coming through each state.
        proposal_logit: By layer ``[n]``, logit of 'detected' given that the rollout violates.
        log_probability: Log of the failure probability; -inf where it is 0.
    """

    log_value: tuple[FloatArray, ...]
    log_reached: tuple[FloatArray, ...]
    proposal_logit: tuple[FloatArray, ...]
    log_probability: float


def no_pause() -> None:
    """Go on."""


def explore(
    *,
    twin: Simulator,
    pem: Pem,
    unsafe: Unsafe,
    largest_layer: int,
    pause: Pause = no_pause,
) -> tuple[Layer, ...]:
    """All states that matter, by step; empty where the outcome is settled from the start.

    A state counts as safe for good when neither missing all the time nor detecting all the
    time leads from it to an unsafe state: exact where a miss never helps, as in the braking
    scenario; elsewhere a sampler that uses the result must not rely on it (ours does not).

    Args:
        twin: A scenario whose ``step`` is cheap for many states.
        pem: The error model.
        unsafe: What violates the specification.
        largest_layer: Above so many states a step, neighbouring states are taken for one.
        pause: Called several times a step.
    """
    steps = twin.states - 1
    stride = max(1, steps // LIVENESS_CHECKS)
    walk = _Walk(twin, unsafe, _Merger(largest_layer, pause), pause)
    layers: list[Layer] = []
    states = twin.initial(count=1)
    if unsafe(states)[0] or not walk.alive(states)[0]:
        return ()
    for step in range(steps):
        logit = pem.logit(twin.salient(states.signals))
        exact = walk.merger.exact
        pause()
        merged, node = walk.children(states)
        if step + 1 == steps:
            alive = np.zeros(merged.shape[0], dtype=np.bool_)
        elif step % stride == 0:
            alive = walk.alive(merged)
        else:
            alive = np.ones(merged.shape[0], dtype=np.bool_)
        renumbered = np.where(alive, np.cumsum(alive) - 1, SAFE_NODE)
        node = np.where(node >= 0, renumbered[np.maximum(node, 0)], node) if alive.size else node
        miss, hit = np.split(node, 2)
        layers.append(
            Layer(states=states, pem_logit=logit, after_miss=miss, after_hit=hit, exact=exact)
        )
        if not alive.any():
            break
        states = merged.take(np.flatnonzero(alive))
    return tuple(layers)


def solve(layers: Sequence[Layer], *, pause: Pause = no_pause) -> Values:
    """Backward for the probability of violation, forward for that of being reached.

    ``pause`` is called once a layer and direction.
    """
    log_value: list[FloatArray] = []
    proposal_logit: list[FloatArray] = []
    following = np.empty(0)
    for layer in reversed(layers):
        pause()
        miss, hit = _outcome_values(layer, following)
        following = np.logaddexp(miss, hit)
        log_value.insert(0, following)
        proposal_logit.insert(0, _difference(hit, miss))
    log_reached = [np.zeros(1)] if layers else []
    for layer, after in itertools.pairwise(layers):
        pause()
        log_reached.append(_reached(layer, log_reached[-1], after.count))
    return Values(
        log_value=tuple(log_value),
        log_reached=tuple(log_reached),
        proposal_logit=tuple(proposal_logit),
        log_probability=float(log_value[0][0]) if layers else -np.inf,
    )


def state_names(states: StateBatch) -> tuple[str, ...]:
    """Names of all signals and of the controller's memory, in the order keys use."""
    return (*sorted(states.signals), *sorted(states.memory))


def state_columns(states: StateBatch) -> list[FloatArray]:
    """Signals and memory in the order of :func:`state_names`."""
    return [
        *(states.signals[name] for name in sorted(states.signals)),
        *(np.asarray(states.memory[name], dtype=np.float64) for name in sorted(states.memory)),
    ]


def _outcome_values(layer: Layer, following: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log of outcome probability times value afterwards, for a miss and a hit, ``[n]``."""
    ends = np.concatenate([following, [0.0, -np.inf]])  # indices -2 and -1
    miss = outcome_log_likelihood(layer.pem_logit, np.zeros(layer.count, dtype=np.bool_))
    hit = outcome_log_likelihood(layer.pem_logit, np.ones(layer.count, dtype=np.bool_))
    return miss + ends[layer.after_miss], hit + ends[layer.after_hit]


def _difference(hit: FloatArray, miss: FloatArray) -> FloatArray:
    """Hit - miss, 0 where both are -inf."""
    both = np.isneginf(hit) & np.isneginf(miss)
    return np.where(both, 0.0, np.where(both, 0.0, hit) - np.where(both, 0.0, miss))


def _reached(layer: Layer, log_reached: FloatArray, count: int) -> FloatArray:
    arriving = np.concatenate(
        [
            log_reached + outcome_log_likelihood(layer.pem_logit, np.full(layer.count, hit))
            for hit in (False, True)
        ]
    )
    node = np.concatenate([layer.after_miss, layer.after_hit])
    kept = node >= 0
    return log_sum_by(node[kept], arriving[kept], count)


def log_sum_by(group: IntArray, log_values: FloatArray, count: int) -> FloatArray:
    """Log of the sums of exp of ``log_values [M]`` in each of ``count`` groups."""
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, group, log_values)
    shift = np.where(np.isfinite(largest), largest, 0.0)
    total = np.bincount(group, weights=np.exp(log_values - shift[group]), minlength=count)
    with np.errstate(divide="ignore"):  # log 0 is -inf: nothing arrives there
        return np.log(total) + shift


@dataclass(frozen=True)
class _Walk:
    """Steps from many states at once.

    Attributes:
        twin: What steps them.
        unsafe: What violates the specification.
        merger: Takes equal states for one.
        pause: Called after every step of the twin.
    """

    twin: Simulator
    unsafe: Unsafe
    merger: "_Merger"
    pause: Pause

    def alive(self, states: StateBatch) -> BoolArray:
        """Whether missing or detecting all the time leads from states ``[n]`` to an unsafe one."""
        alive = np.zeros(states.shape[0], dtype=np.bool_)
        for hit in (False, True):
            open_ = np.flatnonzero(~alive)
            current = states.take(open_)
            for _ in range(int(states.step), self.twin.states - 1):
                if open_.size == 0:
                    break
                current = self._after(current, hit=hit)
                bad = self.unsafe(current)
                if bad.any():
                    alive[open_[bad]] = True
                    current, open_ = current.take(np.flatnonzero(~bad)), open_[~bad]
        return alive

    def children(self, states: StateBatch) -> tuple[StateBatch, IntArray]:
        """Distinct states after states ``[n]``; where a miss, then a hit leads ``[2n]``."""
        count = states.shape[0]
        both = StateBatch.concatenate([self._after(states, hit=hit) for hit in (False, True)])
        open_ = np.flatnonzero(~self.unsafe(both))
        merged, index = self.merger.merge(both.take(open_))
        node = np.full(2 * count, UNSAFE_NODE, dtype=np.int64)
        node[open_] = index
        return merged, node

    def _after(self, states: StateBatch, *, hit: bool) -> StateBatch:
        result = self.twin.step(states, np.full(states.shape[0], hit))
        self.pause()
        return result


class _Merger:
    """Takes equal states for one, and neighbours too where there are too many.

    Cells that were wide enough for one step are the first to be tried for the next.
    """

    def __init__(self, largest: int, pause: Pause) -> None:
        self._largest = largest
        self._pause = pause
        self._share = FIRST_COARSE_SHARE
        self.exact = True

    def merge(self, states: StateBatch) -> tuple[StateBatch, IntArray]:
        """Representatives of states ``[n]``, and the index of each state's."""
        columns = state_columns(states)
        self._pause()
        first, index = _representatives(cell_keys(columns, [MERGE_DISTANCE] * len(columns)))
        self._pause()
        self.exact = first.size <= self._largest
        if self.exact:
            return states.take(first), index
        spans = [float(np.ptp(column)) for column in columns]
        self._share /= COARSENING
        while first.size > self._largest * COARSE_LAYER_SHARE and self._share < 1.0:
            self._pause()
            self._share *= COARSENING
            cells = [max(span * self._share, MERGE_DISTANCE) for span in spans]
            first, index = _representatives(cell_keys(columns, cells))
        return states.take(first), index


def _representatives(keys: IntArray) -> tuple[IntArray, IntArray]:
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    return first.astype(np.int64), index.astype(np.int64)
