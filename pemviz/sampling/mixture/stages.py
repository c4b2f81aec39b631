"""A stage's rollouts: exploration, then each fitted proposal in its share; large ones in parts.

The pool keeps the decisions of every rollout that proposals are fitted to and that is weighed by
them, which of a very large stage would be more than memory holds. So it is drawn in parts, each
from exploration and fitted proposals in their shares, and it is over with the part that brings its
violations to as many as are enough: later ones would teach nothing, and narrow the estimate less
than final rollouts do, of which weights alone are kept. All that were drawn count. Where violations
are rare, all that were asked for are drawn; of those that hold, the least robust join the pool, and
an even sample that stands for the others.

That a stage is over sooner where more of it violates moves its own average by less than a tenth of
its standard error: 0.4 / (p + 1) of it at most after p parts, p at least 4, which is the mean of a
normal above its middle, halved, times the difference between 1 / p and 1 / (p + 1). The unbiased
figure, the final batch's, does not move.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.drawn import Drawn
from pemviz.faults import counted_from
from pemviz.latents import LatentCounts
from pemviz.proposals.exploration import (
    ExplorationFamily,
    ExplorationProposal,
    LatentExploration,
    LatentFamily,
)
from pemviz.proposals.latent_moves import (
    LatentMeans,
    StartMoves,
    choice_logit,
    even_logit,
    noise_means,
    unmoved,
)
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    StateFeatures,
    acting,
    noise_basis,
    noise_features,
    share_for,
)
from pemviz.sampling.mixture.balance_heuristic import (
    EXPLORATION,
    Pool,
    TargetRules,
)
from pemviz.sampling.mixture.fit import Fit
from pemviz.sampling.problem import FinishedStage, Problem, sample
from pemviz.sampling.rollouts.large_stages import Thinned, Whole, least_robust, part_sizes
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.simulators.absorbing import VIOLATED, EachRule, MonitoredSimulator
from pemviz.simulators.latents import latent_counts
from pemviz.types import ScoredRollouts, StateBatch

EARLY_EXPLORATION_SHARE = 0.25
"""Of the rollouts of the first half of the learning stages, drawn from the exploration proposals'
family."""
EXPLORATION_SHARE = 0.1
"""Of every later stage's."""
DEFENSIVE_STEPS = 2.0
"""Of each rollout, drawn from the error model on average."""
PARTS = 4
"""In which a stage's enough violations come, if all rollouts violate."""
Part = Callable[[Problem, int, int], ScoredRollouts]
"""Draws a part of a stage: with a problem that counts progress, by its number and its size."""


