"""Runs with a visibility that comes and goes, against all chains of outcomes and plain draws."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import pemviz
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem.models.varying_frailty import VaryingFrailty, VaryingNodes
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.uncertainty import remedy_of
from pemviz.sampling.rollouts.simulate import replay
from tests.faults.test_resume import stopped_and_whole
from tests.lattice_walk import ToyPem, ToySimulator
from tests.slot_toys import TwoCars
from tests.toy import ConstantPem

SIMULATOR, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=11), ToyPem(at_zero=2.5)
CHAINS = np.array(list(itertools.product((False, True), repeat=SIMULATOR.states - 1)))
LAW = VaryingFrailty(0.5, 1.2, 0.4)
CONFIG = ExperimentConfig(
    method="mixture", spec="always[0,10] (gap >= 0.5)", stages=4, rollouts=200,
    final_rollouts=1000, seed=1, memory_law="visibility", frailty=0.5, varying_frailty=1.2,
    varying_frailty_s=0.4,
)  # fmt: skip


def experiment_of(**settings):
    return build_experiment(
        replace(CONFIG, **settings), simulator=SIMULATOR, twin=SIMULATOR, pem=PEM
    )


@pytest.fixture(scope="module")
def chains():
    """Probabilities of all chains by the law alone, and which of them violate."""
    signals = replay(simulator=SIMULATOR, detected=CHAINS)
    gap = signals["gap"]
    own = PEM.logit(SIMULATOR.salient({"gap": gap[:, :-1]}))
    log_p = VaryingNodes(LAW, SIMULATOR.dt_s).log_likelihood(own, CHAINS)
    return np.exp(log_p), (gap < 0.5).any(axis=1)


def test_all_chains_have_as_much_as_plain_draws_of_the_latents_say(chains):
    """400,000 plain rollouts that know no filter; five standard errors, a false alarm in 1e6."""
    probabilities, violates = chains
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    count, random = 400_000, np.random.default_rng(1)
    lasting, slow = random.standard_normal((2, count))
    gap, failed = np.full(count, 4.0), np.zeros(count, dtype=np.bool_)
    rho = np.exp(-SIMULATOR.dt_s / LAW.varying_s)
    for step in range(10):
        if step:
            slow = rho * slow + np.sqrt(1.0 - rho**2) * random.standard_normal(count)
        hard = LAW.frailty * lasting + LAW.varying * slow + random.standard_normal(count)
        own_miss = 1.0 / (1.0 + np.exp(PEM.logit(gap[:, None])))
        missed = hard / LAW.scale < np.array([_quantile(p) for p in np.unique(own_miss)])[
            np.unique(own_miss, return_inverse=True)[1]
        ]  # fmt: skip
        gap = np.where(missed, gap - 1.0, np.minimum(gap + 1.0, 6.0))
        failed |= gap < 0.5
    truth = probabilities[violates].sum()
    assert abs(failed.mean() - truth) < 5.0 * np.sqrt(truth / count)


def _quantile(p):
    from statistics import NormalDist  # noqa: PLC0415

    return NormalDist().inv_cdf(float(p))


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("monte-carlo", {"final_rollouts": 5_000}),
        ("mixture", {}),
        ("splitting", {"stages": 10}),
        ("subset", {"stages": 20, "rollouts": 400}),
        ("auto", {}),
    ],
)
def test_every_method_agrees_with_all_chains(chains, method, settings):
    """Seeds are fixed; five standard errors, a false alarm in 1e6 for each."""
    probabilities, violates = chains
    truth = probabilities[violates].sum()
    found = run(experiment_of(method=method, **settings)).estimate
    assert abs(found.probability - truth) < 5 * found.std_error
    assert found.std_error < 0.25 * truth


def test_the_states_know_what_the_chain_is_worth(chains):
    """Step by step as the chain at once, and in whatever batch."""
    problem = experiment_of().problem
    signals = replay(simulator=problem.simulator, detected=CHAINS)
    salient = problem.simulator.salient({name: v[:, :-1] for name, v in signals.items()})
    logit = problem.pem.logit(salient)
    log_p = -np.logaddexp(0.0, np.where(CHAINS, -logit, logit)).sum(axis=1)
    np.testing.assert_allclose(np.exp(log_p), chains[0], rtol=1e-9)
    asked = problem.pem.log_likelihood(salient, CHAINS)
    np.testing.assert_allclose(asked, np.log(chains[0]), rtol=1e-12)
    few = replay(simulator=problem.simulator, detected=CHAINS[5:8])
    np.testing.assert_array_equal(few["seen_logit"], signals["seen_logit"][5:8])


def test_the_answer_says_the_law_and_the_other_ones_beside():
    result = run(experiment_of())
    words = "\n".join(
        plain_lines(b for section in run_document(result).sections for b in section.full)
    )
    assert "frailty 0.5 and time-varying frailty 1.2 (0.4 s)" in pemviz.summary_text(result)
    assert "with the memory of RRC, a camera detector" in words
    assert "independent of each other" not in words
    assert "if error model ToyPem is right" in words
    assert result.config.pem == "ToyPem"


def test_advice_names_nothing_that_the_law_refuses():
    result = run(build_experiment(CONFIG, simulator=SIMULATOR, pem=PEM))
    assert "a run with --memory-law outcomes may tell" in result.memory.unmeasured
    settings = {"frailty": 0.5, "varying_frailty": 1.0, "varying_frailty_s": 0.3}
    braking = ExperimentConfig(memory_law="visibility", **settings)
    for law, allowed in ((braking, False), (ExperimentConfig(), True)):
        better = remedy_of(replace(result, config=replace(law, method="mixture")), ())
        assert ("zero-variance" in better) == allowed
        assert "splitting" in better


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(tmp_path):
    experiment = experiment_of(final_rollouts=100, rollouts=50)
    _, whole, _ = stopped_and_whole(experiment, tmp_path, 2)
    assert pemviz.read_result(whole).config.memory_law == "visibility"


class Fitted(ToyPem):
    """A model that carries a law of its own."""

    varying_frailty = LAW


def test_what_is_left_out_is_the_models_own():
    left_out = {"frailty": None, "varying_frailty": None, "varying_frailty_s": None}
    config = replace(CONFIG, **left_out)
    own = build_experiment(config, simulator=SIMULATOR, pem=Fitted(at_zero=2.5))
    assert own.problem.pem.properties[0].law == LAW
    config = replace(config, varying_frailty=2.0)
    changed = build_experiment(config, simulator=SIMULATOR, pem=Fitted(at_zero=2.5))
    assert changed.problem.pem.properties[0].law == replace(LAW, varying=2.0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"memory_s": 0.5}, "memory_s = 0.5: must be left out with memory_law visibility"),
        ({"memory_law": "outcomes"}, "varying_frailty = 1.2: must be left out without"),
        ({"varying_frailty": None}, "ToyPem says nothing of it; give varying_frailty, or fit a"),
        ({"varying_frailty_s": None}, "ToyPem says nothing of it; give varying_frailty_s, or fit"),
        ({"frailty": 0.001}, "frailty is 0.001, allowed: 0, or 0.02 to 5"),
        (
            {"method": "zero-variance"},
            "method = 'zero-variance': .* with memory_law outcomes alone",
        ),
        ({"reference": True}, "reference = true: .* with memory_law outcomes alone"),
        ({"memory_curve": True}, "memory_curve = true: works with memory_law outcomes alone"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(settings, words):
    with pytest.raises(pemviz.InputError, match=words) as caught:
        experiment_of(**settings)
    assert "\n" not in str(caught.value)


def test_slots_are_refused_in_one_line():
    config = replace(CONFIG, spec="always[0,3] (gap_a >= 0.5)")
    with pytest.raises(ConfigError, match="simulator 'two-cars', which has slots, works with"):
        build_experiment(config, simulator=TwoCars(), pem=ConstantPem(0.1))
