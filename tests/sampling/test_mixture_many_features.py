"""Proposals that look at many features, where what follows decisive misses no longer matters."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pemviz.proposals.defensive import LARGEST_SHARE
from pemviz.sampling.auto.method import AutoSampling
from pemviz.sampling.estimates.estimators import ADAPTATION, MANY_FEATURES_ADAPTATION
from pemviz.sampling.mixture.fit import WIDEST
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.problem import Problem
from pemviz.types import Signal, StateBatch
from tests.toy import ConstantPem, stepped_through

STEPS, MISS = 60, 0.05


@dataclass(frozen=True)
class LateFailure:
    """So many misses in a row decide; it fails some steps later, whatever is detected until then.

    Attributes:
        needed: How many.
        later: Steps from the last of these to the failure.
        phases: Signals beside, that tell nothing.
    """

    needed: int = 4
    later: int = 4
    phases: int = 3
    states: int = STEPS + 1
    name: str = "late-failure"
    dt_s: float = 1.0

    @property
    def signals(self):
        far = float(self.needed + self.later)
        phases = [Signal(f"phase{k}", f"phase{k}", "", -1.0, 1.0) for k in range(self.phases)]
        return (Signal("left", "left", "", 0.0, far), *phases)

    def initial(self, *, count):
        return self._states(np.zeros((), dtype=np.int64), np.full(count, self.needed + self.later))

    def step(self, states, detected):
        left = states.memory["left"]
        doomed = left <= self.later
        nearer = np.maximum(left - 1, 0)
        again = np.where(detected, self.needed + self.later, nearer)
        return self._states(states.step + 1, np.where(doomed, nearer, again))

    def _states(self, step, left):
        phases = {
            f"phase{k}": np.full(left.shape, np.sin(step * (0.3 + 0.2 * k)))
            for k in range(self.phases)
        }
        signals = {"left": left * 1.0, **phases}
        return StateBatch(step=step, signals=signals, memory={"left": left})

    def salient(self, signals):
        return signals["left"][..., None]


def probability(system):
    """That so many misses follow each other early enough, by how many do so far."""
    row = np.zeros(system.needed)
    row[0] = 1.0
    for _ in range(system.states - 1 - system.later):
        row = np.concatenate([[row.sum() * (1.0 - MISS)], row[:-1] * MISS])
    return 1.0 - float(row.sum())


def problem_of(system):
    return Problem(
        simulator=system,
        pem=ConstantPem(MISS),
        robustness=lambda signals: signals["left"].min(axis=1) - 0.5,
        violated=None,
        unsafe=lambda states: states.signals["left"] < 0.5,
    )


def method(seed=3, **changed):
    return replace(
        MixtureSampling(learning_stages=4, rollouts=60, final_rollouts=60, seed=seed), **changed
    )


def fits_after(system, *, stages=3):
    """What the stage after so many samples from."""
    problem, own = problem_of(system), method()
    state = own.init(problem, repetition=0)
    for _ in range(stages):
        state, _ = own.step(problem, state)
    return state.fits


def test_half_of_the_main_proposals_rollouts_take_much_from_the_error_model():
    """The share is two of the steps that a failure takes, which misses in a row are."""
    main, wide, *others = fits_after(LateFailure(needed=4))
    assert main.defensive is None
    assert wide.share == main.share
    assert np.array_equal(wide.coefficients, main.coefficients)
    assert 3.0 < main.departure < 7.0
    assert wide.defensive == min(WIDEST, 2.0 / wide.departure)
    assert others
    assert all(fit.defensive is not None for fit in others)


def test_a_failure_of_many_steps_leaves_little_to_the_error_model():
    _, wide, *_ = fits_after(LateFailure(needed=20, later=1))
    assert wide.departure > 15.0
    assert wide.defensive == pytest.approx(max(2.0 / wide.departure, LARGEST_SHARE))


def test_few_features_have_no_wide_proposal_and_no_wider_interval():
    few, many = LateFailure(phases=1), LateFailure()
    assert all(fit.defensive is None for fit in fits_after(few))
    factors = []
    for system in (few, many):
        state, _ = stepped_through(method(), problem_of(system))
        factors.append(method().kept_columns(state)["error_factor"].max())
    assert factors == [ADAPTATION, MANY_FEATURES_ADAPTATION]


def test_auto_learns_from_more_where_features_are_many():
    """However precise the first answer."""
    rollouts = {}
    for phases in (1, 3):
        system = LateFailure(phases=phases)
        own = AutoSampling(
            mixture=method(), first=60, most_looked_at=60, most_plain=60, most=4_000, precision=5.0
        )
        state, _ = stepped_through(own, problem_of(system))
        rollouts[phases] = state.proposing.method.rollouts
    assert rollouts[1] == 60
    assert rollouts[3] >= 120
