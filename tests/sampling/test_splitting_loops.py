"""Splitting's short cuts, compiled loops and states looked at once, change no digit of a run."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.compiling import LoadedInTime
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.frailty import NEXT, frail_part
from pemviz.sampling.rollouts import compiled
from pemviz.sampling.rollouts.kernels import Loops
from pemviz.sampling.splitting import importance as importance_module
from pemviz.sampling.splitting import loops, moving, ways
from pemviz.sampling.splitting.importance import importance
from pemviz.sampling.splitting.moving import Mover
from pemviz.sampling.splitting.particles import beginning, continued
from pemviz.sampling.splitting.run import split

CONFIG = ExperimentConfig(
    method="splitting",
    spec="always[0,49] (gap >= 7.0)",
    scenario=ScenarioConfig(states=50),
    plan=False,
)
SETTINGS = {
    "plain": CONFIG,
    "agm": replace(CONFIG, metric="agm"),
    "memory": replace(CONFIG, memory_s=0.2),
    "frailty": replace(CONFIG, memory_s=0.2, frailty=0.5),
    "frailty alone": replace(CONFIG, frailty=0.8),
    "tracker": replace(CONFIG, scenario=replace(CONFIG.scenario, tracker="2/3")),
    "position errors": replace(CONFIG, position_errors="pointpillars"),
}
SERVED = {"plain": {"moved", "looked"}, "agm": {"moved", "looked"}, "memory": {"looked"}}
SERVED |= {"frailty": {"looked"}, "frailty alone": {"looked"}}


def problem_of(name):
    return replace(build_experiment(SETTINGS[name]).problem, batch_time_limit_s=None)


def runs_of(problem):
    with np.errstate(over="ignore"):  # hashes of the loop as it is written
        return split(problem, count=80, generators=[np.random.default_rng(seed) for seed in (1, 2)])


def assert_same(one, other):
    assert one.log_probability == other.log_probability
    assert (one.levels, one.simulated) == (other.levels, other.simulated)
    assert one.common_ancestry == other.common_ancestry
    mine, theirs = one.scored.rollouts, other.scored.rollouts
    for name in theirs.signals:
        np.testing.assert_array_equal(mine.signals[name], theirs.signals[name], err_msg=name)
    for name in theirs.memory:
        np.testing.assert_array_equal(mine.memory[name], theirs.memory[name], err_msg=name)
    np.testing.assert_array_equal(mine.detected, theirs.detected)
    np.testing.assert_array_equal(mine.pem_logit, theirs.pem_logit)
    np.testing.assert_array_equal(mine.proposal_logit, theirs.proposal_logit)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_loops_change_no_digit_and_serve_what_they_know(name, monkeypatch):
    """The loops as they are written: what numba makes of them is tested beside them."""
    problem = problem_of(name)
    with loops.STEPS_ASKED.from_the_start(False):
        by_numpy, served = runs_of(problem), set()
    simulate, replay = compiled.CompiledRollouts.simulate, ways.replay
    monkeypatch.setattr(loops, "STEPS_ASKED", LoadedInTime(Loops, 0, 0))
    monkeypatch.setattr(
        moving.CompiledRollouts,
        "simulate",
        lambda *given: served.add("moved") or simulate(*given),
    )
    monkeypatch.setattr(ways, "replay", lambda *given: served.add("looked") or replay(*given))
    for one, other in zip(runs_of(problem), by_numpy, strict=True):
        assert_same(one, other)
    assert served == SERVED.get(name, set())
    assert any(one.levels > 0 and one.log_probability > -np.inf for one in by_numpy)


def test_without_the_loops_numpy_goes_on(monkeypatch):
    problem = problem_of("plain")
    expected = runs_of(problem)
    monkeypatch.setattr(loops, "STEPS_ASKED", LoadedInTime(lambda: None, 0, 0))
    for one, other in zip(runs_of(problem), expected, strict=True):
        assert_same(one, other)


def test_the_loops_are_loaded_once_so_many_steps_were_asked_for(monkeypatch):
    monkeypatch.setattr(loops, "STEPS_ASKED", LoadedInTime(Loops, 100, 100))
    assert [loops.loops_for(40) is not None for _ in range(4)] == [False, False, True, True]


@pytest.mark.parametrize("name", ["memory", "frailty"])
def test_states_that_the_same_outcomes_led_to_are_looked_at_once(name, monkeypatch):
    problem = problem_of(name)
    begun = beginning(problem, count=60, generator=np.random.default_rng(3))
    (particles,) = continued(problem, [begun])
    row, step = np.repeat(np.arange(60), 12), np.tile(np.arange(33, 45), 60)
    sizes = []
    distinct = importance_module.distinct_rows

    def noted(keys):
        found = distinct(keys)
        sizes.append((len(keys), found and found[0].size))
        return found

    monkeypatch.setattr(importance_module, "distinct_rows", noted)
    together = importance(problem, particles.rollouts, row=row, step=step)
    (asked, looked), *_ = sizes
    assert asked == 720
    assert looked < 200
    alone = [
        importance(problem, particles.rollouts, row=row[[one]], step=step[[one]])[0]
        for one in range(0, 720, 7)
    ]
    np.testing.assert_array_equal(together[::7], alone)


def test_what_outcomes_tell_is_found_again_at_any_state():
    problem = problem_of("frailty")
    simulator, rng = problem.simulator, np.random.default_rng(4)
    begun = beginning(problem, count=50, generator=rng)
    states, known = simulator.initial(count=50), []
    rollouts = Mover().moved_on(
        problem, moving.Way(begun.paths.rollouts, begun.cut, begun.uniforms, begun.noise)
    )
    for outcomes in rollouts.detected.T:
        known.append(states.memory[NEXT])
        states = simulator.step(states, outcomes)
    step = np.sort(rng.integers(0, 49, 50))
    found = frail_part(simulator).known_at(rollouts, step=step)
    for field in found.dtype.names:
        expected = np.stack([known[moment][row] for row, moment in enumerate(step)])[field]
        np.testing.assert_allclose(found[field], expected, rtol=1e-9, atol=1e-12)
