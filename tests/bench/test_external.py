"""The external benchmark: its truths held to each other, its systems to their definitions."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, ndtr

from benchmarks.__main__ import main
from benchmarks.external import others
from benchmarks.external.airspace import Pairs, PilotWithDisplay
from benchmarks.external.catalogue import problems
from benchmarks.external.motions import dimension, limit_function
from benchmarks.external.mujoco_pole import POLE_START, stepped_by_mujoco
from benchmarks.external.problems import chosen, every, experiment_of
from benchmarks.external.quadrature import by_windows
from benchmarks.external.record import DONE, RUNS, Run, add_run, as_took, read_runs
from benchmarks.external.sequential import CART_START, LEAN, RAIL, WalkBesidePattern, pushed
from benchmarks.external.study import ExternalStudy, configured, run_study
from benchmarks.external.systems import MotionDetector, MotionSimulator
from benchmarks.external.table import MOST, beside, nearer, rows_of
from benchmarks.external.truths import WAYS, enumerated
from benchmarks.trust_systems import LinearLogit, TwoWayWalk
from benchmarks.trust_truth import always, exact_probability
from pemviz import stl
from pemviz.errors import InputError
from pemviz.pem import as_pem
from pemviz.sampling.description import learning_budget
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.latents import begun, stepped

ROWS = 2000
SLOW = ("CartPole", "InvertedPendulum", "pendulum", "RP63")
LONG = ("RP24", "RP31", "RP35", "RP53", "RP57")
"""Quadratures that take a second and more."""
EXACT = 3e-4
"""Share by which two quadratures may differ: the coarser is of RP31, whose edges are steep."""


def test_every_problem_is_known_and_found_again():
    names = [problem.name for problem in every()]
    assert len(set(names)) == len(names)
    assert set(WAYS) == {problem.name for problem in problems()}
    assert all("|" not in name for name in names)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in LONG))
        for name in WAYS
        if not name.startswith(SLOW) and not name.endswith("100")
    ],
)
def test_truths_are_found_again(name):
    """Sampled ones within 4.5 standard errors: a dozen of them, false alarm 1e-4 in all."""
    (problem,) = chosen([name])
    for way in WAYS[name]:
        again = way()
        error = math.hypot(again.relative_error, problem.relative_error)
        assert abs(again.value / problem.truth - 1.0) < max(EXACT, 4.5 * error), again.how


def test_the_walk_beside_a_pattern_is_that_of_the_study_of_trust():
    """Two programs and two recursions for one scenario."""
    motion = WalkBesidePattern(pattern=(1, 3, 5, 7), first=6)
    walk = TwoWayWalk(watched=motion.pattern, initial_gap=6, largest_gap=8, states=19)
    model = as_pem(LinearLogit(motion.at_zero, motion.slope))
    found = exact_probability(walk, model, always(lambda signals: signals["gap"] >= 0.5, 0, 18))
    rng = np.random.default_rng(4)
    outcomes = rng.random((500, 18)) < 0.5
    values = motion.begin(np.empty((500, 0)))
    gaps = [values["gap"]]
    for step in range(18):
        values = motion.move(values, step, outcomes[:, step], np.empty((500, 0)))
        gaps.append(values["gap"])
    expected = replay(simulator=walk, detected=outcomes)["gap"]
    np.testing.assert_array_equal(np.stack(gaps, axis=1), expected)
    assert enumerated(motion).value == pytest.approx(found, rel=1e-9)


def test_the_cart_moves_as_gymnasiums_does():
    gymnasium = pytest.importorskip("gymnasium")
    environment = gymnasium.make("CartPole-v1").unwrapped
    environment.reset(seed=0)
    environment.state = np.array(CART_START)
    rng = np.random.default_rng(0)
    state = dict(zip(("x", "xd", "th", "thd"), np.array(CART_START)[:, None], strict=True))
    for right in rng.random(12) < 0.5:
        environment.step(int(right))
        state = pushed(state, np.array([10.0 if right else -10.0]))
        mine = [state[name][0] for name in ("x", "xd", "th", "thd")]
        np.testing.assert_allclose(mine, environment.state, rtol=1e-12)
    assert environment.x_threshold == RAIL
    assert environment.theta_threshold_radians == pytest.approx(LEAN, abs=1e-4)


def test_the_pole_moves_as_mujocos_does():
    pytest.importorskip("mujoco", reason="its simulator is of an environment apart")
    gymnasium = pytest.importorskip("gymnasium")
    environment = gymnasium.make("InvertedPendulum-v5").unwrapped
    environment.set_state(np.array(POLE_START[:2]), np.array(POLE_START[2:]))
    state = np.array([POLE_START])
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, 12):
        environment.step(np.array([action]))
        state = stepped_by_mujoco(state, np.array([action]))
        np.testing.assert_allclose(state[0], environment._get_obs(), rtol=1e-9, atol=1e-12)


@pytest.mark.filterwarnings("ignore:.*intersection-v0 is out of date:DeprecationWarning")
def test_the_crossing_ends_in_its_own_crash_where_nothing_is_perceived():
    """And in none where everything is; twice the same, and pemviz takes it as it is."""
    pytest.importorskip("highway_env")
    (crossing,) = chosen(["intersection-v0"])
    system = crossing.system()
    for perceived, crashes in ((False, True), (True, False), (False, True)):
        least = system.reset()["room"]
        for _ in range(system.states - 1):
            values, ended = system.step([perceived] * len(system.slots))
            least = min(least, values["room"])
            if ended:
                break
        assert (least < 0.0) == crashes == system.environment.unwrapped.vehicle.crashed
    experiment_of(crossing, configured(crossing, "subset", "done", ()))


def test_an_aircraft_flies_alone_as_it_does_among_many():
    """Also after others: BlueSky keeps nothing of what flew before."""
    pytest.importorskip("bluesky", reason="its simulator is of an environment apart")
    system, pairs = PilotWithDisplay(), Pairs()
    shown = np.random.default_rng(5).random((6, system.states - 1)) < 0.5
    shown[0], shown[1] = True, False
    many = [pairs.begin(6), *(pairs.move(at) for at in shown.T)]
    for row, outcomes in enumerate(shown):
        alone = [system.reset(), *(system.step(bool(seen))[0] for seen in outcomes)]
        for name in many[0]:
            found = [values[name] for values in alone]
            np.testing.assert_array_equal(found, [values[name][row] for values in many])
    rooms = np.min([values["room"] for values in many], axis=0)
    assert rooms[0] > 1.0
    assert rooms[1] < -1.0


def test_windows_of_misses_find_what_enumeration_finds():
    """A walk's 2^18 sequences; within 4.5 standard errors: false alarm 7e-6."""
    motion = WalkBesidePattern(pattern=tuple(range(18)), first=4)
    found, exact = by_windows(motion, count=40_000, seed=3), enumerated(motion).value
    assert found.relative_error < 0.05
    assert abs(found.value / exact - 1.0) < 4.5 * found.relative_error


