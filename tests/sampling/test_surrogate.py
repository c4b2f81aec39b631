"""A surrogate may teach where violations are, and never what the answer is."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_table, load_config
from pemviz.errors import ConfigError, RunError
from pemviz.reports.terminal import summary_text
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.reading import read_result
from pemviz.runs.run_folder import record
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.mixture.rejuvenated import SHARE
from tests.latent_toys import Drift
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion
from tests.slot_toys import TwoCars
from tests.toy import ConstantPem, MissCounter

WALK, PEM = ToySimulator(initial_gap=5, states=20), ToyPem(at_zero=2.5)
EXACT = toy_probability_by_recursion(WALK, PEM)


class Named:
    """Another name for a walk."""

    def __init__(self, walk, name="surrogate"):
        self.walk, self.name = walk, name
        self.stepped = 0

    def __getattr__(self, attribute):
        return getattr(self.walk, attribute)

    def step(self, states, *given):
        self.stepped += 1
        return self.walk.step(states, *given)


SURROGATES = {
    "right": replace(WALK),
    "fails too often": replace(WALK, initial_gap=3),
    "fails too seldom": replace(WALK, initial_gap=7),
    "never fails": replace(WALK, initial_gap=30, largest_gap=40),
}


def experiment(surrogate, *, simulator=WALK, pem=PEM, **settings):
    spec = settings.pop("spec", f"always[0,{simulator.states - 1}] (gap >= 0.5)")
    config = ExperimentConfig(spec=spec, **settings)
    own = None if surrogate is None else Named(surrogate)
    return build_experiment(config, simulator=simulator, pem=pem, surrogate=own)


@pytest.mark.parametrize(
    ("method", "which"), [*(("auto", which) for which in SURROGATES), ("mixture", "right")]
)
def test_the_answer_is_the_simulators_whatever_the_surrogate_is(method, which):
    """Of 8 unwarned 95 % intervals fewer than 5 hold in one of 3,000 studies."""
    assert 9.6e-5 < EXACT < 9.7e-5
    held = 0
    for seed in range(8):
        found = run(experiment(SURROGATES[which], method=method, seed=seed)).estimate
        assert found.probability == pytest.approx(EXACT, rel=0.5)
        held += bool(interval_caveats(found)) or found.ci_low <= EXACT <= found.ci_high
    assert held >= 5


def test_one_that_is_right_saves_rollouts_and_says_what_it_has_seen():
    plain = run(experiment(None, seed=3))
    result = run(experiment(SURROGATES["right"], seed=3))
    assert result.estimate.rollouts_simulated < 0.6 * plain.estimate.rollouts_simulated
    found = result.surrogate
    assert plain.surrogate is None
    assert found.name == "surrogate"
    assert 4_400 < found.rollouts <= 4_400 + SHARE * 4_500  # violations were moved
    assert found.probability == pytest.approx(EXACT, rel=0.3)
    told = summary_text(result)
    words = f"learned first on {found.rollouts} rollouts of surrogate surrogate, whose own failure"
    assert words in told


def test_its_probability_is_its_own():
    wrong = SURROGATES["fails too often"]
    result = run(experiment(wrong, seed=1))
    exact = toy_probability_by_recursion(wrong, PEM)
    assert exact > 20.0 * EXACT
    assert result.surrogate.probability == pytest.approx(exact, rel=0.3)


def test_one_that_never_fails_teaches_nothing_and_says_so():
    result = run(experiment(SURROGATES["never fails"], seed=2))
    assert result.surrogate.probability == 0.0
    told = summary_text(result)
    assert "4400 rollouts of surrogate surrogate taught nothing: none of them violates" in told


def test_where_plain_rollouts_are_the_answer_it_is_not_simulated():
    often = ToySimulator(initial_gap=2, states=12)
    built = experiment(replace(often), simulator=often, pem=ToyPem(at_zero=1.0))
    before = built.back_end.surrogate.stepped
    assert run(built).surrogate is None
    assert built.back_end.surrogate.stepped == before


def test_repetitions_have_rollouts_of_their_own_on_it():
    result = run(experiment(SURROGATES["right"], seed=4, repetitions=2))
    each = [
        run(experiment(SURROGATES["right"], seed=4, repetitions=1)).surrogate.probability,
        2 * result.surrogate.probability,
    ]
    assert 8_800 < result.surrogate.rollouts <= 8_800 + SHARE * 9_000
    assert each[1] - each[0] != each[0]
    assert each[1] - each[0] == pytest.approx(EXACT, rel=0.3)


@pytest.mark.parametrize("batch", [7, 50])
def test_how_many_are_simulated_at_a_time_changes_nothing(batch):
    whole = run(experiment(SURROGATES["fails too seldom"], seed=5))
    config = ExperimentConfig(spec=whole.config.spec, seed=5)
    parts = run(
        build_experiment(
            config,
            simulator=WALK,
            pem=PEM,
            surrogate=Named(SURROGATES["fails too seldom"]),
            batch_rollouts=batch,
        )
    )
    assert parts.estimate.log10_probability == whole.estimate.log10_probability
    assert parts.surrogate == whole.surrogate


@pytest.mark.parametrize("stops", [1, 2, 3])
def test_a_run_that_is_stopped_goes_on_to_the_same_bytes(tmp_path, stops):
    built = experiment(SURROGATES["fails too often"], seed=6)
    whole, part = tmp_path / "whole" / "run", tmp_path / "part" / "run"
    whole.mkdir(parents=True)
    part.mkdir(parents=True)
    record(built, whole)
    stage_ends = 0

    class Counting:
        def notify(self, event):
            nonlocal stage_ends
            stage_ends += type(event).__name__ == "StageDone"

    record(built, part, observers=[Counting()], should_stop=lambda: stage_ends >= stops)
    assert read_result(part).status == "stopped"
    record(built, part)
    assert (part / "rollouts.npz").read_bytes() == (whole / "rollouts.npz").read_bytes()
    assert read_result(part).estimate == read_result(whole).estimate
    assert read_result(part).surrogate == read_result(whole).surrogate
    assert load_config(part / "config.toml").surrogate == "surrogate"


def test_a_run_does_not_go_on_with_another_surrogate(tmp_path):
    """Its proposals would not be those that the rollouts so far were sampled from."""
    part = tmp_path / "run"
    part.mkdir()
    stages = []

    class Counting:
        def notify(self, event):
            stages.extend([None] * (type(event).__name__ == "StageDone"))

    begun = experiment(SURROGATES["right"], seed=8)
    record(begun, part, observers=[Counting()], should_stop=lambda: len(stages) >= 3)
    changed = experiment(SURROGATES["fails too often"], seed=8)
    with pytest.raises(RunError, match=r"^surrogate 'surrogate': has changed since this run was"):
        record(changed, part)
    record(begun, part)
    assert read_result(part).estimate == run(begun).estimate


def test_memory_and_frailty_are_those_of_the_simulators_system():
    settings = {"memory_s": 1.5, "frailty": 0.5, "seed": 7, "precision": 0.1}
    without = run(experiment(None, **settings)).estimate
    found = run(experiment(SURROGATES["fails too often"], **settings)).estimate
    error = np.hypot(without.std_error, found.std_error)
    assert abs(found.probability - without.probability) < 4.0 * error


def test_latents_are_moved_as_the_surrogate_taught():
    drift = Drift(miss_m=0.3)
    limit = 4.0
    exact = drift.probability(limit, miss=0.1)
    assert 1e-7 < exact < 1e-3
    settings = {"simulator": drift, "pem": ConstantPem(0.1), "spec": drift.spec(limit), "chains": 0}
    without = run(experiment(None, seed=1, **settings)).estimate
    found = run(experiment(replace(drift, noise_sd_m=0.25), seed=1, **settings)).estimate
    assert found.probability == pytest.approx(exact, rel=0.5)
    assert found.rollouts_simulated < without.rollouts_simulated


def test_slots_take_turns_in_it_too():
    cars = TwoCars()
    pem = {slot.name: ConstantPem(0.1) for slot in cars.slots}
    spec = f"always[0,{cars.states - 1}] (gap_a >= 0)"
    built = build_experiment(
        ExperimentConfig(spec=spec, seed=1), simulator=cars, pem=pem, surrogate=TwoCars()
    )
    assert built.back_end.surrogate.turns == 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"surrogate": "vectorized"}, "surrogate = 'vectorized': is the simulator itself"),
        ({"surrogate": "matlab"}, "surrogate = 'matlab': no such simulator; there are: vec"),
        ({"surrogate": "merge"}, "surrogate = 'merge': slots .*: must be those of simulator 'vec"),
    ],
)
def test_what_cannot_be_a_surrogate_is_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        build_experiment(ExperimentConfig(**settings))


@pytest.mark.parametrize(
    ("surrogate", "words"),
    [
        (replace(WALK, states=19), "states 19 of 1 s: must be those of simulator 'toy', 20 of 1 s"),
        (MissCounter(states=20), "states 20 of 0.1 s: must be those of simulator"),
    ],
)
def test_one_of_another_shape_is_refused(surrogate, words):
    with pytest.raises(ConfigError, match=rf"^surrogate = 'surrogate': {words}"):
        experiment(surrogate)


def test_a_configuration_names_it_only_where_there_is_one():
    assert "surrogate" not in config_table(ExperimentConfig())
    assert config_table(ExperimentConfig(surrogate="vectorized"))["surrogate"] == "vectorized"
