"""Environments that can only be reset and stepped, against the same system with saved states."""

import copy
from concurrent.futures import Future
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import pytest

import pemviz
from pemviz import LatentCounts, StateBatch
from pemviz.errors import ConfigError, RunError
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.simulators.episodic import SideBySide
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion
from tests.slot_toys import CAMERA, TwoCars

WALK, PEM = ToySimulator(initial_gap=5, states=15), ToyPem(at_zero=2.5)
SPEC = "always[0,14] (gap >= 0.5)"


class WalkEpisodes:
    """The lattice walk in one place, whose steps are counted."""

    name, states, dt_s, signals = "walk-episodes", WALK.states, WALK.dt_s, WALK.signals
    stepped = 0

    def reset(self):
        self.gap = float(WALK.initial_gap)
        return {"gap": self.gap}

    def step(self, detected):
        WalkEpisodes.stepped += 1
        self.gap = min(self.gap + (1.0 if detected else -1.0), float(WALK.largest_gap))
        return {"gap": self.gap}, False

    def salient(self, signals):
        return signals["gap"][..., None]


class StopsAtZero(WalkEpisodes):
    def step(self, detected):
        values, _ = super().step(detected)
        return values, self.gap <= 0.0


class CarsEpisodes:
    """Two cars, each step that of the simulator with saved states."""

    cars = TwoCars(starts=(3, 4), states=11, in_view=3)
    name, states, dt_s = "cars-episodes", cars.states, cars.dt_s
    signals, slots = cars.signals, cars.slots

    def reset(self):
        self.here = self.cars.initial(count=1)
        return self._shown()

    def step(self, detected):
        assert len(detected) == 2
        self.here = self.cars.step(self.here, np.array([detected]))
        return self._shown(), False

    def _shown(self):
        return {name: float(values[0]) for name, values in self.here.signals.items()}

    def salient(self, signals):
        return self.cars.salient(signals)

    def present(self, signals):
        return self.cars.present(signals)


@dataclass(frozen=True)
class GustyWalk(ToySimulator):
    """Starts at random and is blown about; with saved states."""

    @property
    def latents(self):
        return LatentCounts(start=1, noise=2)

    def initial(self, *, count, start):
        gap = WALK.initial_gap + np.round(start[:, 0])
        return StateBatch(step=np.zeros((), dtype=np.int64), signals={"gap": gap})

    def step(self, states, detected, noise):
        moved = super().step(states, detected)
        return replace(moved, signals={"gap": moved.signals["gap"] + 0.1 * noise.sum(axis=1)})


class GustyEpisodes(WalkEpisodes):
    latents = LatentCounts(start=1, noise=2)

    def reset(self, start):
        self.gap = float(WALK.initial_gap) + float(np.round(start[0]))
        return {"gap": self.gap}

    def step(self, detected, noise):
        super().step(detected)
        self.gap += 0.1 * float(noise[0] + noise[1])
        return {"gap": self.gap}, False


def run_of(simulator, *, spec=SPEC, pem=PEM, **settings):
    settings = {"method": "mixture", "stages": 3, "rollouts": 40, "final_rollouts": 50} | settings
    config = pemviz.ExperimentConfig(spec=spec, seed=3, plan=False, **settings)
    return pemviz.build_experiment(config, simulator=simulator, pem=pem)


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_the_estimate_is_that_with_saved_states_at_a_step_each(count):
    saved = pemviz.run(run_of(WALK)).estimate
    experiment = run_of(pemviz.side_by_side(WalkEpisodes, count))
    before = WalkEpisodes.stepped
    result = pemviz.run(experiment)
    found = result.estimate
    assert found == saved
    assert found.failures > 0
    repeated = len(result.stages)  # one of each stage, to see whether it is the same again
    rollouts = found.rollouts_simulated + repeated
    assert WalkEpisodes.stepped - before == rollouts * (WALK.states - 1)


def test_it_is_so_with_slots_memory_and_trackers():
    spec = "always[0,10] (gap_a >= 0.5 and gap_b >= 0.5)"
    tracker = pemviz.Tracker(dt_s=CarsEpisodes.dt_s, coast_s=1.0)
    parts = {"spec": spec, "pem": CAMERA, "memory_s": 1.0, "stages": 1}
    for wrapped in (lambda one: one, lambda one: pemviz.tracked(one, tracker)):
        saved = pemviz.run(run_of(wrapped(CarsEpisodes.cars), **parts)).estimate
        episodes = wrapped(pemviz.side_by_side(CarsEpisodes, 6))
        # a tracked scenario does not say where it reacts, and neither do the cars
        assert pemviz.run(run_of(episodes, **parts)).estimate == saved
        assert saved.failures > 0