def test_a_problem_whose_simulator_is_absent_is_left_out(tmp_path, monkeypatch, capsys):
    absent = replace(chosen(["RP55"])[0], needs=("surely_not_there",))
    monkeypatch.setattr("benchmarks.external.study.chosen", lambda _: (absent,))
    assert main(["external", "--problems", "RP55", "--out", str(tmp_path)]) == 0
    assert "RP55 is left out: needs surely_not_there, not installed" in capsys.readouterr().out
    assert not (tmp_path / RUNS).exists()


AT_HAND = [problem for problem in problems() if not problem.missing]


@pytest.mark.parametrize("problem", AT_HAND, ids=lambda problem: problem.name)
def test_pemviz_is_given_what_others_are_given(problem):
    """Rollouts from far-out numbers: the specification's verdict, and g below 0."""
    motion, rng = problem.motion, np.random.default_rng(7)
    normals = rng.uniform(0.3, 3.0, (ROWS, 1)) * rng.standard_normal((ROWS, dimension(motion)))
    normals += rng.standard_normal((ROWS, 1))
    system = MotionSimulator(motion, "x")
    states = begun(system, count=ROWS, start=normals[:, : motion.starts])
    each, trace = motion.noises + motion.misses, [states.signals]
    for step in range(motion.steps):
        now = normals[:, motion.starts + step * each :][:, :each]
        detected = np.ones(ROWS, dtype=np.bool_)
        if motion.misses:
            logit = MotionDetector(motion).logit(system.salient(states.signals))
            detected = ndtr(now[:, -1]) >= expit(-logit)
        states = stepped(system, states, detected, now[:, : motion.noises])
        trace.append(states.signals)
    signals = {name: np.stack([at[name] for at in trace], axis=1) for name in motion.shown}
    experiment = experiment_of(problem, configured(problem, "monte-carlo", "done", ()))
    fails = limit_function(motion)(normals) < 0.0
    np.testing.assert_array_equal(stl.violated(experiment.formula, signals), fails)
    assert fails.any()


