"""A hidden property of one's own, from its setting to the answer, against all chains of outcomes.

It is that of the example: one class, in one file.
"""

import itertools
import math
import runpy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

import pemviz
from pemviz.arrays import row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem import load_pem
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.state.composed import ComposedPem, as_member
from pemviz.sampling.zero_variance.reference import exact_log_probability
from pemviz.types import outcome_log_likelihood
from tests.faults.test_resume import stopped_and_whole
from tests.lattice_walk import ToyPem, ToySimulator
from tests.slot_toys import TwoCars
from tests.toy import ConstantPem

SIMULATOR, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=11), ToyPem(at_zero=2.5)
CHAINS = np.array(list(itertools.product((False, True), repeat=SIMULATOR.states - 1)))
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "dirty_lens.py"
DirtyLens = runpy.run_path(str(EXAMPLE))["DirtyLens"]
LENS = DirtyLens(share=0.1, drop=4.0)
CONFIG = ExperimentConfig(
    method="mixture", spec="always[0,10] (gap >= 0.5)", stages=4, rollouts=200,
    final_rollouts=1000, seed=1, reference=True, memory_curve=True,
)  # fmt: skip


def by_enumeration(lens, pem=PEM):
    """All chains' probabilities, one lens after the other; and which of them violate."""
    probabilities, violates = [], []
    for chain in CHAINS:
        given, gap, failed = [lens.share, 1.0 - lens.share], SIMULATOR.initial_gap, False
        for detected in chain:
            own = float(pem.logit(np.array([float(gap)])))
            for place, one in enumerate((own - lens.drop, own)):
                given[place] *= expit(one) if detected else expit(-one)
            gap = min(gap + 1, SIMULATOR.largest_gap) if detected else gap - 1
            failed = failed or gap <= 0
        probabilities.append(sum(given))
        violates.append(failed)
    return np.array(probabilities), np.array(violates)


def experiment_of(lens=LENS, **settings):
    return build_experiment(
        replace(CONFIG, **settings), simulator=SIMULATOR, twin=SIMULATOR, pem=PEM, hidden=[lens]
    )


@pytest.mark.parametrize("lens", [LENS, DirtyLens(share=0.5, drop=1.0), DirtyLens(0.01, 20.0)])
def test_the_recursion_is_the_sum_over_all_chains(lens):
    probabilities, violates = by_enumeration(lens)
    experiment = experiment_of(lens)
    found = exact_log_probability(experiment.problem, twin=experiment.twin)
    assert found is not None
    assert math.exp(found) == pytest.approx(probabilities[violates].sum(), rel=1e-11)


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("monte-carlo", {"final_rollouts": 50_000}),
        ("mixture", {}),
        ("splitting", {"stages": 20}),
        ("subset", {"stages": 20, "rollouts": 200}),
        ("zero-variance", {}),
    ],
)
def test_every_method_agrees_with_all_chains(method, settings):
    """Seeds are fixed; five standard errors, a false alarm in 1e6 for each."""
    probabilities, violates = by_enumeration(LENS)
    truth = probabilities[violates].sum()
    result = run(experiment_of(method=method, **settings))
    found, known = result.estimate, result.reference
    assert abs(known.probability - truth) <= 5 * known.std_error + 1e-9 * truth
    assert abs(found.probability - truth) < 5 * found.std_error
    assert found.std_error < 0.25 * truth


def test_other_models_are_asked_for_whole_chains():
    """As refits of the model are: what the rollouts' states know is of the model they ran with."""
    experiment, other = experiment_of(), ToyPem(at_zero=1.0)
    problem = experiment.problem
    signals = replay(simulator=problem.simulator, detected=CHAINS)
    before = {name: values[:, :-1] for name, values in signals.items()}
    asked = as_member(other, like=problem.pem).log_likelihood(
        problem.simulator.salient(before), CHAINS
    )
    np.testing.assert_allclose(np.exp(asked), by_enumeration(LENS, pem=other)[0], rtol=1e-10)
    under = problem.under(other)
    signals = replay(simulator=under.simulator, detected=CHAINS)
    salient = under.simulator.salient({name: v[:, :-1] for name, v in signals.items()})
    found = row_sums(outcome_log_likelihood(under.pem.logit(salient), CHAINS))
    np.testing.assert_allclose(found, asked, rtol=1e-10)


