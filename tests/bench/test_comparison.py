"""Ratios of speed: what is compared computes the same, and regressions are told."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import comparison
from benchmarks.__main__ import main
from benchmarks.compiled_limit import limit_work
from benchmarks.plain_torch import draw, error_model, fit, proposal_logit, proposal_network
from benchmarks.ratios import Comparison, LeftOut, Ratio, changes, ratio_of_turns
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import load_preset
from pemviz.errors import RunError
from pemviz.pem import load_pem
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.gap_network import fit_gap_network, gap_network_from_arrays
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.simulators.braking.compiled import CompiledRollouts, Loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from tests.pooled import pool_outcomes

RUN = Comparison(
    ratios=(
        Ratio("loop", "numpy", 4.0, 3.5, 4.5),
        Ratio("loop", "its limit", 0.8, 0.7, 0.9, "limit: memory"),
    ),
    left_out=(LeftOut("metrics", "no rtamt"),),
    made_with={"pemviz": "0.1.0", "machine": "two cores"},
)


def with_value(value):
    return replace(RUN, ratios=(replace(RUN.ratios[0], value=value), RUN.ratios[1]))


@pytest.fixture
def measured(monkeypatch):
    """What the command finds when it measures."""
    found = [RUN]
    monkeypatch.setattr(comparison, "compare", lambda **_: found[0])
    return found


def test_a_ratio_is_the_median_of_its_turns():
    found = ratio_of_turns("a", "b", theirs_s=[6.0, 8.0, 1.0], ours_s=[2.0, 2.0, 1.0])
    assert (found.value, found.low, found.high) == (3.0, 1.0, 4.0)


@pytest.mark.parametrize(("value", "slower"), [(4.1, False), (3.01, False), (2.99, True)])
def test_slower_is_what_fell_by_more_than_the_threshold(value, slower):
    found = list(changes(RUN, with_value(value), threshold=0.25))
    assert [change.slower for change in found] == [slower, False]


def test_what_only_one_run_measured_is_never_slower():
    other = replace(RUN, ratios=(replace(RUN.ratios[0], name="new"),))
    found = list(changes(RUN, other, threshold=0.0))
    assert [(one.name, one.before, one.now) for one in found] == [
        ("new", None, 4.0), ("loop", 4.0, None), ("loop", 0.8, None),
    ]  # fmt: skip
    assert not any(one.slower for one in found)


def test_a_run_that_is_kept_is_held_against_a_later_one(capsys, measured, tmp_path):
    kept = tmp_path / "ratios.json"
    assert main(["compare", "--out", str(kept)]) == 0
    shown = capsys.readouterr().out
    assert "its limit" in shown
    assert "left out: metrics: no rtamt" in shown
    assert main(["compare", str(kept)]) == 0
    capsys.readouterr()
    measured[0] = replace(with_value(2.0), made_with={"pemviz": "0.2.0", "machine": "two cores"})
    assert main(["compare", str(kept), "--json"]) == 1
    out, err = capsys.readouterr()
    assert err.splitlines() == [
        "the earlier run had pemviz 0.1.0 (now 0.2.0)",
        "slower: loop against numpy: 4 before, 2 now",
    ]
    document = json.loads(out)
    assert [change["slower"] for change in document["changes"]] == [True, False]
    assert document["ratios"][1]["note"] == "limit: memory"
    assert main(["compare", str(kept), "--threshold", "0.6"]) == 0


def damaged(kept, damage):
    document = json.loads(kept.read_text(encoding="utf-8"))
    damage(document)
    kept.write_text(json.dumps(document), encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "fragment"),
    [
        (lambda d: d.update(schema=2), "schema must be 1"),
        (lambda d: d.update(ratios={}), "ratios must be a list"),
        (lambda d: d["ratios"].append(3), "ratios[2] must be an object"),
        (lambda d: d["ratios"][0].update(value="4"), "ratios[0].value must be a number"),
        (lambda d: d["ratios"][1].update(value=0.0), "ratios[1].value = 0.0"),
        (lambda d: d["ratios"][1].pop("name"), "ratios[1].name must be a text"),
        (lambda d: d["made_with"].update(numpy=2), "made_with.numpy must be a text"),
    ],
)
@pytest.mark.usefixtures("measured")
def test_a_damaged_file_is_one_line(capsys, tmp_path, damage, fragment):
    kept = tmp_path / "ratios.json"
    assert main(["compare", "--out", str(kept)]) == 0
    damaged(kept, damage)
    capsys.readouterr()
    assert main(["compare", str(kept)]) == 2
    shown = capsys.readouterr().err
    assert fragment in shown
    assert shown.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["nowhere.json"], "nowhere.json: cannot be read"),
        (["--threshold", "1"], "threshold = 1.0"),
        (["--turns", "0"], "turns = 0"),
        (["--out", "no-such-folder/ratios.json"], "there is no folder no-such-folder"),
        (["--part", "stl"], "--part"),
    ],
)
def test_bad_input_is_one_line(capsys, words, fragment):
    assert main(["compare", *words]) == 2
    shown = capsys.readouterr().err
    assert fragment in shown
    assert shown.count("\n") == 1


def test_rtamt_is_left_out_in_words_and_never_invented():
    (found,) = comparison.rtamt_ratios(None)
    assert isinstance(found, LeftOut)
    with pytest.raises(RunError, match="rtamt cannot be run there"):
        list(comparison.rtamt_ratios(sys.executable, turns=1))


def test_back_ends_and_formulas_are_timed():
    found = [
        *comparison.replay_ratios(vectorized_rollouts=100, highway_rollouts=1, turns=1),
        *comparison.hand_written_ratios(turns=1),
    ]
    assert len(found) == 4
    assert all(0.0 < one.low <= one.value <= one.high for one in found)


def test_the_loop_and_its_limit_are_timed():
    pytest.importorskip("numba")
    numpy, limit = comparison.compiled_ratios(rollouts=2_000, turns=1)
    assert numpy.value > 0.0
    assert limit.note.startswith(("limit: memory; ", "limit: arithmetic; "))


def test_a_whole_run_is_timed_beside_plain_rollouts():
    few = {"method": "mixture", "rollouts": 20, "stages": 2, "final_rollouts": 20}
    config = replace(load_preset("paper"), plan=False, **few)
    ratio = comparison.run_ratio(config, turns=1)
    assert ratio.name == "mixture, 80 rollouts"
    assert 0.0 < ratio.value < 1.0
    assert ratio.note.endswith(" s")


def test_the_limits_arithmetic_is_the_loops_own():
    simulator, pem = VectorizedSimulator(ScenarioConfig(states=12)), load_pem("ml-nn")
    uniforms = np.random.default_rng(0).random((64, 11))
    with np.errstate(over="ignore"):
        rollouts = CompiledRollouts(simulator, pem.logit, Loops())
        rollouts.simulate(uniforms)
        limit_work(rollouts, uniforms).arithmetic()
        _, tracks = rollouts.begun(64)
        rollouts.advance(tracks, uniforms, np.arange(64))
    assert (tracks.reached == 11).all()  # no gap is new: numpy has nothing to do


def test_plain_torch_draws_what_the_engine_draws():
    config, pem = ScenarioConfig(), load_pem(ExperimentConfig().pem)
    uniforms = np.random.default_rng(1).random((40, 99)) * 0.3
    model = error_model(pem, config)
    ours = simulate(
        simulator=VectorizedSimulator(config), pem=pem, proposal=PemProposal(), uniforms=uniforms
    )
    theirs = draw(config, model, model, torch.as_tensor(uniforms))
    np.testing.assert_array_equal(theirs.detected, ours.detected)
    assert not ours.detected.all()
    np.testing.assert_allclose(theirs.gap_m, ours.signals["gap"], atol=1e-9)
    torch.manual_seed(0)
    network = proposal_network().double()
    moved = draw(config, model, proposal_logit(network), torch.as_tensor(uniforms))
    named = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    ours = simulate(
        simulator=VectorizedSimulator(config),
        pem=pem,
        proposal=gap_network_from_arrays(named),
        uniforms=uniforms,
    )
    np.testing.assert_array_equal(moved.detected, ours.detected)
    np.testing.assert_allclose(moved.log_weight, ours.log_weight, atol=1e-9)


def test_plain_torch_learns_what_the_engine_learns():
    config = replace(load_preset("paper-algorithm"), epochs=20)
    torch.manual_seed(0)
    network = proposal_network().double()
    named = {name: value.detach().clone().numpy() for name, value in network.state_dict().items()}
    model = error_model(load_pem(config.pem), config.scenario)
    uniforms = np.random.default_rng(2).random((6, 99)) * 0.2
    drawn = draw(config.scenario, model, model, torch.as_tensor(uniforms))
    chosen, weight = np.arange(6) % 2 == 0, np.array([0.2, 0.5, 0.3])
    fit(network, drawn, torch.as_tensor(chosen), torch.as_tensor(weight), config=config)
    table = pool_outcomes(
        gap_m=drawn.gap_m.numpy()[chosen, :-1],
        detected=drawn.detected.numpy()[chosen],
        rollout_weight=weight,
    )
    ours, _ = fit_gap_network(
        gap_network_from_arrays(named), table, epochs=20, learning_rate=config.learning_rate
    )
    for name, value in network.state_dict().items():
        np.testing.assert_allclose(value.detach(), ours.arrays()[name], atol=1e-6)