def run(estimate, *, problem="a", seed=0, method="m", budget="100", low=None, high=None, warned=()):
    return Run(
        problem=problem, method=method, budget=budget, seed=seed, estimate=estimate, low=low,
        high=high, warned=warned, calls=100, seconds=1.0,
    )  # fmt: skip


def test_what_a_row_counts():
    truths = {"a": 1e-3}
    runs = [
        run(1e-3, low=0.9e-3, high=1.1e-3), run(1.6e-3, low=1.5e-3, high=1.7e-3, seed=1),
        run(0.5e-3, seed=2, warned=("why",)), run(1.05e-3, seed=3, warned=("why",)),
        run(0.0, seed=4, low=0.0, high=0.0), run(None, seed=5), run(1e-9, seed=6),
    ]  # fmt: skip
    (row,) = rows_of(runs, truths)
    assert (row.runs, row.unwarned, row.intervals, row.hold) == (7, 3, 2, 1)
    assert (row.silent, row.right, row.wolf) == (2, 2, 1)
    assert row.ratio == pytest.approx(0.5)
    logs = [0.0, math.log(1.6), math.log(0.5), math.log(1.05), *3 * [math.log(MOST)]]
    assert row.error == pytest.approx(math.sqrt(np.mean(np.square(logs))))
    other = [
        run(1.01e-3, method="b"),
        run(1.3e-3, method="c"),
        run(1e-3, method="c", budget="9000"),
    ]
    (found,) = nearer([row], rows_of(other, truths))
    assert (found.other, found.other_budget, found.ours) == ("b", "100", False)


def test_a_small_study_is_gone_on_with(tmp_path, capsys):
    """Two seeds, then a third: what is there is not run again, what is torn is."""
    words = ["external", "--problems", "RP22", "walk beside a pattern, 0.42 of it", "--processes"]
    words += ["1", "--budget", "240", "--settings", "stages=5", "chains=0", "--out", str(tmp_path)]
    other = tmp_path / "others.jsonl"
    add_run(other, run(4e-3, problem="RP22", method="OpenTURNS: x", budget="240"))
    assert main([*words, "--seeds", "2"]) == 0
    lines = (tmp_path / RUNS).read_text(encoding="utf-8").splitlines()
    assert len(lines) == 4
    marked = {**json.loads(lines[0]), "estimate": 1.0}
    (tmp_path / RUNS).write_text("\n".join([json.dumps(marked), *lines[1:3], lines[3][:30]]) + "\n")
    assert main([*words, "--seeds", "3", "--others", str(other)]) == 0
    runs = read_runs(tmp_path / RUNS)
    assert len(runs) == 6
    assert max(one.estimate for one in runs.values()) == 1.0
    assert all(200 <= one.calls <= 240 for one in runs.values())
    printed = capsys.readouterr().out
    assert "OpenTURNS: x, 240 calls" in printed
    written = json.loads((tmp_path / "external.json").read_text(encoding="utf-8"))
    assert [row["runs"] for row in written["totals"]] == [6, 1]
    assert (tmp_path / "external.md").read_text(encoding="utf-8") in printed


def test_a_budget_in_counts_has_room_for_chains():
    """Small ones have none; nor does what begins in one way and has no noise."""
    (static,), (cart,) = chosen(["RP111"]), chosen(["CartPole, base 5"])
    small = configured(static, "mixture", "1200", ())
    assert (small.chains, learning_budget(small).rollouts) == (0, 1000)  # a fifth more for moves
    large = configured(static, "mixture", "20000", ())
    assert (large.chains, learning_budget(large).rollouts) == (100, 15_083)
    auto = configured(static, "auto", "20000", ())
    assert (auto.max_rollouts, auto.precision) == (20_000, 0.001)  # of all, and spent
    assert configured(static, "auto", "20000", ("precision=0.1",)).precision == 0.1
    assert configured(static, "mixture", "1200", ("chains=30",)).chains == 30
    assert learning_budget(configured(cart, "mixture", "20000", ())).rollouts == 16_666