@pytest.mark.parametrize("memory_s", [0.0, 2.0])
def test_it_is_so_where_obstacles_differ(memory_s):
    parts = {"frailty": 0.7, "memory_s": memory_s, "method": "naive"}
    saved = pemviz.run(run_of(WALK, **parts)).estimate
    assert pemviz.run(run_of(pemviz.side_by_side(WalkEpisodes, 7), **parts)).estimate == saved
    assert saved.failures > 0


def test_it_is_so_in_two_worker_processes():
    experiment = run_of(pemviz.side_by_side(WalkEpisodes, 3), stages=1)
    here, stepped = pemviz.run(experiment), WalkEpisodes.stepped
    there = pemviz.run(experiment, workers=2)
    assert there.estimate == here.estimate
    assert there.least_robust == here.least_robust
    assert WalkEpisodes.stepped == stepped, "no step is done in this process"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"workers": 0}, "workers = 0: must be at least 1"),
        ({"workers": 2, "scheduler": "tcp://x:1"}, "give only one of them"),
        ({"scheduler": "no-address:"}, "cannot be reached"),
    ],
)
def test_workers_that_cannot_be_are_refused_before_anything_is_simulated(settings, words):
    experiment, stepped = run_of(WalkEpisodes()), WalkEpisodes.stepped
    with pytest.raises(ConfigError, match=words):
        pemviz.run(experiment, **settings)
    assert WalkEpisodes.stepped == stepped


def test_a_program_is_shown_how_far_a_run_is(capsys):
    pemviz.run(run_of(WALK), progress=True)
    assert "stage 1, threshold" in capsys.readouterr().err
    pemviz.run(run_of(WALK))
    assert capsys.readouterr().err == ""


def test_it_is_so_with_latents():
    spec = "always[0,14] (gap >= 0.5)"
    simulator = GustyWalk(initial_gap=5, states=15)
    # environments are not searched by chains unless that is asked for
    saved = pemviz.run(run_of(simulator, spec=spec, chains=0)).estimate
    found = pemviz.run(run_of(pemviz.side_by_side(GustyEpisodes, 4), spec=spec)).estimate
    assert found.probability == pytest.approx(saved.probability, rel=1e-12)
    assert saved.failures > 0


def test_an_episode_that_ended_is_not_stepped_and_keeps_its_signals():
    simulator = pemviz.side_by_side([StopsAtZero(), StopsAtZero()])
    before, states = WalkEpisodes.stepped, simulator.initial(count=2)
    gaps = []
    for _ in range(WALK.states - 1):
        states = simulator.step(states, np.array([False, True]))
        gaps.append(states.signals["gap"].tolist())
    assert [gap for gap, _ in gaps] == [4.0, 3.0, 2.0, 1.0] + [0.0] * 10
    assert WalkEpisodes.stepped - before == 5 + 14


def test_subset_simulation_agrees_with_the_recursion():
    """Environments that can only be reset: five standard errors, false alarm 6e-7."""
    pem = ToyPem(at_zero=2.0)
    settings = {"pem": pem, "method": "subset", "stages": 8, "rollouts": 400}
    found = pemviz.run(run_of(pemviz.side_by_side(WalkEpisodes, 50), **settings)).estimate
    truth = toy_probability_by_recursion(WALK, pem)
    assert 1e-3 < truth < 1.1e-3
    assert found.std_error is not None
    assert found.std_error < 0.2 * truth
    assert abs(found.probability - truth) < 5.0 * found.std_error
    assert found.ci_low < truth < found.ci_high
    assert found == pemviz.run(run_of(WALK, **settings)).estimate


@pytest.mark.parametrize("saved", [GustyWalk(), TwoCars(starts=(3, 4), states=11, in_view=3)])
def test_subset_simulation_gives_what_it_gives_with_saved_states(saved):
    """Latents and slots: to the last bit, whatever comes back at a time."""
    latents = isinstance(saved, GustyWalk)
    spec = SPEC if latents else "always[0,10] (gap_a >= 0.5 and gap_b >= 0.5)"
    settings = {
        "spec": spec,
        "pem": PEM if latents else CAMERA,
        "method": "subset",
        "stages": 2,
        "rollouts": 40,
    }
    kind = GustyEpisodes if latents else CarsEpisodes
    found = pemviz.run(run_of(pemviz.side_by_side(kind, 7), **settings)).estimate
    assert found == pemviz.run(run_of(saved, **settings)).estimate
    assert found.rollouts_simulated > 80


def test_states_cannot_be_gone_on_from():
    simulator = pemviz.side_by_side(WalkEpisodes, 2)
    start = simulator.initial(count=2)
    simulator.step(start, np.array([True, True]))
    for states in (start, start.take(np.array([1, 0]))):
        with pytest.raises(RunError, match="is episodic: its states cannot be gone on from"):
            simulator.step(states, np.array([True, True]))