def test_the_answer_says_what_it_is_for_and_what_it_cannot_tell():
    result = run(experiment_of(target=1e-6))
    words = "\n".join(
        plain_lines(b for section in run_document(result).sections for b in section.full)
    )
    assert "if error model ToyPem with 10 % dirty lenses is right" in pemviz.summary_text(result)
    assert "independent of each other" not in words
    assert "not enough alone" not in words
    assert "not available with 10 % dirty lenses" in words
    assert "misses hang together by 10 % dirty lenses" in words
    assert result.memory.hidden == ("10 % dirty lenses",)
    assert result.memory.curve == ()  # would be the answer for clean lenses
    assert all(one.elasticity is None for one in result.explanation.sensitivity)
    assert result.config.pem == "ToyPem with 10 % dirty lenses"
    one, other, same = (
        ComposedPem(load_pem("ml-nn"), (DirtyLens(share, 4.0),)) for share in (0.1, 0.2, 0.1)
    )
    assert other.digest != one.digest == same.digest != load_pem("ml-nn").digest


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(tmp_path):
    experiment = experiment_of(final_rollouts=100, rollouts=50)
    _, whole, _ = stopped_and_whole(experiment, tmp_path, 2)
    assert pemviz.read_result(whole).memory.hidden == ("10 % dirty lenses",)


def test_on_the_papers_scenario_it_is_that_of_the_dirty_and_the_clean_lens():
    """A lens is dirty all along: two runs without anything hidden give the answer.

    Seeds are fixed; five joint standard errors, a false alarm in 1e6.
    """
    lens, pem = DirtyLens(share=0.01, drop=3.0), load_pem("ml-nn")
    config = ExperimentConfig(
        method="zero-variance", seed=1, final_rollouts=500, plan=False, measured_memory=False
    )
    dirty, clean = (
        run(build_experiment(config, pem=Lowered(pem, drop))).estimate for drop in (lens.drop, 0.0)
    )
    truth = lens.share * dirty.probability + (1.0 - lens.share) * clean.probability
    config = replace(config, method="mixture", final_rollouts=1000)
    found = run(build_experiment(config, hidden=[lens])).estimate
    error = math.hypot(found.std_error, lens.share * dirty.std_error)
    assert abs(found.probability - truth) < 5 * error
    assert error < 0.2 * truth


@dataclass(frozen=True)
class Lowered:
    """A detector behind a lens that is known to be dirty."""

    pem: object
    drop: float

    def logit(self, salient):
        return self.pem.logit(salient) - self.drop


@pytest.mark.parametrize("setting", [{"memory_s": 0.5}, {"frailty": 0.5}])
def test_what_would_be_answered_wrong_is_refused_in_one_line(setting):
    with pytest.raises(ConfigError, match=r"hidden: .*stands alone") as caught:
        experiment_of(**setting)
    assert "\n" not in str(caught.value)


def test_slots_are_refused_in_one_line():
    config = replace(CONFIG, memory_curve=False, reference=False, spec="always[0,3] (gap_a >= 0.5)")
    with pytest.raises(ConfigError, match="hidden: simulator 'two-cars', which has") as caught:
        build_experiment(config, simulator=TwoCars(), pem=ConstantPem(0.1), hidden=[LENS])
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Nameless(DirtyLens):
    @property
    def label(self):
        return ""


@dataclass(frozen=True)
class Copied(DirtyLens):
    follows_model = False


@pytest.mark.parametrize(
    ("hidden", "words"),
    [
        ([Nameless(0.1, 4.0)], "hidden: Nameless: must have a label"),
        (["fog"], "hidden: str: must be a pemviz.HiddenProperty"),
        ([Copied(0.1, 4.0), Copied(0.2, 4.0)], "hidden: signal 'dirty': belongs to two"),
        ([LENS, LENS], "hidden: signal 'dirty': belongs to two"),
    ],
)
def test_what_is_no_property_is_refused_in_one_line(hidden, words):
    with pytest.raises(ConfigError, match=words) as caught:
        build_experiment(CONFIG, simulator=SIMULATOR, twin=SIMULATOR, pem=PEM, hidden=hidden)
    assert "\n" not in str(caught.value)
