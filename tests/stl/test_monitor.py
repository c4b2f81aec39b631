"""The monitor against the verdict on whole rollouts."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pemviz import stl
from pemviz.stl.monitor import FormulaMonitor

from .strategies import formula_and_rollouts, rollouts

lawful = settings(
    max_examples=60, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)


def watch(formula, batch):
    """Whether each prefix violates for sure, [N, T]."""
    monitor = FormulaMonitor(formula)
    count, states = next(iter(batch.values())).shape
    known = monitor.start(count=count)
    found = []
    for step in range(states):
        now = {name: values[:, step] for name, values in batch.items()}
        known = monitor.advance(known, step=step, signals=now)
        found.append(monitor.violated(known))
    return np.stack(found, axis=1)


@given(formula_and_rollouts(count=5))
@lawful
def test_after_the_last_state_it_is_the_verdict(case):
    formula, batch = case
    np.testing.assert_array_equal(watch(formula, batch)[:, -1], stl.violated(formula, batch))


@given(formula_and_rollouts(depth=3, count=3), st.integers(0, 2**32 - 1))
@lawful
def test_what_it_calls_violated_no_continuation_mends(case, seed):
    formula, batch = case
    found = watch(formula, batch)
    count, states = found.shape
    assert (found[:, 1:] >= found[:, :-1]).all()
    for step in range(0, states - 1, 3):
        other = rollouts(seed + step, states, count)
        mixed = {
            name: np.where(np.arange(states) <= step, values, other[name])
            for name, values in batch.items()
        }
        assert stl.violated(formula, mixed)[found[:, step]].all()


def first_violation(text, gaps):
    formula = stl.parse(text, signals=["gap"])
    found = watch(formula, {"gap": np.array([gaps], dtype=float)})[0]
    return int(np.argmax(found)) if found.any() else None


@pytest.mark.parametrize(
    ("text", "gaps", "step"),
    [
        ("always[0,4] (gap >= 2)", [5, 3, 1, 5, 5], 2),
        ("eventually[0,2] (gap >= 2)", [0, 1, 0, 5], 2),
        ("eventually[1,2] (gap >= 2)", [5, 1, 2], None),
        # asked at step 1, when the gap falls below 3; nothing above it up to step 3
        ("always[0,3] (gap < 3 -> eventually[0,2] (gap >= 3))", [4, 2, 1, 2, 5, 5], 3),
        ("(gap >= 1) until[0,4] (gap >= 8)", [4, 3, 0, 9, 9], 2),
        ("not (eventually[0,3] (gap < 0))", [4, -1, 5, 5], 1),
        ("always[0,2] (gap >= 2) or eventually[2,3] (gap >= 8)", [1, 9, 9, 1], None),
        ("always[0,2] (gap >= 2) or eventually[2,3] (gap >= 8)", [1, 9, 7, 7], 3),
    ],
)
def test_a_violation_is_known_as_soon_as_nothing_can_mend_it(text, gaps, step):
    assert first_violation(text, gaps) == step


def test_what_is_known_is_never_changed():
    """A rollout may be continued twice from the same state."""
    monitor = FormulaMonitor(stl.parse("always[0,3] (gap >= 2)", signals=["gap"]))
    start = monitor.start(count=1)
    bad = monitor.advance(start, step=0, signals={"gap": np.array([0.0])})
    good = monitor.advance(start, step=0, signals={"gap": np.array([9.0])})
    assert monitor.violated(bad)[0]
    assert not monitor.violated(good)[0]
    assert not monitor.violated(start)[0]