def test_what_cannot_be_had_is_said(tmp_path, capsys):
    words = ["external", "--problems", "RP22", "--method", "zero-variance", "--seeds", "1"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    assert "zero-variance cannot be had for RP22: " in capsys.readouterr().out
    for study, match in (
        (ExternalStudy(problems=("moon",)), "problems = 'moon'"),
        (ExternalStudy(budget=("some",)), "budget = 'some'"),
        (ExternalStudy(settings=("stages",)), "settings = 'stages'"),
        (ExternalStudy(seeds=0), "seeds"),
    ):
        with pytest.raises(InputError, match=match):
            run_study(replace(study, out=tmp_path))


def test_the_command_lists_problems(capsys):
    assert main(["external", "--list", "--problems", "RP8", "pendulum"]) == 0
    printed = capsys.readouterr().out
    assert "RP8 " in printed
    assert "RP89" not in printed


def counting(function, size, seed):
    """Plain Monte Carlo, as another program's method."""
    fails = function(np.random.default_rng(seed).standard_normal((size, function.dimension))) < 0.0
    return others.Answer(float(fails.mean()), warned=("few",) if fails.sum() < 3 else ())


def raising(function, size, seed):
    function(np.zeros(function.dimension))
    raise ValueError("moon")


def endless(function, size, seed):
    while True:
        function(np.zeros((3, function.dimension)))


def test_others_are_given_their_calls(tmp_path, monkeypatch, capsys):
    """At 4e-2 of 800 within 5 standard errors; what raises or does not end is no answer."""
    methods = {"counting": counting, "raising": raising, "endless": endless}
    monkeypatch.setattr(others, "SIZED", {"counting": counting})
    monkeypatch.setattr(others, "METHODS", methods)
    monkeypatch.setattr(others, "PACKAGES", ())
    out = tmp_path / "others.jsonl"
    words = ["--out", str(out), "--problems", "RP60", "--methods", *methods, "--limit-s", "1"]
    others.main([*words, "--budget", "800", "--seeds", "1"])
    others.main([*words, "--budget", "800", "--seeds", "1"])
    assert len(out.read_text(encoding="utf-8").splitlines()) == 3
    found = {one.method: one for one in read_runs(out).values()}
    assert found["counting"].calls == 800
    assert found["counting"].estimate == pytest.approx(0.0448, abs=5 * math.sqrt(0.0448 / 800))
    assert found["raising"].warned == ("ValueError: moon",)
    assert (found["raising"].estimate, found["raising"].calls) == (None, 1)
    assert found["endless"].warned == ("took longer than 1 s",)


def test_others_take_as_many_calls_as_a_method_took(tmp_path, monkeypatch):
    """And stand beside it, whatever other budgets there are; runs that do not end are given up."""
    monkeypatch.setattr(others, "SIZED", {"counting": counting})
    monkeypatch.setattr(others, "METHODS", {"counting": counting, "endless": endless})
    monkeypatch.setattr(others, "PACKAGES", ())
    ours, out = tmp_path / RUNS, tmp_path / "others.jsonl"
    for seed, calls in enumerate((500, 700)):
        one = run(0.05, problem="RP60", method="auto", budget=DONE, seed=seed)
        add_run(ours, replace(one, calls=calls))
    words = ["--out", str(out), "--problems", "RP60", "RP8", "--limit-s", "1", "--seeds", "3"]
    others.main([*words, "--like", str(ours), "--methods", "counting", "endless"])
    found = list(read_runs(out).values())
    assert {(one.problem, one.budget) for one in found} == {("RP60", as_took("auto"))}
    assert [one.calls for one in found if one.method == "counting"] == [600] * 3
    assert sum(one.is_endless for one in found) == others.TOO_LONG
    far = replace(found[0], budget="1200", estimate=0.04483969)
    rows = rows_of([*read_runs(ours).values(), *found, far], {"RP60": 0.04483969})
    mine = next(row for row in rows if row.method == "auto")
    there = beside(mine, [row for row in rows if row.method != "auto"])
    assert {(row.method, row.budget) for row in there} >= {("counting", as_took("auto"))}
    assert all(row.budget == as_took("auto") for row in there)


def test_others_need_no_pemviz():
    code = "import sys, benchmarks.external.others; print('pemviz' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "False\n"
