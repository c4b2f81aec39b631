"""A scenario whose failure probability is a binomial tail."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from pemviz.sampling.mixture import rejuvenated, resampled
from pemviz.sampling.particles.method import ParticleSampling
from pemviz.sampling.splitting.run import Splitting
from pemviz.sampling.subset.run import SubsetSimulation
from pemviz.types import Signal, StateBatch

ALLOWED_MISSES = 3


@dataclass(frozen=True)
class MissCounter:
    """The gap starts at 3.5 m and every miss costs 1 m: the fourth makes it negative."""

    states: int
    dt_s: float = 0.1
    name: str = "miss-counter"

    @property
    def signals(self) -> tuple[Signal, ...]:
        return (Signal(name="gap", key="gap_m", unit="m", low=-10.0, high=10.0),)

    def initial(self, *, count: int) -> StateBatch:
        gap_m = np.full(count, ALLOWED_MISSES + 0.5)
        return StateBatch(step=np.zeros((), dtype=np.int64), signals={"gap": gap_m})

    def step(self, states: StateBatch, detected: np.ndarray) -> StateBatch:
        return StateBatch(step=states.step + 1, signals={"gap": states.signals["gap"] - ~detected})

    def salient(self, signals: Mapping[str, np.ndarray]) -> np.ndarray:
        return signals["gap"][..., None]


@dataclass(frozen=True)
class FunctionPem:
    """An error model that is nothing but its logit."""

    logit: Callable[[np.ndarray], np.ndarray]
    name: str = "function"
    digest: str = ""
    data: str = "nothing"
    licence: str = "none"


def constant_pem(*, detection_probability: float):
    logit = np.log(detection_probability) - np.log1p(-detection_probability)
    return FunctionPem(lambda salient: np.full(salient.shape[:-1], logit))


def exact_failure_probability(*, steps: int, miss_probability: float) -> float:
    """P(more misses than allowed)."""
    return float(stats.binom.sf(ALLOWED_MISSES, steps, miss_probability))


@dataclass(frozen=True)
class ConstantPem:
    """Misses with one probability everywhere."""

    miss_probability: float
    digest: str = ""
    data: str = "nothing"
    licence: str = "none"

    @property
    def name(self):
        return f"miss-{self.miss_probability}"

    def logit(self, salient):
        value = math.log1p(-self.miss_probability) - math.log(self.miss_probability)
        return np.full(np.shape(salient)[:-1], value)


def splitting_runs(**settings):
    """Method splitting: ``stages`` runs of ``rollouts`` particles, with a ``seed``."""
    return ParticleSampling(name="splitting", of=Splitting(), **settings)


def subset_runs(**settings):
    """Method subset, likewise."""
    return ParticleSampling(name="subset", of=SubsetSimulation(), **settings)


def stepped_through(method, problem, state=None, *, repetition=0):
    """The last state of a repetition, from its start or a given state on, and its stages."""
    state = method.init(problem, repetition=repetition) if state is None else state
    stages = []
    while not method.is_done(state):
        state, stage = method.step(problem, state)
        stages.append(stage)
    return state, stages


def carried_out(method, problem, *, repetition=0):
    """The estimate of a repetition, and its stages."""
    state, stages = stepped_through(method, problem, repetition=repetition)
    return method.estimate(state), stages


def simulated_in(stages):
    """Rollouts of a repetition's stages, and those that violations were moved by."""
    moved = rejuvenated.SIMULATED, resampled.SIMULATED
    return sum(
        stage.count + sum(int(stage.kept.get(name, 0)) for name in moved) for stage in stages
    )


def estimate_of(method, problem, *, repetition=0):
    return carried_out(method, problem, repetition=repetition)[0]
