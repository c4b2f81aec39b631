"""A broad family of proposals that nothing is fitted to: they explore, and they stay as defence.

Each raises the probability of a miss towards a ceiling, by a strength of its own and within a
window of steps of its own. A way of failing that fitted proposals do not know of is still met by
some member of the family, which is what the family is for (defensive importance sampling:
Hesterberg 1995).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, Move, moved, namespace
from pemviz.proposals.offset_logistic import StateFeatures, acting
from pemviz.types import RolloutBatch, StateBatch

CEILING_LOGIT = 3.0
"""Logit of the largest probability, 0.95, that a pilot raises (or a detection's, lowers) to."""
EVERYWHERE = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, -1.0)
"""Strengths of the members whose window is the whole rollout."""
WINDOWED = (0.6, 1.0)
"""Strengths within windows of a half, a quarter and an eighth of the rollout."""
HALVINGS = 3
WINDOWED_SHARE = 0.45


@dataclass(frozen=True, eq=False)
class PilotFamily:
    """Members F, each a strength and a window of steps.

    A strength s in (0, 1] raises the logit u of a miss to u + s max(c - u, 0), one below 0 lowers
    it to u + s max(u + c, 0), with c = 3; 0 is the error model.

    Attributes:
        strength: ``[F]``, from -1 to 1.
        first: First step of the window, ``[F]``.
        stop: The step after its last, ``[F]``.
        share: How often a rollout is drawn from each, ``[F]``; sums to 1.
    """

    strength: FloatArray
    first: IntArray
    stop: IntArray
    share: FloatArray

    @staticmethod
    def over(steps: int) -> "PilotFamily":
        """The family for rollouts of ``steps`` outcomes."""
        lengths = _windows(steps)
        members = [(strength, 0, steps) for strength in EVERYWHERE]
        share = [(1.0 - WINDOWED_SHARE if lengths else 1.0) / len(members)] * len(members)
        for windows in lengths:
            alike = [(s, first, stop) for first, stop in windows for s in WINDOWED]
            members += alike
            share += [WINDOWED_SHARE / len(lengths) / len(alike)] * len(alike)
        strength, first, stop = zip(*members, strict=True)
        return PilotFamily(
            strength=np.array(strength),
            first=np.array(first, dtype=np.int64),
            stop=np.array(stop, dtype=np.int64),
            share=np.array(share),
        )

    def drawn(
        self,
        count: int,
        generator: np.random.Generator,
        *,
        features: StateFeatures,
        violated: str,
        of: int | None = None,
    ) -> "PilotProposal":
        """Members for ``count`` rollouts, systematically so that shares are kept, in random order.

        Args:
            count: Number of rollouts.
            generator: What they are drawn with.
            features: Tell where the scenario reacts.
            violated: Name of the memory that says whether a rollout has violated already.
            of: So many rollouts in all: those after the first ``count`` have no window.
        """
        places = (np.arange(count) + generator.random()) / max(count, 1)
        edges = np.cumsum(self.share)
        member = np.searchsorted(edges, places * edges[-1], side="right")
        member = generator.permutation(np.minimum(member, edges.size - 1))
        rest = (0, (of or count) - count)
        return PilotProposal(
            strength=np.pad(self.strength[member], rest),
            first=np.pad(self.first[member], rest),
            stop=np.pad(self.stop[member], rest),
            features=features,
            violated=violated,
        )

    def log_ratio(self, rollouts: RolloutBatch, acts: BoolArray) -> FloatArray:
        """Log of the family's likelihood over the error model's, ``[N]``.

        Args:
            rollouts: N rollouts.
            acts: Where proposals may leave the error model, ``[N, T-1]``.
        """
        count, steps = rollouts.detected.shape
        under_pem = -rollouts.pem_logit[acts]
        sign = np.where(rollouts.detected[acts], 1.0, -1.0)
        by_pem = np.logaddexp(0.0, sign * under_pem)
        by_member = np.zeros((self.strength.size, count))
        step = np.zeros((count, steps))
        sums = np.zeros((steps + 1, count))
        for strength in np.unique(self.strength[self.strength != 0.0]):
            chosen = np.flatnonzero(self.strength == strength)
            step[acts] = by_pem - np.logaddexp(0.0, sign * raised(under_pem, strength))
            np.cumsum(step.T, axis=0, out=sums[1:])
            by_member[chosen] = sums[self.stop[chosen]] - sums[self.first[chosen]]
        return np.asarray(logsumexp(by_member + np.log(self.share)[:, None], axis=0))


@dataclass(frozen=True, eq=False)
class PilotProposal:
    """Members of the family, one for each of N rollouts.

    Attributes:
        strength: ``[N]``.
        first: First step of the window, ``[N]``.
        stop: The step after its last, ``[N]``.
        features: Tell where the scenario reacts; elsewhere a pilot is the error model.
        violated: Name of the memory that says whether a rollout has violated already.
    """

    strength: FloatArray
    first: IntArray
    stop: IntArray
    features: StateFeatures
    violated: str

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[N]``, at states ``[N]`` of the same N rollouts."""
        acts = acting(self.features, states, pem_logit.shape, violated=self.violated)
        step = states.step * 1.0
        within = acts & (self.first <= step) & (self.stop > step)
        raised_logit = -raised(-pem_logit, self.strength)
        return namespace(pem_logit).where(within, raised_logit, pem_logit)

    def rows(self, rows: slice) -> Self:
        """The members of some of the rollouts."""
        return replace(
            self, strength=self.strength[rows], first=self.first[rows], stop=self.stop[rows]
        )

    def moved(self, move: Move) -> Self | None:
        """The same for tensors, if the features can."""
        features = moved(self.features, move)
        if features is None:
            return None
        strength, first, stop = (move(each) for each in (self.strength, self.first, self.stop))
        return replace(self, features=features, strength=strength, first=first, stop=stop)

    def arrays(self) -> Mapping[str, AnyArray]:
        """Strengths and windows."""
        return {"strength": self.strength, "first": self.first, "stop": self.stop}


def raised(miss_logit: FloatArray, strength: FloatArray | float) -> FloatArray:
    """The logit of a miss under a pilot of a strength."""
    up = (CEILING_LOGIT - miss_logit).clip(0.0)
    down = (miss_logit + CEILING_LOGIT).clip(0.0)
    return miss_logit + strength * namespace(miss_logit).where(strength > 0.0, up, down)


def _windows(steps: int) -> list[list[tuple[int, int]]]:
    """Windows of 1/2, 1/4, ... of the steps, each overlapping the next by half; by length."""
    lengths: list[list[tuple[int, int]]] = []
    for halving in range(1, HALVINGS + 1):
        places = 2 ** (halving + 1)
        if places <= steps:
            edges = [round(steps * place / places) for place in range(places + 1)]
            lengths.append(list(zip(edges[:-2], edges[2:], strict=True)))
    return lengths