@pytest.mark.parametrize(
    "settings", [{"method": "splitting"}, {"method": "zero-variance"}, {"reference": True}]
)
def test_what_goes_on_from_kept_states_is_refused_in_one_line(settings):
    with pytest.raises(ConfigError, match="goes on from kept states, and simulator 'walk-ep"):
        run_of(WalkEpisodes(), **settings)


def test_a_twin_is_refused():
    config = pemviz.ExperimentConfig(spec=SPEC, method="zero-variance")
    with pytest.raises(ConfigError, match="twin of simulator 'walk-episodes': it is episodic"):
        pemviz.build_experiment(config, simulator=WalkEpisodes(), pem=PEM, twin=WALK)


class Drifts(WalkEpisodes):
    """Does not begin anew after a reset."""

    gap = 5.0

    def reset(self):
        self.gap -= 0.25
        return {"gap": self.gap}


class Other(WalkEpisodes):
    def reset(self):
        return {"speed": 0.0}


class NotANumber(WalkEpisodes):
    def step(self, detected):
        return {"gap": float("nan")}, False


class LostFarOut(WalkEpisodes):
    def step(self, detected):
        values, ended = super().step(detected)
        far = self.gap <= WALK.initial_gap - 10
        return ({"gap": float("nan")} if far else values), ended


def test_a_value_that_is_no_number_is_the_simulators_where_no_trial_episode_met_it():
    """Ten misses more than detections are in no trial of its own, but where the model is tried."""
    words = r"^simulator walk-episodes: gap is nan in rollout 0, step 10: must be a finite number$"
    with pytest.raises(pemviz.InputError, match=words):
        run_of(LostFarOut())


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (Drifts(), "an episode must be the same again after a reset with the same outcomes"),
        (Other(), r"reset or step gives \['speed'\], signals declare \['gap'\]"),
        (NotANumber(), "gap must be finite numbers"),
        (WalkEpisodes, "WalkEpisodes is a class: give an instance of it"),
    ],
)
def test_what_does_not_keep_to_it_is_told_in_one_line(made, words):
    with pytest.raises(ConfigError, match=words) as raised:
        run_of(made)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("environments", "count", "words"),
    [
        ([], 1, "environments: must be one at least"),
        (lambda: WALK, 2, "make gives a ToySimulator: must be a pemviz.EpisodicSimulator"),
        (WalkEpisodes, 0, "count = 0: must be at least 1"),
    ],
)
def test_what_makes_no_environments_is_refused(environments, count, words):
    with pytest.raises(ConfigError, match=words):
        pemviz.side_by_side(environments, count)


def test_another_process_has_environments_of_its_own_and_keeps_them():
    """A worker unpickles the simulator with every piece; here it does so in this process."""

    seen: list[SideBySide] = []

    def submit(function, simulator, *others):
        there = copy.deepcopy(simulator)  # by the same two methods as pickling
        seen.append(there.scenario if hasattr(there, "scenario") else there)
        future = Future()
        future.set_result(function(there, *others))
        return future

    experiment = run_of(pemviz.side_by_side(WalkEpisodes, 2), method="naive")
    problem = replace(experiment.problem, run_batches=PooledRunner(submit, 3))
    state, _ = experiment.method.step(problem, experiment.method.init(problem, repetition=0))
    assert experiment.method.estimate(state) == pemviz.run(experiment).estimate
    assert len(seen) > 1
    assert len({id(one.example) for one in seen}) == 1
    assert seen[0].example is not experiment.problem.simulator


class Crossing(gymnasium.Env):
    """The two cars as an environment that is told by name which of them are detected."""

    action_space = gymnasium.spaces.Dict(
        {slot.name: gymnasium.spaces.Discrete(2) for slot in CarsEpisodes.slots}
    )
    observation_space = gymnasium.spaces.Box(-20.0, 20.0, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.cars = CarsEpisodes()
        return np.array(list(self.cars.reset().values())), {}

    def step(self, action):
        assert self.action_space.contains(action)
        values, _ = self.cars.step([bool(action[slot.name]) for slot in CarsEpisodes.slots])
        return np.array(list(values.values())), 0.0, False, False, {}


def test_gymnasium_environments_are_reset_and_stepped_with_a_dict_of_detections():
    cars = CarsEpisodes.cars
    spec = "always[0,10] (gap_a >= 0.5 and gap_b >= 0.5)"
    parts = {"spec": spec, "pem": CAMERA, "stages": 1}
    episodes = pemviz.GymnasiumSlotEpisodes(
        environment=Crossing(), signals=cars.signals, slots=cars.slots, states=cars.states,
        dt_s=cars.dt_s, observe=lambda seen: dict(zip(("gap_a", "gap_b"), seen, strict=True)),
        action_of=pemviz.named_detections_action(cars.slots), present_of=cars.present,
    )  # fmt: skip
    assert (
        pemviz.run(run_of(episodes, **parts)).estimate == pemviz.run(run_of(cars, **parts)).estimate
    )
