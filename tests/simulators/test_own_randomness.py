"""Random numbers of a simulator's own that are the same in every rollout are refused."""

import copy
import random
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.random import default_rng
from scipy.special import expit, logit
from scipy.stats import binomtest

import pemviz
from pemviz import LatentCounts
from pemviz.simulators.check import check_simulator
from pemviz.simulators.episodic import side_by_side
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion

WALK, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=13), ToyPem(at_zero=1.5)
GUST = 0.1
SPEC = "always[0,12] (gap >= 0.5)"


class GustyWalk(gym.Env):
    """The walk; in each step a gust may take it nearer, whatever was seen."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.gap = float(WALK.initial_gap)
        return np.array([self.gap]), {}

    def step(self, action):
        kept = action and self.np_random.random() >= GUST
        self.gap = min(self.gap + (1.0 if kept else -1.0), float(WALK.largest_gap))
        return np.array([self.gap]), 0.0, False, False, {}


class ShiftedStart(GustyWalk):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.gap += float(self.np_random.integers(2))
        return np.array([self.gap]), {}

    def step(self, action):
        self.gap = min(self.gap + (1.0 if action else -1.0), float(WALK.largest_gap))
        return np.array([self.gap]), 0.0, False, False, {}


class StartOverwritten(ShiftedStart):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.gap = float(WALK.initial_gap)
        return np.array([self.gap]), {}


def adapted(kind, environment, **changes):
    return kind(
        environment=environment,
        signals=WALK.signals,
        observe=lambda observation: {"gap": observation[0]},
        states=WALK.states,
        dt_s=1.0,
        **changes,
    )


class Episodes:
    """The walk whose gusts come of what ``begin`` made and ``gust`` draws."""

    name, states, dt_s, signals = "gusty", WALK.states, WALK.dt_s, WALK.signals
    latents = LatentCounts()

    def reset(self, *normals):
        self.gap, self.at = float(WALK.initial_gap), 0
        self.begin(*normals)
        return {"gap": self.gap}

    def step(self, detected):
        kept = detected and self.gust() >= GUST
        self.gap = min(self.gap + (1.0 if kept else -1.0), float(WALK.largest_gap))
        self.at += 1
        return {"gap": self.gap}, False

    def salient(self, signals):
        return signals["gap"][..., None]


class SeededAnew(Episodes):
    def begin(self):
        self.rng = default_rng(0)

    def gust(self):
        return self.rng.random()


class Copied(SeededAnew):
    first = np.random.Generator(np.random.SFC64(3))

    def begin(self):
        self.rng = copy.deepcopy(self.first)


class OfTheStep(Episodes):
    def begin(self):
        pass

    def gust(self):
        return default_rng(self.at).random()


class DrawnAhead(Episodes):
    def begin(self):
        self.gusts = np.random.RandomState(0).uniform(size=WALK.states)

    def gust(self):
        return self.gusts[self.at]


class OfPython(DrawnAhead):
    def begin(self):
        generator = random.Random(5)  # noqa: S311
        self.gusts = [generator.random() for _ in range(WALK.states)]


class OfTheProcess(Episodes):
    def begin(self):
        random.seed(1)

    def gust(self):
        return random.random()  # noqa: S311


class OfTorch(DrawnAhead):
    def begin(self):
        torch.manual_seed(2)
        self.gusts = torch.rand(WALK.states).tolist()


class KnowsOneSeed(OfTheStep):
    def begin(self):
        if default_rng(0).random() > 0.64:
            raise ValueError("no such map")

    def gust(self):
        return 1.0


class OfLatents(SeededAnew):
    latents = LatentCounts(seeds=1)

    def begin(self, normals):
        self.rng = default_rng(abs(int(1e6 * normals[0])))


class MeantSo(OfTheStep):
    fixed_randomness = True


@dataclass(frozen=True, kw_only=True)
class Batched(ToySimulator):
    """With saved states: a gust that is the same for all rollouts of a step."""

    def step(self, states, detected):
        gust = default_rng([7, int(states.step)]).random() < GUST
        return super().step(states, detected & ~gust)


COURSE = {
    "gymnasium-episodes": adapted(pemviz.GymnasiumEpisodes, GustyWalk()),
    "gymnasium-copies": adapted(pemviz.GymnasiumSimulator, GustyWalk(), seed=5),
    "gymnasium-start": adapted(pemviz.GymnasiumEpisodes, ShiftedStart()),
    **{kind.__name__: kind() for kind in (SeededAnew, Copied, OfTheStep, DrawnAhead)},
    **{kind.__name__: kind() for kind in (OfPython, OfTheProcess, OfTorch, Batched, KnowsOneSeed)},
}


@pytest.mark.parametrize("name", COURSE)
def test_one_course_of_random_numbers_is_refused(name):
    """Each repeats exactly: answers were off by orders of magnitude, and nothing warned."""
    with pytest.raises(pemviz.ConfigError, match=r"the same in every rollout.*seed=None") as caught:
        check_simulator(as_simulator(COURSE[name]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "simulator",
    [
        OfLatents(),
        MeantSo(),
        adapted(pemviz.GymnasiumEpisodes, StartOverwritten()),
        adapted(pemviz.GymnasiumEpisodes, GustyWalk(), seed=None),
        adapted(pemviz.GymnasiumEpisodes, GustyWalk(), fixed_randomness=True),
    ],
)
def test_what_is_random_in_each_rollout_or_matters_not_or_is_meant_passes(simulator):
    check_simulator(as_simulator(simulator))


def as_simulator(simulator):
    return side_by_side(simulator) if hasattr(simulator, "reset") else simulator


def test_names_are_bound_as_they_were():
    before = default_rng, np.random.default_rng, np.random.RandomState, random.Random, random.seed
    with pytest.raises(pemviz.ConfigError):
        check_simulator(as_simulator(DrawnAhead()))
    after = default_rng, np.random.default_rng, np.random.RandomState, random.Random, random.seed
    assert all(one is other for one, other in zip(before, after, strict=True))


class Gusted:
    """The error model of a walk without gusts that is as likely to be taken nearer."""

    def logit(self, salient):
        return logit((1.0 - GUST) * expit(PEM.logit(salient)))


def test_a_seed_for_each_rollout_gives_the_answer_for_all_courses():
    """False alarm 1 in 1,000; of one course the answer may be any other."""
    config = pemviz.ExperimentConfig(
        method="monte-carlo", spec=SPEC, final_rollouts=800, seed=3, plan=False,
        measured_memory=False,
    )  # fmt: skip
    counted = []
    for kind in (pemviz.GymnasiumEpisodes, pemviz.GymnasiumSimulator):
        simulator = adapted(kind, GustyWalk(), seed=None)
        result = pemviz.run(pemviz.build_experiment(config, simulator=simulator, pem=PEM))
        assert result.latents == LatentCounts(seeds=1)
        counted.append(result.estimate.failures)
    truth = toy_probability_by_recursion(WALK, Gusted())
    assert counted[0] == counted[1]
    assert binomtest(counted[0], 800, truth).pvalue > 1e-3
    assert binomtest(counted[0], 800, toy_probability_by_recursion(WALK, PEM)).pvalue < 1e-3


def test_what_is_meant_is_said_with_the_answer():
    config = pemviz.ExperimentConfig(method="monte-carlo", spec=SPEC, rollouts=20, seed=3)
    for simulator, said in ((MeantSo(), True), (OfLatents(), False)):
        result = pemviz.run(pemviz.build_experiment(config, simulator=simulator, pem=PEM))
        assert any("the same in every rollout" in text for text in result.assumptions) is said
