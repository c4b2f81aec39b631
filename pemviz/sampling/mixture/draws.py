"""What a stage's rollouts are drawn from: pilots first, then every fitted proposal in its share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.proposals.offset_logistic import OffsetLogisticProposal, StateFeatures, acting
from pemviz.proposals.pilots import PilotFamily, PilotProposal
from pemviz.sampling.mixture.aims import Aims
from pemviz.sampling.mixture.latents import DividedLatents
from pemviz.simulators.latched import VIOLATED
from pemviz.types import StateBatch

PILOTS = 0
"""The component that stands for the pilots' family; the fitted proposals count from 1."""
EARLY_PILOT_SHARE = 0.25
"""Of the rollouts of the first half of the learning stages, drawn from the pilots' family."""
PILOT_SHARE = 0.1
"""Of every later stage's."""


@dataclass(frozen=True, eq=False)
class DividedProposal:
    """A proposal for each of N rollouts: a pilot's or a fitted one's.

    Attributes:
        pilots: Of all N rollouts; without a step for those that are not pilots. What they look
            at is what the fitted ones do.
        fitted: With coefficients ``[N, B]``, 0 for pilots; ``None`` if all are pilots.
        piloted: Which are, ``[N]``.
        aims: The rule that each is to break, and until when it leaves the error model.
        latents: What latents are drawn from, where there are any.
    """

    pilots: PilotProposal
    fitted: OffsetLogisticProposal | None
    piloted: BoolArray
    aims: Aims
    latents: DividedLatents | None = None

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[N]``, at states ``[N]`` of the same N rollouts."""
        pilots, fitted = self.pilots, self.fitted
        acts = acting(pilots.features, states, pem_logit.shape, violated=pilots.violated)
        if not acts.any():
            return pem_logit
        by_pilots = pilots.logit_where(acts, states, pem_logit)
        if fitted is None:
            return by_pilots
        acts = acts & ~self.piloted
        if self.aims.rules:
            acts &= ~self.aims.reached(states.memory)
        by_fitted = fitted.logit_where(acts, states, pem_logit)
        return np.where(self.piloted, by_pilots, by_fitted)

    def start_mean(self, count: int) -> FloatArray:  # noqa: ARG002  that of all is known
        """Of the latents at the start, ``[N, S]``.

        Raises:
            TypeError: The scenario has no latents.
        """
        return self._of_latents().start_mean()

    def start_sd(self, count: int) -> FloatArray:  # noqa: ARG002  that of all is known
        """Spreads of half of the starts, ``[N, S]``.

        Raises:
            TypeError: The scenario has no latents.
        """
        return self._of_latents().start.sd

    def noise_mean(self, states: StateBatch, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Of a step's noise, means ``[N, M]`` and shares ``[N]``.

        Raises:
            TypeError: The scenario has no latents.
        """
        return self._of_latents().noise_mean(states, detected)

    def once(self, count: int) -> BoolArray:  # noqa: ARG002  that of all is known
        """Which rollouts have one step's noise moved at most, ``[N]``.

        Raises:
            TypeError: The scenario has no latents.
        """
        return self._of_latents().once

    def noise_sd(self, count: int) -> FloatArray:  # noqa: ARG002  that of all is known
        """Of half of the noise that is moved, ``[N, M]``.

        Raises:
            TypeError: The scenario has no latents.
        """
        return self._of_latents().noise_sd

    def _of_latents(self) -> DividedLatents:
        if self.latents is None:
            message = "the proposal is for a scenario without latents"
            raise TypeError(message)
        return self.latents

    def rows(self, rows: slice) -> Self:
        """What some of the rollouts are drawn from."""
        fitted = self.fitted
        if fitted is not None:
            fitted = replace(fitted, coefficients=fitted.coefficients[rows])
        return replace(
            self,
            pilots=self.pilots.rows(rows),
            fitted=fitted,
            piloted=self.piloted[rows],
            aims=self.aims.rows(rows),
            latents=None if self.latents is None else self.latents.rows(rows),
        )

    def arrays(self) -> Mapping[str, AnyArray]:
        """Of both kinds."""
        return {**self.pilots.arrays(), **(self.fitted.arrays() if self.fitted else {})}


def components(count: int, *, first: int, shares: Sequence[float], explores: bool) -> IntArray:
    """What each of ``count`` rollouts is drawn from, ``[count]``, in ascending order.

    Args:
        count: Number of rollouts.
        first: Component of the first fitted proposal, which is drawn what is left over.
        shares: Of the fitted proposals in the rollouts that are not pilots; empty: all are.
        explores: Whether the stage is one of the first.
    """
    if not shares:
        return np.full(count, PILOTS, dtype=np.int64)
    pilots = max(1, int((EARLY_PILOT_SHARE if explores else PILOT_SHARE) * count))
    others = [int(share * (count - pilots)) for share in shares[1:]]
    numbers = [pilots, count - pilots - sum(others), *others]
    return np.repeat([PILOTS, *range(first, first + len(shares))], numbers).astype(np.int64)


def divided(
    component: IntArray,
    coefficients: Mapping[int, FloatArray],
    like: OffsetLogisticProposal | None,
    *,
    aims: Aims,
    family: PilotFamily,
    features: StateFeatures,
    generator: np.random.Generator,
) -> DividedProposal:
    """The proposals of rollouts that are to be drawn from given components.

    Args:
        component: Of each rollout, ascending, ``[N]``.
        coefficients: Of the fitted components, ``[B]`` each.
        like: A fitted proposal, for everything else; ``None`` if all rollouts are pilots.
        aims: The rule that each rollout is to break.
        family: Of the pilots.
        features: Tell where the scenario reacts.
        generator: What the pilots' members are drawn with.
    """
    pilots = family.drawn(
        int((component == PILOTS).sum()),
        generator,
        features=features,
        violated=VIOLATED,
        of=component.size,
    )
    if like is not None:
        nothing = np.zeros(like.coefficients.size)
        rows = [coefficients.get(int(index), nothing) for index in component]
        like = replace(like, coefficients=np.stack(rows))
    return DividedProposal(pilots=pilots, fitted=like, piloted=component == PILOTS, aims=aims)
