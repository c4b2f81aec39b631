"""Whether more workers bring as much more, of a simulator whose rollouts take very differently.

A rollout sleeps, and one in fifty much longer. Threads are the workers, as they sleep side by side
on few cores: what is measured is how work is handed out, not how fast a process starts.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import ndtr

import pemviz
from benchmarks.figures import Figure
from pemviz import BoolArray, FloatArray, LatentCounts, Signal, StateBatch
from pemviz.sampling.rollouts.pooled import PooledRunner

OFTEN_S, SELDOM_S, SELDOM = 0.2, 5.0, 0.02
GAP = Signal(name="gap", key="gap_m", unit="m", low=-5.0, high=5.0)


@dataclass(frozen=True)
class Sleeps:
    """A walk; in its first step each rollout sleeps, by its latent [s] times ``scale``.

    Attributes:
        scale: 0: none sleeps.
        slept_s: How long each batch was to sleep; written to.
    """

    scale: float
    slept_s: list[float] = field(default_factory=list[float])
    name = "sleeps"
    states = 5
    dt_s = 0.1
    signals = (GAP,)
    latents = LatentCounts(start=1)

    def initial(self, *, count: int, start: FloatArray) -> StateBatch:
        """All at a gap of 1 m; who sleeps long is in memory."""
        long = (ndtr(start[:, 0]) < SELDOM).astype(np.float64)
        at = np.ones(count)
        return StateBatch(np.zeros((), np.int64), signals={"gap": at}, memory={"long": long})

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """Nearer where missed."""
        if int(states.step) == 0 and self.scale:
            took_s = OFTEN_S + (SELDOM_S - OFTEN_S) * states.memory["long"]
            self.slept_s.append(float(took_s.sum()) * self.scale)
            time.sleep(self.slept_s[-1])
        gap = states.signals["gap"] + np.where(detected, 0.1, -0.3)
        return StateBatch(step=states.step + 1, signals={"gap": gap}, memory=states.memory)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The gap."""
        return signals["gap"][..., None]


class Even:
    """Misses half of the time."""

    def logit(self, salient: FloatArray) -> FloatArray:
        """0 everywhere."""
        return np.zeros(salient.shape[:-1])


def slow_rollout_figures(
    *, workers: Sequence[int] = (4, 16, 64), rollouts: int = 6400, scale: float = 1.0
) -> Sequence[Figure]:
    """The share of linear that each number of workers reaches.

    Args:
        workers: How many.
        rollouts: Of a plain run.
        scale: Of all times.
    """
    config = pemviz.ExperimentConfig(
        method="monte-carlo", spec="always[0,4] (gap >= 0.0)", final_rollouts=rollouts, seed=1
    )
    # tried without sleep
    tried = pemviz.build_experiment(config, simulator=Sleeps(0.0), pem=Even())
    figures: list[Figure] = []
    for count in workers:
        with ThreadPoolExecutor(count) as pool:
            runner = PooledRunner(pool.submit, count)
            simulator = Sleeps(scale)
            problem = replace(tried.problem, simulator=simulator, run_batches=runner)
            began = time.perf_counter()
            pemviz.run(replace(tried, problem=problem))
            took_s = time.perf_counter() - began
        figures.append(
            Figure(
                f"slow rollouts by {count} workers, of linear",
                sum(simulator.slept_s) / count / took_s,
                goal="at least 0.85",
            )
        )
    return figures
