"""Scenarios with latents whose failure probabilities are known in closed form or by recursion."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import expit, ndtr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.latents import LatentCounts
from pemviz.simulators.slots import Slot
from pemviz.types import Signal, StateBatch
from tests.lattice_walk import GAP, ToyPem, ToySimulator, toy_probability_by_recursion

ZERO = np.zeros((), dtype=np.int64)
DISTANCE = Signal(name="distance", key="distance_m", unit="m", low=-50.0, high=50.0)
LARGEST = Signal(name="largest", key="largest_m", unit="m", low=-50.0, high=50.0)


@dataclass(frozen=True, kw_only=True)
class Drift:
    """A distance that starts at random, and to which noise and misses add.

    At the end it is normal around the sum of misses, whose number is binomial. It violates where
    it is above a limit at the last step.
    """

    start_sd_m: float = 0.5
    noise_sd_m: float = 0.2
    miss_m: float = 0.0
    states: int = 17
    name: str = "drift"
    dt_s: float = 0.1

    @property
    def latents(self) -> LatentCounts:
        return LatentCounts(start=int(self.start_sd_m > 0.0), noise=int(self.noise_sd_m > 0.0))

    @property
    def signals(self):
        return (DISTANCE,)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        found = np.zeros(count) if start is None else self.start_sd_m * start[:, 0]
        return StateBatch(step=ZERO, signals={"distance": found})

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        after = states.signals["distance"] + np.where(detected, 0.0, self.miss_m)
        if noise is not None:
            after = after + self.noise_sd_m * noise[:, 0]
        return StateBatch(step=states.step + 1, signals={"distance": after})

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return signals["distance"][..., None]

    def spec(self, limit_m: float) -> str:
        return f"eventually[{self.states - 1},{self.states - 1}] (distance <= {limit_m!r})"

    def probability(self, limit_m: float, *, miss: float) -> float:
        """Of a violation, with misses of probability ``miss``."""
        steps = self.states - 1
        misses = np.arange(steps + 1)
        sd_m = np.hypot(self.start_sd_m, self.noise_sd_m * np.sqrt(steps))
        beyond = stats.norm.sf((limit_m - self.miss_m * misses) / sd_m)
        return float(stats.binom.pmf(misses, steps, miss) @ beyond)


GUSTS_M = (-1.0, -0.25, 0.0, 0.25, 1.0)
GUST_SHARES = (0.02, 0.3, 0.36, 0.3, 0.02)


@dataclass(frozen=True, kw_only=True)
class Gusts(Drift):
    """A drift by gusts of five sizes, those far out rare, from 0."""

    start_sd_m: float = 0.0
    name: str = "gusts"

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        assert noise is not None
        place = np.searchsorted(np.cumsum(GUST_SHARES)[:-1], ndtr(noise[:, 0]))
        after = states.signals["distance"] + np.array(GUSTS_M)[place]
        return StateBatch(step=states.step + 1, signals={"distance": after})

    def probability(self, limit_m: float, *, miss: float = 0.0) -> float:
        """The distribution of the sum, in quarters, by convolution."""
        each = np.zeros(9)
        each[[4 + round(4.0 * gust_m) for gust_m in GUSTS_M]] = GUST_SHARES
        of_sum = np.ones(1)
        for _ in range(self.states - 1):
            of_sum = np.convolve(of_sum, each)
        quarters = np.arange(of_sum.size) - of_sum.size // 2
        return float(of_sum[quarters > 4.0 * limit_m].sum())


@dataclass(frozen=True, kw_only=True)
class LargestError:
    """Violates where a step's error, with ``needs_miss`` a missed one's, is above a limit."""

    needs_miss: bool = False
    states: int = 17
    name: str = "largest-error"
    dt_s: float = 0.1
    latents = LatentCounts(noise=1)

    @property
    def signals(self):
        return (LARGEST,)

    def initial(self, *, count: int) -> StateBatch:
        return StateBatch(step=ZERO, signals={"largest": np.full(count, -9.0)})

    def step(self, states: StateBatch, detected: BoolArray, noise: FloatArray) -> StateBatch:
        error = np.where(detected & self.needs_miss, -9.0, noise[:, 0])
        return StateBatch(
            step=states.step + 1,
            signals={"largest": np.maximum(states.signals["largest"], error)},
        )

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return signals["largest"][..., None]

    def spec(self, limit: float) -> str:
        return f"always[0,{self.states - 1}] (largest <= {limit!r})"

    def probability(self, limit: float, *, miss: float) -> float:
        each = stats.norm.sf(limit) * (miss if self.needs_miss else 1.0)
        return float(-np.expm1((self.states - 1) * np.log1p(-each)))


@dataclass(frozen=True, kw_only=True)
class RandomWalkStart(ToySimulator):
    """The lattice walk from a random gap: 1 + the largest whole number below ``median + z``.

    Its quantised twin is exact: the recursion from each gap, weighted by how likely that is.
    """

    median: float = 4.0
    latents = LatentCounts(start=1)

    @property
    def name(self) -> str:
        return "random-start"

    def initial(self, *, count: int, start: FloatArray) -> StateBatch:
        gap = 1.0 + np.floor(self.median + start[:, 0])
        return StateBatch(step=ZERO, signals={GAP: np.clip(gap, 1.0, float(self.largest_gap))})

    def probability(self, pem: ToyPem) -> float:
        gaps = np.arange(1, self.largest_gap + 1)
        edges = np.concatenate([[-np.inf], gaps[:-1] - self.median, [np.inf]])
        total = 0.0
        for gap, low, high in zip(gaps, edges[:-1], edges[1:], strict=True):
            walk = ToySimulator(
                initial_gap=int(gap), largest_gap=self.largest_gap, states=self.states
            )
            total += float(ndtr(high) - ndtr(low)) * toy_probability_by_recursion(walk, pem)
        return total


@dataclass(frozen=True)
class Flat:
    """P(missed) is the same everywhere."""

    miss: float

    def logit(self, salient: FloatArray) -> FloatArray:
        return np.full(salient.shape[:-1], np.log1p(-self.miss) - np.log(self.miss))


@dataclass(frozen=True, kw_only=True)
class TwoDrifts(Drift):
    """The drift with a camera and a ghost, either of which adds where it errs."""

    slots = (Slot("car"), Slot("ghost", nominal=False))

    def step(self, states, detected, noise=None):
        both = detected[:, 0] & ~detected[:, 1]
        return super().step(states, both, noise)

    def salient(self, signals):
        return np.repeat(super().salient(signals)[..., None, :], 2, axis=-2)

    def present(self, signals):
        return np.ones((*signals["distance"].shape, 2), dtype=np.bool_)


def miss_of_either(miss: float, ghost: float) -> float:
    return float(1.0 - (1.0 - miss) * (1.0 - ghost))


def flat_miss(pem: Flat) -> float:
    return float(expit(-pem.logit(np.zeros((1, 1)))[0]))