@dataclass(frozen=True, eq=False)
class DividedLatents:
    """What the latents of each of N rollouts are drawn from: means of exploration, or fitted ones.

    Attributes:
        exploration: Of all N rollouts; 0 for those that are not exploration proposals.
        start: Fitted moves at the start, of each rollout its own, none for exploration proposals.
        noise: Fitted coefficients, ``[N, M, B]``, likewise.
        choice: Fitted coefficients of how often it is moved, ``[N, B]``.
        noise_sd: Spreads of half of the noise that is moved, ``[N, M]``, 1 for exploration
            proposals.
        once: Which move one step's noise at most, ``[N]``.
        explored: Which are exploration proposals, ``[N]``: what they move, they move always.
        targets: The rule that each is to break, and until when it moves anything.
        features: What fitted proposals look at, beside the step's last outcome.
        basis: Monomials of it all; ``None`` if all rollouts are exploration proposals.
        steps: Of a rollout.
        turns: Outcomes of a step.
    """

    exploration: LatentExploration
    start: StartMoves
    noise: FloatArray
    choice: FloatArray
    noise_sd: FloatArray
    once: BoolArray
    explored: BoolArray
    targets: TargetRules
    features: StateFeatures
    basis: PolynomialBasis | None
    steps: int
    turns: int

    def start_mean(self) -> FloatArray:
        """Of the latents at the start, ``[N, S]``."""
        return self.exploration.start + self.start.mean

    def noise_mean(self, states: StateBatch, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Of a step's noise: means ``[N, M]`` and shares ``[N]``, 0 after a violation."""
        step = int(states.step) // self.turns
        mean = self.exploration.noise_mean(step)
        share = np.ones(len(mean))
        if self.basis is not None:
            basis = self.basis.evaluate(noise_features(self.features, states, detected))
            mean = mean + noise_means(basis, self.noise)
            logit = choice_logit(basis, self.choice)
            even = even_logit(np.array(step), steps=self.steps)
            share = expit(np.where(self.once, logit + even, logit))
            share = np.where(self.explored, 1.0, share)
        over = states.memory.get(VIOLATED, np.zeros(len(mean), dtype=np.bool_))
        over = over | self.targets.reached(states.memory)
        return np.where(over[:, None], 0.0, mean), np.where(over, 0.0, share)

    def rows(self, rows: slice) -> "DividedLatents":
        """Of some of the rollouts."""
        return replace(
            self,
            exploration=self.exploration.rows(rows),
            start=self.start.rows(rows),
            noise=self.noise[rows],
            choice=self.choice[rows],
            noise_sd=self.noise_sd[rows],
            once=self.once[rows],
            explored=self.explored[rows],
            targets=self.targets.rows(rows),
        )


@dataclass(frozen=True, eq=False)
class DividedProposal:
    """A proposal for each of N rollouts: an exploration proposal's or a fitted one's.

    Attributes:
        exploration: Of all N rollouts; without a step for those that are not exploration proposals.
            What they look at is what the fitted ones do.
        fitted: With coefficients ``[N, B]``, 0 for exploration proposals; ``None`` if all are
            exploration proposals.
        explored: Which are, ``[N]``.
        targets: The rule that each is to break, and until when it leaves the error model.
        latents: What latents are drawn from, where there are any.
    """

    exploration: ExplorationProposal
    fitted: OffsetLogisticProposal | None
    explored: BoolArray
    targets: TargetRules
    latents: DividedLatents | None = None

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[N]``, at states ``[N]`` of the same N rollouts."""
        exploration, fitted = self.exploration, self.fitted
        acts = acting(exploration.features, states, pem_logit.shape, violated=exploration.violated)
        if not acts.any():
            return pem_logit
        by_exploration = exploration.logit_where(acts, states, pem_logit)
        if fitted is None:
            return by_exploration
        acts = acts & ~self.explored
        if self.targets.rules:
            acts &= ~self.targets.reached(states.memory)
        by_fitted = fitted.logit_where(acts, states, pem_logit)
        return np.where(self.explored, by_exploration, by_fitted)

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
            exploration=self.exploration.rows(rows),
            fitted=fitted,
            explored=self.explored[rows],
            targets=self.targets.rows(rows),
            latents=None if self.latents is None else self.latents.rows(rows),
        )

    def arrays(self) -> Mapping[str, AnyArray]:
        """Of both kinds."""
        return {**self.exploration.arrays(), **(self.fitted.arrays() if self.fitted else {})}


def components(count: int, *, first: int, shares: Sequence[float], explores: bool) -> IntArray:
    """What each of ``count`` rollouts is drawn from, ``[count]``, in ascending order.

    Args:
        count: Number of rollouts.
        first: Component of the first fitted proposal, which is drawn what is left over.
        shares: Of the fitted proposals in the rollouts that are not exploration proposals; empty:
            all are.
        explores: Whether the stage is one of the first.
    """
    if not shares:
        return np.full(count, EXPLORATION, dtype=np.int64)
    exploration = max(1, int((EARLY_EXPLORATION_SHARE if explores else EXPLORATION_SHARE) * count))
    others = [int(share * (count - exploration)) for share in shares[1:]]
    numbers = [exploration, count - exploration - sum(others), *others]
    return np.repeat([EXPLORATION, *range(first, first + len(shares))], numbers).astype(np.int64)


def divided(
    component: IntArray,
    coefficients: Mapping[int, FloatArray],
    like: OffsetLogisticProposal | None,
    *,
    targets: TargetRules,
    family: ExplorationFamily,
    features: StateFeatures,
    generator: np.random.Generator,
) -> DividedProposal:
    """The proposals of rollouts that are to be drawn from given components.

    Args:
        component: Of each rollout, ascending, ``[N]``.
        coefficients: Of the fitted components, ``[B]`` each.
        like: A fitted proposal, for everything else; ``None`` if all rollouts are exploration
            proposals.
        targets: The rule that each rollout is to break.
        family: Of the exploration proposals.
        features: Tell where the scenario reacts.
        generator: What the exploration proposals' members are drawn with.
    """
    exploration = family.drawn(
        int((component == EXPLORATION).sum()),
        generator,
        features=features,
        violated=VIOLATED,
        of=component.size,
    )
    if like is not None:
        nothing = np.zeros(like.coefficients.size)
        rows = [coefficients.get(int(index), nothing) for index in component]
        like = replace(like, coefficients=np.stack(rows))
    return DividedProposal(
        exploration=exploration, fitted=like, explored=component == EXPLORATION, targets=targets
    )


def divided_latents(
    exploration: LatentExploration,
    means: Sequence[LatentMeans | None],
    targets: TargetRules,
    counts: LatentCounts,
    *,
    features: StateFeatures,
    basis: PolynomialBasis | None,
    steps: int,
    turns: int,
) -> DividedLatents:
    """Of N rollouts.

    Args:
        exploration: Of all; 0 for those that are not exploration proposals.
        means: Fitted ones of each rollout, ``None`` for exploration proposals.
        targets: The rule that each is to break.
        counts: Latents of a rollout.
        features: What fitted proposals look at.
        basis: Monomials of it, for outcomes.
        steps: Of a rollout.
        turns: Outcomes of a step.
    """
    basis = None if basis is None else noise_basis(basis)
    monomials = 1 if basis is None else len(basis.exponents)
    none = unmoved(start=counts.start, noise=counts.noise, basis=monomials)
    own = [none if each is None else each for each in means]
    return DividedLatents(
        exploration=exploration,
        start=StartMoves.of_each([each.start for each in own]),
        noise=np.stack([each.noise for each in own]),
        choice=np.stack([each.choice for each in own]),
        noise_sd=np.stack([each.sd for each in own]),
        once=np.array([each.once for each in own]),
        explored=np.array([each is None for each in means]),
        targets=targets,
        features=features,
        basis=basis,
        steps=steps,
        turns=turns,
    )


@dataclass(frozen=True)
class MixtureState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        stage: The stage that ``step`` carries out next.
        features: What proposals look at.
        basis: Monomials of it; ``None`` before the first stage.
        pool: Everything drawn so far.
        fits: What the next stage draws from beside exploration proposals: the main proposal, those
            of other failure modes, one fitted to a level above 0; empty before the first stage.
        frozen: How many rollouts each part of the final batch has, as far as it is drawn.
        absorbing: Whether rollouts know when they have violated.
        turns: Outcomes of a step of the scenario.
        starts: Random values at the start of a rollout.
        rules: Names, where there are several.
        many: Whether the learning stages have more rollouts than are drawn at once.
    """

    repetition: int
    stage: int
    features: StateFeatures
    basis: PolynomialBasis | None = None
    pool: Pool | None = None
    fits: tuple[Fit, ...] = ()
    frozen: tuple[int, ...] = ()
    absorbing: bool = True
    turns: int = 1
    starts: int = 0
    rules: tuple[str, ...] = ()
    many: bool = False

    @property
    def final(self) -> slice:
        """Which rollouts of the pool are the final batch, as far as it is drawn."""
        drawn = 0 if self.pool is None else self.pool.drawn
        return slice(drawn - sum(self.frozen), None)


def until_settled(problem: Problem) -> Problem:
    """The problem on a simulator that remembers what is broken, and that nothing is left to be."""
    rules = several_rules(problem)
    if not rules:
        return with_absorbing_violation(problem)
    each = EachRule({rule: problem.rules[rule].monitor for rule in rules})
    return replace(problem, simulator=MonitoredSimulator(problem.simulator, each))


def several_rules(problem: Problem) -> tuple[str, ...]:
    """Their names; empty where there are not several."""
    return tuple(problem.rules) if len(problem.rules) > 1 else ()


def main_proposal(state: MixtureState, *, steps: int) -> OffsetLogisticProposal | None:
    """The main proposal that is drawn from next; ``None`` before the first stage."""
    if state.basis is None:
        return None
    return OffsetLogisticProposal(
        features=state.features,
        basis=state.basis,
        coefficients=state.fits[0].coefficients,
        violated=VIOLATED,
        defensive=defence(steps),
        means=state.fits[0].means,
    )


def drawn(
    problem: Problem,
    state: MixtureState,
    component: IntArray,
    *,
    seeds: np.random.SeedSequence,
) -> ScoredRollouts:
    """Rollouts drawn from given components, ascending, ``[N]``, and scored.

    Raises:
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    steps = problem.simulator.states - 1
    fitted = np.unique(component[component != EXPLORATION])
    generator = np.random.default_rng(seeds.spawn(1)[0])
    fits = [None if c == EXPLORATION else state.fits[c - fitted[0]] for c in component.tolist()]
    targets = TargetRules.of(state.rules, [fit.rule if fit else None for fit in fits])
    proposal = divided(
        component,
        {int(index): state.fits[index - fitted[0]].coefficients for index in fitted},
        main_proposal(state, steps=steps),
        targets=targets,
        family=ExplorationFamily.over(steps, turns=state.turns),
        features=state.features,
        generator=generator,
    )
    counts = latent_counts(problem.simulator)
    if counts:
        family = LatentFamily.over(steps // state.turns, start=counts.start, noise=counts.noise)
        exploration = family.drawn(
            int((component == EXPLORATION).sum()), generator, of=component.size
        )
        latents = divided_latents(
            exploration,
            [fit.means if fit else None for fit in fits],
            targets,
            counts,
            features=state.features,
            basis=state.basis,
            steps=steps // state.turns,
            turns=state.turns,
        )
        proposal = replace(proposal, latents=latents)
    return sample(problem, proposal=proposal, count=component.size, seeds=seeds)


def defence(steps: int) -> float:
    """Share of the error model in every outcome's probability, for rollouts of ``steps``."""
    return share_for(drawn_steps=DEFENSIVE_STEPS, steps=steps)


@dataclass(frozen=True)
class Joining:
    """Rollouts of a stage that join the pool.

    Attributes:
        scored: They.
        row: Index in the stage of each, ascending, ``[M]``; ``None``: they are all of it.
        log_stands_for: Log of how many rollouts each stands for, ``[M]``; ``None``: for itself.
        even: Which are an even sample of the stage, ``[M]``; ``None``: all.
    """

    scored: ScoredRollouts
    row: IntArray | None = None
    log_stands_for: FloatArray | None = None
    even: BoolArray | None = None

    @property
    def sample(self) -> ScoredRollouts:
        """An even sample of the stage's rollouts, or all."""
        return self.scored if self.even is None else self.scored.take(self.even)


@dataclass(frozen=True)
class StageDrawn:
    """A stage that is drawn.

    Attributes:
        scored: Its rollouts, or those that are held.
        drawn: What is known of all, where not all are held.
        joining: Those that join the pool.
    """

    scored: ScoredRollouts
    drawn: Drawn | None
    joining: Joining

    @staticmethod
    def small(scored: ScoredRollouts) -> "StageDrawn":
        """All of them are held, and join."""
        return StageDrawn(scored, None, Joining(scored))

    @property
    def count(self) -> int:
        """How many were drawn."""
        return self.scored.rollouts.count if self.drawn is None else self.drawn.count


@dataclass(frozen=True)
class InParts:
    """How a large stage is drawn.

    Attributes:
        count: So many rollouts at most.
        enough: Violations after which it is over.
    """

    count: int
    enough: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of its parts, if all are drawn."""
        return part_sizes(self.count, largest=self._part)

    @property
    def most(self) -> int:
        """Violations that it has at most, and the least robust others join up to as many."""
        return self.enough + self._part

    @property
    def _part(self) -> int:
        return max(1, self.enough // PARTS)

    def draw(self, problem: Problem, part: Part) -> StageDrawn:
        """As many parts as it takes.

        Raises:
            SimulationError: A batch has something that is no finite number, or takes too long.
        """
        thinned, whole = Thinned(count=self.count, most=self.most), Whole()
        done = violations = 0
        for number, size in enumerate(self.sizes):
            with counted_from(done):
                scored = part(_counting_from(problem, done, of=self.count), number, size)
            thinned = thinned.extended(scored)
            if not problem.thins:
                whole = whole.extended(scored)
            done, violations = done + size, violations + int(scored.violated.sum())
            if violations >= self.enough:
                break
        held, drawn = thinned.done()
        if problem.thins:
            return StageDrawn(held, drawn, self._joining(held, drawn))
        return StageDrawn(whole.done()[0], None, self._joining(held, drawn))

    def restored(self, finished: FinishedStage) -> StageDrawn:
        """As an interrupted run left it."""
        scored, drawn = finished.scored, finished.drawn
        if drawn is not None:
            return StageDrawn(scored, drawn, self._joining(scored, drawn))
        thinned = Thinned(count=self.count, most=self.most).extended(scored)
        return StageDrawn(scored, None, self._joining(*thinned.done()))

    def _joining(self, held: ScoredRollouts, drawn: Drawn) -> Joining:
        """The least robust as they are, an even sample for the others."""
        least = np.zeros(drawn.count, dtype=np.bool_)
        least[least_robust(drawn.robustness, drawn.violated)[: self.most]] = True
        own, others = least[drawn.row], drawn.even & ~least[drawn.row]
        standing = np.zeros(drawn.row.size)
        if others.any():
            standing[others] = math.log(np.count_nonzero(~least) / np.count_nonzero(others))
        chosen = own | others
        return Joining(held.take(chosen), drawn.row[chosen], standing[chosen], drawn.even[chosen])


def _counting_from(problem: Problem, done: int, *, of: int) -> Problem:
    """The problem, whose progress is told as that of a part of a stage."""

    def progress(some: int, _: int) -> None:
        problem.progress(done + some, of)

    return replace(problem, progress=progress)
