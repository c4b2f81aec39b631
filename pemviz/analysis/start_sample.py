"""Start values of all encounters and of those that violate, as weighted samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import FloatArray
from pemviz.simulators.latents import latent_counts
from pemviz.simulators.starts import NamesStarts

DRAWN = 2**15
WIDE, WIDE_SHARE = 2.0, 0.3
"""Latents of all starts are drawn with this standard deviation in this share, for the tails."""


@dataclass(frozen=True)
class WeightedStarts:
    """A sample of start values.

    Attributes:
        values: By name, ``[N]``.
        share: ``[N]``, summing to 1; what has the same latents counts as one.
    """

    values: Mapping[str, FloatArray]
    share: FloatArray

    @property
    def effective(self) -> float:
        """Effective sample size (Kong 1992)."""
        return float(1.0 / np.sum(self.share**2)) if self.share.size else 0.0

    def quantile(self, name: str, share: float) -> float:
        """The least value that at least this share lies at or below."""
        return float(self.quantiles(name, (share,))[0])

    def quantiles(self, name: str, shares: Sequence[float]) -> FloatArray:
        """:meth:`quantile` for each of several shares, ``[K]``."""
        order = np.argsort(self.values[name], kind="stable")
        below = np.cumsum(self.share[order])
        place = np.searchsorted(below, np.asarray(shares) * below[-1], side="left")
        return self.values[name][order][np.minimum(place, order.size - 1)]

    def below(self, name: str, value: float) -> float:
        """The share that lies below a value, of what is equal to it half."""
        values = self.values[name]
        return float(np.sum(self.share[values < value]) + 0.5 * np.sum(self.share[values == value]))

    def interval(self, name: str, share: float) -> tuple[float, float]:
        """Where the quantile lies with 95 % (Woodruff 1952), from the weights' own spread."""
        at_or_below = self.values[name] <= self.quantile(name, share)
        error = float(np.sqrt(np.sum((self.share * (at_or_below - share)) ** 2)))
        ends = (max(share - 1.96 * error, 0.0), min(share + 1.96 * error, 1.0))
        low, high = self.quantiles(name, ends)
        return float(low), float(high)


def all_starts(simulator: NamesStarts) -> WeightedStarts:
    """What the scenario draws, by as many starts as show its tails; the same every time.

    Raises:
        ConfigError: The simulator's own, of values that it cannot map.
    """
    columns = latent_counts(simulator).start
    generator = np.random.default_rng(0)
    wide = generator.random((DRAWN, columns)) < WIDE_SHARE
    z = generator.standard_normal((DRAWN, columns)) * np.where(wide, WIDE, 1.0)
    drawn = (1.0 - WIDE_SHARE) * np.exp(-0.5 * z**2)
    drawn += WIDE_SHARE / WIDE * np.exp(-0.5 * (z / WIDE) ** 2)
    weight = np.prod(np.exp(-0.5 * z**2) / drawn, axis=1)
    return WeightedStarts(_named(simulator, z), weight / np.sum(weight))


def violating_starts(
    simulator: NamesStarts, *, latents: FloatArray, log_share: FloatArray
) -> WeightedStarts:
    """Those of violations; copies of a start, as splitting's particles are, count as one.

    Args:
        simulator: The scenario.
        latents: ``[V, S]``.
        log_share: What each contributes, up to a factor, ``[V]``.
    """
    kept = np.isfinite(log_share)
    latents, log_share = latents[kept], log_share[kept]
    if not log_share.size:
        return WeightedStarts(_named(simulator, latents), np.empty(0))
    share = np.exp(log_share - np.max(log_share))
    distinct, group = np.unique(latents, axis=0, return_inverse=True)
    total = np.bincount(group.ravel(), weights=share, minlength=len(distinct))
    return WeightedStarts(_named(simulator, distinct), total / np.sum(total))


def deviations(share: float) -> float:
    """Where a normal value lies that this share is below, in standard deviations; 6 at most."""
    return float(np.clip(ndtri(np.clip(share, 1e-12, 1.0 - 1e-12)), -6.0, 6.0))


def _named(simulator: NamesStarts, latents: FloatArray) -> Mapping[str, FloatArray]:
    values = simulator.start_values(latents)
    return {name: np.asarray(one, dtype=np.float64) for name, one in values.items()}
