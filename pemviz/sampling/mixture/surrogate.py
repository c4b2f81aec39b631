"""Proposals that are learned on a surrogate before the simulator itself is run.

A surrogate is a fast simulator of about the same scenario: coarser physics, another braking limit,
a delay left out. Rollouts of it are sampled and proposals fitted to them as on any simulator. The
first stage on the simulator itself explores as it does without one, as a surrogate may know only
some of the failure modes; the second samples from the surrogate's proposals too. From then on the
simulator's own rollouts alone are learned from, while the surrogate's proposals keep a share if its
probability is near; and they alone are weighed: a surrogate that is wrong costs rollouts, and never
biases the answer (multifidelity importance sampling: Peherstorfer, Cui, Marzouk, Willcox 2016).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.errors import InputError
from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.sampling.mixture.fit import Fit
from pemviz.sampling.problem import Problem, not_counted, not_watched, nothing_finished
from pemviz.sampling.rollouts.runners import CompiledRunner
from pemviz.types import Estimate, Simulator

LEARNED = "surrogate"
"""What a surrogate's rollouts came to, kept beside the first stage's rollouts."""
SAME = 1e-6
"""Decades of the surrogate's probability: nearer, it is the same surrogate on another machine."""
FIRST_REPETITION = 2**31
"""Number of the first repetition where seeds of a surrogate's rollouts are concerned."""


@dataclass(frozen=True)
class Surrogate:
    """A simulator of about the same scenario, and how much is learned on it.

    Attributes:
        simulator: With the states, signals, latents and slots of the one in question.
        learning_stages: Stages after its first.
        rollouts: In each.
    """

    simulator: Simulator
    learning_stages: int
    rollouts: int

    def in_place(self, problem: Problem) -> Problem:
        """The same question about the surrogate, whose rollouts this process simulates."""

        def progress(done: int, total: int) -> None:  # noqa: ARG001  they are no stage's
            problem.progress(0, self.rollouts)

        return replace(
            problem,
            simulator=self.simulator,
            run_batches=CompiledRunner(),
            batch_rollouts=max(problem.batch_rollouts, self.rollouts),
            progress=progress,
            searched=not_counted,
            seen=not_watched,
            finished=nothing_finished,
            lost="end",
        )


@dataclass(frozen=True)
class LearnedOnSurrogate:
    """What rollouts of a surrogate have taught.

    Attributes:
        estimate: The surrogate's own failure probability, as its stages tell it.
        fits: Its proposals; none where nothing violates on it.
        basis: What they look at, standardised by its first stage; ``None`` without any.
    """

    estimate: Estimate
    fits: tuple[Fit, ...] = ()
    basis: PolynomialBasis | None = None

    @property
    def kept(self) -> dict[str, AnyArray]:
        """What tells it from what another surrogate would have taught."""
        log10 = self.estimate.log10_probability
        return {LEARNED: np.array(-math.inf if log10 is None else log10)}

    def check_same(self, kept: Mapping[str, AnyArray], *, name: str) -> None:
        """Refuse to go on from rollouts of proposals that another surrogate taught.

        Raises:
            InputError: ``kept``, beside the first stage's rollouts, is of another one.
        """
        before, now = kept.get(LEARNED), self.kept[LEARNED]
        if before is not None and not np.isclose(before, now, rtol=0.0, atol=SAME):
            raise InputError(
                f"surrogate {name!r}: has changed since this run was begun; go on with it as it "
                "was, or start a new run"
            )
