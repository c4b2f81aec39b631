"""Whether more workers bring as much more, of a simulator whose rollouts take very differently.

A rollout sleeps, and one in fifty much longer. Threads are the workers, as they sleep side by side
on few cores: what is measured is how work is handed out, not how fast a process starts.
"""

import statistics
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logit, ndtr

import pemviz
from benchmarks.figures import Figure
from pemviz import BoolArray, FloatArray, LatentCounts, Signal, StateBatch
from pemviz.sampling.rollouts.pooled import PooledRunner

OFTEN_S, SELDOM_S, SELDOM = 0.2, 5.0, 0.02
GOAL = "at least 0.85"
GAP = Signal(name="gap", key="gap_m", unit="m", low=-5.0, high=5.0)


@dataclass(frozen=True)
class Sleeps:
    """A walk; in its first step each rollout sleeps, by its latent [s] times ``scale``.

    Attributes:
        scale: 0: none sleeps.
        seldom: How often it is for long.
        slept_s: How long each rollout was to sleep; written to.
    """

    scale: float
    seldom: float = SELDOM
    slept_s: list[float] = field(default_factory=list[float])
    name = "sleeps"
    states = 5
    dt_s = 0.1
    signals = (GAP,)
    latents = LatentCounts(start=1)

    def initial(self, *, count: int, start: FloatArray) -> StateBatch:
        """All at a gap of 1 m; who sleeps long is in memory."""
        long = (ndtr(start[:, 0]) < self.seldom).astype(np.float64)
        at = np.ones(count)
        return StateBatch(np.zeros((), np.int64), signals={"gap": at}, memory={"long": long})

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """Nearer where missed."""
        if int(states.step) == 0 and self.scale:
            took_s = self.scale * (OFTEN_S + (SELDOM_S - OFTEN_S) * states.memory["long"])
            self.slept_s.extend(took_s.tolist())
            time.sleep(took_s.sum())
        gap = states.signals["gap"] + np.where(detected, 0.1, -0.3)
        return StateBatch(step=states.step + 1, signals={"gap": gap}, memory=states.memory)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The gap."""
        return signals["gap"][..., None]


@dataclass(frozen=True)
class Same:
    """Detects with the same probability everywhere."""

    detected: float

    def logit(self, salient: FloatArray) -> FloatArray:
        """Its logit."""
        return np.full(salient.shape[:-1], logit(self.detected))


def slow_rollout_figures(
    *, workers: Sequence[int] = (4, 16, 64), rollouts: int = 6400, scale: float = 1.0
) -> Sequence[Figure]:
    """The share of linear that each number of workers reaches.

    Args:
        workers: How many.
        rollouts: Of a plain run.
        scale: Of all times.
    """
    default = pemviz.ExperimentConfig(spec="always[0,4] (gap >= 0.0)", seed=1, plan=False)
    plain = replace(default, method="monte-carlo", final_rollouts=rollouts)
    uneven = Sleeps(scale), Same(detected=0.5), f"{rollouts} plain rollouts, one in fifty long"
    even = Sleeps(scale, seldom=0.0), Same(detected=0.999), "auto, none longer than others"
    figures: list[Figure] = []
    for count in workers:
        for config, (simulator, pem, name) in ((plain, uneven), (default, even)):
            awake = replace(simulator, scale=0.0, slept_s=[])
            tried = pemviz.build_experiment(config, simulator=awake, pem=pem)
            with ThreadPoolExecutor(count) as pool:
                runner = PooledRunner(pool.submit, count)
                problem = replace(tried.problem, simulator=simulator, run_batches=runner)
                began = time.perf_counter()
                result = pemviz.run(replace(tried, problem=problem))
                took_s = time.perf_counter() - began
            # what was simulated ahead in vain, or again, is no gain
            assert result.estimate is not None  # noqa: S101  the run is done
            needed_s = result.estimate.rollouts_simulated * statistics.fmean(simulator.slept_s)
            simulator.slept_s.clear()
            of_linear = needed_s / count / took_s
            figures.append(Figure(f"{name}: {count} workers, of linear", of_linear, goal=GOAL))
    return figures
