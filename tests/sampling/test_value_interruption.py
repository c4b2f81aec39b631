"""Value tables take seconds to build: they can be stopped, and nothing half-built is kept."""

import numpy as np
import pytest

from pemviz.proposals.zero_variance import ZeroVarianceProposal
from pemviz.sampling.problem import Problem
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.proposal import build_zero_variance_proposal
from pemviz.sampling.zero_variance.reference import exact_log_probability, reference
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_robustness,
    toy_unsafe,
    toy_violated,
)


class StopError(Exception):
    pass


class Pause:
    """Counts its calls, and raises at one of them."""

    def __init__(self, *, stop_at: int | None = None):
        self.calls = 0
        self._stop_at = stop_at

    def __call__(self):
        self.calls += 1
        if self.calls == self._stop_at:
            raise StopError


def problem_of(pem, pause):
    return Problem(
        simulator=SIMULATOR,
        pem=pem,
        robustness=toy_robustness,
        violated=toy_violated,
        unsafe=toy_unsafe,
        pause=pause,
    )


SIMULATOR = ToySimulator(initial_gap=5, states=20)


def build(pem, pause) -> ZeroVarianceProposal:
    method = ZeroVarianceSampling(twin=SIMULATOR, rollouts=20, seed=1)
    return method.init(problem_of(pem, pause), repetition=0).proposal


def content(proposal: ZeroVarianceProposal) -> list[np.ndarray]:
    sizes = range(len(proposal.coarse_cells))
    tables = [
        cells
        for layer in proposal.tables
        for cells in (layer.states, *(layer.coarse[size] for size in sizes))
    ]
    return [part for cells in tables for part in (cells.keys, cells.logit)]


def assert_same(found: ZeroVarianceProposal, expected: ZeroVarianceProposal):
    assert found.log_probability == expected.log_probability
    assert found.defensive == expected.defensive
    for one, other in zip(content(found), content(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_pause_that_raises_stops_the_build_wherever_it_is():
    """At every single call, from the first to the last; the next build is whole."""
    pem = ToyPem()
    whole = build_zero_variance_proposal(twin=SIMULATOR, pem=pem, unsafe=toy_unsafe)
    counting = Pause()
    assert_same(build(ToyPem(), counting), whole)
    # each of 19 steps has two moves, a merge, and two directions of the recursion
    assert counting.calls > 5 * 19
    for stop_at in range(1, counting.calls + 1):
        pem, pause = ToyPem(), Pause(stop_at=stop_at)  # a model of its own: nothing is kept of it
        with pytest.raises(StopError):
            build(pem, pause)
        assert pause.calls == stop_at
    again = Pause()
    assert_same(build(pem, again), whole)
    assert again.calls == counting.calls


def test_what_was_built_before_outlives_a_build_that_is_stopped():
    first = ToyPem(at_zero=2.0)
    kept = build(first, Pause())
    with pytest.raises(StopError):
        build(ToyPem(at_zero=1.0), Pause(stop_at=9))
    unused = Pause()
    assert_same(build(first, unused), kept)
    assert unused.calls == 0


@pytest.mark.parametrize("ask", [reference, exact_log_probability])
def test_the_reference_stops_too(ask):
    counting = Pause()
    ask(problem_of(ToyPem(), counting), twin=SIMULATOR)
    assert counting.calls > 3 * 19
    with pytest.raises(StopError):
        ask(problem_of(ToyPem(), Pause(stop_at=counting.calls)), twin=SIMULATOR)
