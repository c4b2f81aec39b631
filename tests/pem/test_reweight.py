"""Re-weighting rollouts over models, on a chain small enough to be summed up by hand."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest

from pemviz.pem import PemError, compare_pems, load_ensemble, pem_interval, reweight
from tests.pem.helpers import braking_rows

STEPS = 3
GAPS = (12.0, 8.0, 4.0)


@dataclass(frozen=True)
class FixedPem:
    """Detects with the probability given for each distance."""

    p_detected: tuple[float, ...]
    name: str = "fixed"
    digest: str = ""
    data: str = ""
    licence: str = ""

    def logit(self, salient):
        gap_m = np.asarray(salient)[..., 9, None] - 2.5
        index = np.argmin(np.abs(gap_m - np.array(GAPS)), axis=-1)
        p = np.asarray(self.p_detected)[index]
        return np.log(p) - np.log1p(-p)


def all_chains():
    """Every chain of three outcomes, sampled by a proposal that gives each the same chance."""
    detected = np.array(list(product([False, True], repeat=STEPS)))
    salient = np.broadcast_to(braking_rows(GAPS), (len(detected), STEPS, 11))
    log_q = np.full(detected.shape, np.log(0.5))
    violated = detected.sum(axis=1) <= 1
    return {"detected": detected, "salient": salient, "log_q": log_q, "violated": violated}


def exact(p):
    """P(at most one detection)."""
    total = 0.0
    for chain in product([0, 1], repeat=STEPS):
        if sum(chain) <= 1:
            total += np.prod([p[t] if hit else 1 - p[t] for t, hit in enumerate(chain)])
    return total


MODELS = [(0.9, 0.8, 0.7), (0.5, 0.5, 0.5), (0.999, 0.99, 0.9999)]
MEMBERS = [FixedPem(p) for p in MODELS]


def test_every_model_gets_its_exact_probability_from_one_set_of_rollouts():
    estimates = reweight(**all_chains(), members=MEMBERS)
    np.testing.assert_allclose(np.exp(estimates.log_mu), [exact(p) for p in MODELS], rtol=1e-12)


def test_log_q_of_whole_rollouts_gives_the_same():
    rollouts = all_chains()
    whole = {**rollouts, "log_q": rollouts["log_q"].sum(axis=1)}
    np.testing.assert_allclose(
        reweight(**whole, members=MEMBERS).log_mu,
        reweight(**rollouts, members=MEMBERS).log_mu,
        rtol=1e-14,
    )


def test_the_violating_rollouts_alone_suffice_with_the_number_drawn():
    rollouts = all_chains()
    failing = {key: array[rollouts["violated"]] for key, array in rollouts.items()}
    whole, part = (
        reweight(**rollouts, members=MEMBERS),
        reweight(**failing, members=MEMBERS, rollouts=8),
    )
    np.testing.assert_array_equal(part.log_mu, whole.log_mu)
    np.testing.assert_array_equal(part.relative_std_error, whole.relative_std_error)
    pair = {"old": MEMBERS[0], "new": MEMBERS[1]}
    assert compare_pems(**failing, **pair, rollouts=8) == compare_pems(**rollouts, **pair)
    with pytest.raises(PemError, match="rollouts is 3, but 8 are given"):
        reweight(**rollouts, members=MEMBERS, rollouts=3)


def test_the_interval_lies_between_the_members_and_knows_when_few_rollouts_carry_it():
    estimates = reweight(**all_chains(), members=MEMBERS)
    interval = pem_interval(estimates, few_effective=10.0)
    log10_mu = np.log10([exact(p) for p in MODELS])
    assert interval.log10_median == pytest.approx(np.median(log10_mu))
    assert log10_mu.min() < interval.log10_low < interval.log10_high < log10_mu.max()
    assert interval.members == 3
    assert any("fewer than 10 effective" in text for text in interval.warnings)
    assert any("3 refits are few" in text for text in interval.warnings)


def test_relative_standard_error_is_that_of_the_mean():
    rollouts = all_chains()
    estimates = reweight(**rollouts, members=[MEMBERS[0]])
    p = np.asarray(MODELS[0])
    chance = np.where(rollouts["detected"], p, 1 - p).prod(axis=1)
    weight = np.where(rollouts["violated"], chance * 8, 0.0)
    expected = np.std(weight, ddof=1) / np.sqrt(8) / weight.mean()
    assert estimates.relative_std_error[0] == pytest.approx(expected, rel=1e-12)


def test_the_ratio_of_a_model_to_itself_is_one_without_doubt():
    ratio = compare_pems(**all_chains(), old=MEMBERS[0], new=MEMBERS[0])
    assert (ratio.log10_ratio, ratio.log10_low, ratio.log10_high) == (0.0, 0.0, 0.0)


def test_the_interval_of_a_ratio_covers_as_often_as_it_says():
    # 400 samples of 400 rollouts; a 95 % interval that covers truly has a count above 361 in
    # all but 1e-3 of such tests (binomial); the delta method's own error is far smaller.
    rng = np.random.default_rng(7)
    old, new = MODELS[0], (0.95, 0.8, 0.75)
    truth = np.log10(exact(new) / exact(old))
    covered = 0
    for _ in range(400):
        detected = rng.random((400, STEPS)) < 0.4
        rollouts = {
            "detected": detected,
            "salient": np.broadcast_to(braking_rows(GAPS), (400, STEPS, 11)),
            "log_q": np.where(detected, np.log(0.4), np.log(0.6)),
            "violated": detected.sum(axis=1) <= 1,
        }
        ratio = compare_pems(**rollouts, old=FixedPem(old), new=FixedPem(new))
        covered += ratio.log10_low <= truth <= ratio.log10_high
    assert covered > 361


def test_without_a_violation_nothing_is_made_up():
    rollouts = {**all_chains(), "violated": np.zeros(8, dtype=bool)}
    interval = pem_interval(reweight(**rollouts, members=MEMBERS), few_effective=10.0)
    assert interval.log10_high == -np.inf
    assert any("no rollout violates" in text for text in interval.warnings)
    with pytest.raises(PemError, match="the ratio of two models is unknown"):
        compare_pems(**rollouts, old=MEMBERS[0], new=MEMBERS[1])


def test_shapes_that_do_not_fit_are_refused():
    rollouts = {**all_chains(), "log_q": np.zeros((8, 2))}
    with pytest.raises(PemError, match=r"log_q \[8, 2\]"):
        reweight(**rollouts, members=[MEMBERS[0]])
    with pytest.raises(PemError, match="at least 2 members, got 1"):
        pem_interval(reweight(**all_chains(), members=[MEMBERS[0]]), few_effective=10.0)


def test_the_shipped_ensemble_reweights():
    members = load_ensemble("ml-nn-ensemble").members
    interval = pem_interval(reweight(**all_chains(), members=members), few_effective=10.0)
    assert interval.members == 20
    assert interval.log10_low < interval.log10_median < interval.log10_high < -2
