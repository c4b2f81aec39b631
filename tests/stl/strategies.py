"""Random formulas, and rollouts that fit them."""

from functools import cache

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from pemviz.stl import formulas as fo

lawful = settings(
    max_examples=100, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)
NAMES = ("gap", "ego_speed", "x_1")
BOUNDS = {"gap": (-25.0, 25.0), "ego_speed": (0.0, 40.0), "x_1": (-3.0, 8.0)}

constants = st.one_of(
    st.integers(-25, 40).map(float),
    st.floats(-25.0, 40.0).map(lambda value: round(value, 3)),
).map(fo.Constant)
signals = st.sampled_from(NAMES).map(fo.Signal)


def _larger(parts):
    pair = st.tuples(parts, parts)
    few = st.lists(parts, min_size=2, max_size=3).map(tuple)
    return st.one_of(
        pair.map(lambda p: fo.Sum(*p)),
        pair.map(lambda p: fo.Difference(*p)),
        pair.map(lambda p: fo.Product(*p)),
        parts.map(lambda p: fo.Quotient(p, fo.Constant(-4.0))),
        parts.map(fo.Negative),
        parts.map(fo.Absolute),
        few.map(fo.Minimum),
        few.map(fo.Maximum),
    )


expressions = st.one_of(signals, signals, _larger(st.one_of(constants, signals)))
deep_expressions = st.recursive(st.one_of(constants, signals), _larger, max_leaves=8)
comparisons = st.sampled_from((">=", ">", "<=", "<"))
predicates = st.builds(fo.Predicate, expressions, comparisons, st.one_of(constants, expressions))
deep_predicates = st.builds(fo.Predicate, deep_expressions, comparisons, deep_expressions)


intervals = st.tuples(st.integers(0, 3), st.integers(0, 5)).map(lambda p: (p[0], p[0] + p[1]))


@cache  # a strategy is examined once, not again for every example
def formulas(depth=4, atoms=predicates, *, truth=True):
    """Formulas of at most ``depth`` operators on top of each other."""
    leaves = st.one_of(atoms, atoms, atoms, st.just(fo.Truth())) if truth else atoms
    if depth == 0:
        return leaves
    parts = st.deferred(lambda: formulas(depth - 1, atoms, truth=truth))
    few = st.lists(parts, min_size=2, max_size=3).map(tuple)
    timed = st.tuples(intervals, parts)
    return st.one_of(
        timed.map(lambda p: fo.Always(*p[0], p[1])),
        timed.map(lambda p: fo.Eventually(*p[0], p[1])),
        st.tuples(intervals, parts, parts).map(lambda p: fo.Until(*p[0], p[1], p[2])),
        few.map(fo.And),
        few.map(fo.Or),
        st.builds(fo.Implies, parts, parts),
        parts.map(fo.Not),
        leaves,
    )


def rollouts(seed, states, count=2, scale=1.0):
    """Signals [count, states] within BOUNDS; half of the values on a coarse grid (ties)."""
    rng = np.random.default_rng(seed)
    batch = {}
    for name, (low, high) in BOUNDS.items():
        free = rng.uniform(low, high, (count, states)) * scale
        coarse = np.clip(np.round(free), low, high)
        batch[name] = np.where(rng.random((count, states)) < 0.5, free, coarse)
    return batch


@st.composite
def formula_and_rollouts(draw, depth=4, *, truth=True, atoms=predicates, count=2):
    formula = draw(formulas(depth, atoms, truth=truth))
    states = formula.horizon_steps() + 1 + draw(st.integers(0, 3))
    seed = draw(st.integers(0, 2**32 - 1))
    scale = draw(st.sampled_from((1.0, 0.3, 0.02)))
    return formula, rollouts(seed, states, count, scale)


def row(batch, index):
    return {name: [float(v) for v in values[index]] for name, values in batch.items()}


whole_numbers = st.integers(-2, 2).map(float).map(fo.Constant)
tied_terms = st.one_of(
    signals,
    signals,
    whole_numbers,
    st.builds(fo.Difference, signals, signals),
    signals.map(fo.Absolute),
    st.lists(st.one_of(signals, whole_numbers), min_size=2, max_size=3).map(tuple).map(fo.Minimum),
)
tied_predicates = st.builds(
    fo.Predicate, tied_terms, comparisons, st.one_of(whole_numbers, signals)
)


def tied_rollouts(seed, states, count):
    """Signals [count, states] of few values, so that sides are often equal: halves and counts."""
    rng = np.random.default_rng(seed)
    return {
        "gap": rng.integers(-4, 5, (count, states)) / 2.0,
        "ego_speed": np.maximum(rng.integers(-3, 3, (count, states)), 0),
        "x_1": rng.integers(0, 2, (count, states)).astype(rng.choice([np.int8, np.bool_])),
    }


@st.composite
def formula_and_tied_rollouts(draw, depth=3, count=2):
    formula = draw(formulas(depth, tied_predicates))
    states = formula.horizon_steps() + 1 + draw(st.integers(0, 2))
    return formula, tied_rollouts(draw(st.integers(0, 2**32 - 1)), states, count)
