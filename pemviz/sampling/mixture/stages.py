"""A stage's rollouts: exploration, then each fitted proposal in its share; large ones in parts.

The pool keeps the decisions of every rollout that proposals are fitted to and that is weighed by
them, which of a very large stage would be more than memory holds. So it is sampled in parts,
each from exploration and fitted proposals in their shares, and it is over with the part that brings
its violations to as many as are enough: later ones would teach nothing, and narrow the estimate
less than final rollouts do, of which weights alone are kept. All that were sampled count. Where
violations are rare, all that were wanted are sampled; of those that hold, the least robust join
the pool, and an even sample that stands for the others.

That a stage is over sooner where more of it violates moves its own average by less than a tenth of
its standard error: 0.4 / (p + 1) of it at most after p parts, p at least 4, which is the mean of a
normal above its middle, halved, times the difference between 1 / p and 1 / (p + 1). The unbiased
figure, the final batch's, does not move.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.special import expit, ndtr

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config import LostName
from pemviz.faults import counted_from
from pemviz.proposals import latent_moves
from pemviz.proposals import offset_logistic as logistic
from pemviz.proposals.defensive import share_for
from pemviz.proposals.exploration import (
    ExplorationFamily,
    ExplorationProposal,
    LatentExploration,
    LatentFamily,
)
from pemviz.proposals.latent_moves import LatentMeans, NoiseMoves
from pemviz.proposals.offset_logistic import OffsetLogisticProposal, PolynomialBasis, StateFeatures
from pemviz.proposals.start_moves import NARROW_SHARE, StartMoves, even_normals
from pemviz.sampling.estimates.estimators import REPLICATES
from pemviz.sampling.mixture.balance_heuristic import EXPLORATION, PLAIN, Pool, TargetRules
from pemviz.sampling.mixture.estimate import replicates
from pemviz.sampling.mixture.fit import Fit, has_many_features
from pemviz.sampling.mixture.plain import PlainRollouts, PlainViolations
from pemviz.sampling.mixture.rejuvenated import Rejuvenated
from pemviz.sampling.mixture.resampled import Resampled
from pemviz.sampling.mixture.surrogate import LearnedOnSurrogate
from pemviz.sampling.problem import FinishedStage, Problem, ScoredRule, sample
from pemviz.sampling.rollouts.large_stages import Thinned, Whole, least_robust, part_sizes
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.state.composed import with_component
from pemviz.sampling.state.violated import EachRule, Monitored
from pemviz.sampling.subset.exploring import Explored
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.simulators.latents import latent_counts
from pemviz.types import VIOLATED, SampledRollouts, ScoredRollouts, StateBatch

EARLY_EXPLORATION_SHARE = 0.25
"""Of the rollouts of the first half of the learning stages, sampled from the exploration proposals'
family."""
EXPLORATION_SHARE = 0.1
"""Of every later stage's."""
DEFENSIVE_STEPS = 2.0
"""Of each rollout, sampled from the error model on average."""
PARTS = 4
"""In which a stage's enough violations come, if all rollouts violate."""
Part = Callable[[Problem, int, int], ScoredRollouts]
"""Samples a part of a stage: with a problem that counts progress, by its number and its size."""


@dataclass(frozen=True, eq=False)
class DividedProposal:
    """A proposal for each of N rollouts: an exploration proposal's or a fitted one's.

    Attributes:
        exploration: Of all N rollouts; without a step for those that are not exploration proposals.
            What they look at is what the fitted ones do.
        fitted: With coefficients ``[N, B]``, 0 for exploration proposals; ``None`` if none is
            fitted.
        explored: Which are exploration proposals, or the error model itself, ``[N]``.
        targets: The rule that each is to break, and until when it leaves the error model.
    """

    exploration: ExplorationProposal
    fitted: OffsetLogisticProposal | None
    explored: BoolArray
    targets: TargetRules

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[N]``, at states ``[N]`` of the same N rollouts."""
        exploration, fitted = self.exploration, self.fitted
        acts = logistic.acting(
            exploration.features, states, pem_logit.shape, violated=exploration.violated
        )
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

    def rows(self, rows: slice) -> Self:
        """What some of the rollouts are sampled from."""
        fitted = self.fitted
        if fitted is not None:
            fitted = replace(
                fitted,
                coefficients=fitted.coefficients[rows],
                defensive=np.asarray(fitted.defensive)[rows],
                by_step=None if fitted.by_step is None else fitted.by_step[rows],
            )
        return replace(
            self,
            exploration=self.exploration.rows(rows),
            fitted=fitted,
            explored=self.explored[rows],
            targets=self.targets.rows(rows),
        )

    def arrays(self) -> Mapping[str, AnyArray]:
        """Of both kinds."""
        return {**self.exploration.arrays(), **(self.fitted.arrays() if self.fitted else {})}


@dataclass(frozen=True, eq=False, kw_only=True)
class DividedMoves(DividedProposal):
    """The same where latents are moved: by means of exploration, or fitted ones.

    Attributes:
        moved: Exploration's; 0 for rollouts that are not exploration proposals. What these move,
            they move always.
        start: Moves at the start, of each rollout its own; of exploration proposals means alone.
        normals: What starts of fitted ones are made of, and, first, what says which are narrow,
            ``[N, 1 + S]``; of others nothing that is used.
        noise: Fitted coefficients, ``[N, M, B]``, likewise.
        choice: Fitted coefficients of how often it is moved, ``[N, B]``.
        sd: Spreads of narrow noise, ``[N, M]``, 1 for exploration proposals.
        narrow: Coefficients of narrow noise, as fitted means have them, ``[N, M + 1, B]``.
        one: Which move one step's noise at most, ``[N]``.
        basis: Monomials of what fitted proposals look at and of the step's last outcome; ``None``
            if all rollouts are exploration proposals.
        steps: Of a rollout.
        turns: Outcomes of a step.
    """

    moved: LatentExploration
    start: StartMoves
    normals: FloatArray
    noise: FloatArray
    choice: FloatArray
    sd: FloatArray
    narrow: FloatArray
    one: BoolArray
    basis: PolynomialBasis | None
    steps: int
    turns: int

    def start_mean(self, count: int) -> FloatArray:  # noqa: ARG002  that of all is known
        """Of the latents at the start, ``[N, S]``."""
        return self.start.mean

    def chosen_start(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latents at the start, seeds included, and their log p - log q."""
        latents, start = self.normals.shape[1] - 1, normals.copy()
        own = np.where(self.explored[:, None], start[:, :latents], self.normals[:, 1:])
        narrow = ndtr(self.normals[:, 0]) < NARROW_SHARE
        start[:, :latents] = self.start.starts(own, narrow)
        return start, 0.0 - self.start.log_ratio(start[:, :latents])

    def once(self, count: int) -> BoolArray:  # noqa: ARG002  that of all is known
        """Which rollouts have one step's noise moved at most, ``[N]``."""
        return self.one

    def noise_sd(self, count: int) -> FloatArray:  # noqa: ARG002  that of all is known
        """Of narrow noise, ``[N, M]``."""
        return self.sd

    def noise_mean(self, states: StateBatch, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Of a step's noise: means ``[N, M]`` and shares ``[N]``."""
        moves = self.noise_moves(states, detected)
        return moves.mean, moves.share

    def noise_moves(self, states: StateBatch, detected: BoolArray) -> NoiseMoves:
        """Of a step's noise; nothing is moved after a violation."""
        step = int(states.step) // self.turns
        mean = narrow_mean = self.moved.noise_mean(step)
        share, narrow_share = np.ones(len(mean)), np.zeros(len(mean))
        if self.basis is not None:
            values = logistic.noise_features(self.exploration.features, states, detected)
            basis = self.basis.evaluate(values)
            mean = mean + latent_moves.noise_means(basis, self.noise)
            logit = latent_moves.choice_logit(basis, self.choice)
            even = latent_moves.even_logit(np.array(step), steps=self.steps)
            share = expit(np.where(self.one, logit + even, logit))
            share = np.where(self.explored, 1.0, share)
            own, logit = latent_moves.narrow_moves(basis, self.narrow)
            narrow_mean = narrow_mean + own
            narrow_share = np.where(self.explored, 0.0, expit(logit))
        over = states.memory.get(VIOLATED, np.zeros(len(mean), dtype=np.bool_))
        over = over | self.targets.reached(states.memory)
        mean, narrow_mean = (np.where(over[:, None], 0.0, one) for one in (mean, narrow_mean))
        return NoiseMoves(mean, np.where(over, 0.0, share), narrow_mean, narrow_share)

    def rows(self, rows: slice) -> Self:
        """What some of the rollouts are sampled from."""
        return replace(
            super().rows(rows),
            moved=self.moved.rows(rows),
            start=self.start.rows(rows),
            normals=self.normals[rows],
            noise=self.noise[rows],
            choice=self.choice[rows],
            sd=self.sd[rows],
            narrow=self.narrow[rows],
            one=self.one[rows],
        )


def components(
    count: int, *, first: int, shares: Sequence[float], explores: bool, plain: float
) -> IntArray:
    """What each of ``count`` rollouts is sampled from, ``[count]``, in ascending order.

    Args:
        count: Number of rollouts.
        first: Component of the first fitted proposal, which gets what is left over.
        shares: Of the fitted proposals in the rollouts that are neither plain nor exploration
            proposals; empty: there are none.
        explores: Whether the stage is one of the first.
        plain: Share of the rollouts that is sampled from the error model itself, below 1.
    """
    by_model = int(plain * count)
    rest = count - by_model
    if not shares:
        return np.repeat([EXPLORATION, PLAIN], [rest, by_model]).astype(np.int64)
    exploration = max(1, int((EARLY_EXPLORATION_SHARE if explores else EXPLORATION_SHARE) * rest))
    others = [int(share * (rest - exploration)) for share in shares[1:]]
    numbers = [exploration, by_model, rest - exploration - sum(others), *others]
    kinds = [EXPLORATION, PLAIN, *range(first, first + len(shares))]
    return np.repeat(kinds, numbers).astype(np.int64)


@dataclass(frozen=True)
class MixtureState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        stage: The stage that ``step`` carries out next.
        features: What proposals look at.
        basis: Monomials of it; ``None`` before the first stage.
        pool: Everything sampled so far.
        fits: What the next stage samples from beside exploration proposals: the main proposal,
            those of other failure modes, one fitted to a level above 0; empty before the first
            stage.
        frozen: How many rollouts each part of the final batch has, as far as it is sampled.
        absorbing: Whether rollouts know when they have violated.
        turns: Outcomes of a step of the scenario.
        starts: Random values at the start of a rollout.
        rules: Names, where there are several.
        conjuncts: Of the specification and of each rule, where they have some.
        lost: What a rollout counts as that could not be simulated to its end.
        many: Whether the learning stages have more rollouts than are sampled at once.
        before: Plain rollouts from before the first stage.
        plain: What plain rollouts have told so far, and how many the next stage has.
        steps: Of a rollout.
        explored: What chains found; ``None``: nothing was searched for.
        explored_fits: Proposals fitted to that; empty before the first stage.
        rejuvenated: Violations that exploration proposals have met, moved.
        resampled: Violations of each stage, drawn by their weights and moved.
        on_surrogate: What a surrogate's rollouts have taught; ``None``: nothing was.
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
    conjuncts: Mapping[str | None, Sequence[ScoredRule]] = field(
        default_factory=dict[str | None, Sequence[ScoredRule]]
    )
    lost: LostName = "end"
    many: bool = False
    before: PlainRollouts | None = None
    plain: PlainViolations = field(default_factory=PlainViolations)
    steps: int = 0
    explored: Explored | None = None
    explored_fits: tuple[Fit, ...] = ()
    rejuvenated: Rejuvenated = field(default_factory=Rejuvenated)
    resampled: Resampled = field(default_factory=Resampled)
    on_surrogate: LearnedOnSurrogate | None = None

    @property
    def is_hard_to_learn(self) -> bool:
        """Whether proposals look at many features in few steps, and rollouts all start alike."""
        basis = self.basis
        if basis is None or self.starts or not (self.fits and self.fits[0].is_short):
            return False
        return has_many_features(basis, defensive=defence(self.steps))

    @property
    def drawn(self) -> int:
        """Rollouts of the stages."""
        plain = 0 if self.before is None else self.before.count
        return 0 if self.pool is None else self.pool.sampled - plain

    @property
    def searching(self) -> int:
        """Rollouts beside the stages', in which failure modes were searched for."""
        by_chains = 0 if self.explored is None else self.explored.simulated
        return by_chains + self.moved

    @property
    def moved(self) -> int:
        """Those of them by which violations were moved."""
        return self.rejuvenated.simulated + self.resampled.simulated

    @property
    def searched_last(self) -> int:
        """Those of them that came with the stage before."""
        by_chains = self.explored.simulated if self.explored and self.stage == 1 else 0
        return by_chains + self.rejuvenated.newest + self.resampled.newest

    @property
    def final(self) -> slice:
        """Which rollouts of the pool are the final batch, as far as it is sampled."""
        sampled = 0 if self.pool is None else self.pool.sampled
        return slice(sampled - sum(self.frozen), None)


def several_rules(problem: Problem) -> tuple[str, ...]:
    """Their names; empty where there are not several."""
    return tuple(problem.rules) if len(problem.rules) > 1 else ()


def watching(problem: Problem) -> Problem:
    """With a system that remembers what is broken, and that nothing is left to break."""
    rules = several_rules(problem)
    if not rules:
        return with_absorbing_violation(problem)
    each = EachRule({rule: problem.rules[rule].monitor for rule in rules})
    return replace(problem, simulator=with_component(problem.simulator, Monitored(each)))


def main_proposal(state: MixtureState, *, steps: int) -> OffsetLogisticProposal | None:
    """The main proposal that is sampled from next; ``None`` before the first stage."""
    if state.basis is None or not state.fits:
        return None
    means = state.fits[0].means
    return OffsetLogisticProposal(
        features=state.features,
        basis=state.basis,
        coefficients=state.fits[0].coefficients,
        violated=VIOLATED,
        defensive=defence(steps),
        by_step=state.fits[0].by_step,
        latents={} if means is None else means.arrays(),
    )


def sampled(
    problem: Problem, state: MixtureState, component: IntArray, *, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """Rollouts sampled from given components, ascending, ``[N]``, and scored.

    Raises:
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    problem = watching(problem)
    proposal = _divided(problem, state, component, np.random.default_rng(seeds.spawn(1)[0]))
    return sample(problem, proposal=proposal, count=component.size, seeds=seeds)


def _divided(
    problem: Problem, state: MixtureState, component: IntArray, generator: np.random.Generator
) -> DividedProposal:
    """The proposals of rollouts that are to be sampled from given components."""
    steps, explored = problem.simulator.states - 1, component <= PLAIN
    count = int((component == EXPLORATION).sum())
    first = int(component[~explored].min(initial=component.max()))
    fits = [None if c <= PLAIN else state.fits[c - first] for c in component.tolist()]
    exploration = ExplorationFamily.over(steps, turns=state.turns).sampled(
        count, generator, features=state.features, violated=VIOLATED, of=component.size
    )
    fitted = main_proposal(state, steps=steps)
    if fitted is not None:
        nothing = np.zeros(fitted.coefficients.size)
        rows = [nothing if fit is None else fit.coefficients for fit in fits]
        own = [None if fit is None else fit.defensive for fit in fits]
        least = defence(steps)
        offsets = [None if fit is None else fit.by_step for fit in fits]
        fitted = replace(
            fitted,
            coefficients=np.stack(rows),
            defensive=np.array([least if share is None else share for share in own]),
            by_step=None
            if all(each is None for each in offsets)
            else np.stack([np.zeros(steps) if each is None else each for each in offsets]),
        )
    targets = TargetRules.of(state.rules, [fit.rule if fit else None for fit in fits])
    counts = latent_counts(problem.simulator)
    if not counts:
        return DividedProposal(exploration, fitted, explored, targets)
    steps //= state.turns
    family = LatentFamily.over(steps, start=counts.start, noise=counts.noise)
    moving = bool(state.fits) and state.fits[0].means is not None
    basis = state.basis.with_outcome() if moving and state.basis is not None else None
    none = LatentMeans.unmoved(
        start=counts.start, noise=counts.noise, basis=1 if basis is None else len(basis.exponents)
    )
    means = [fit.means or none if fit else none for fit in fits]
    moved = family.sampled(count, generator, of=component.size)
    start = StartMoves.stacked([each.start for each in means])
    start = replace(start, mean=start.mean + moved.start)
    return DividedMoves(
        exploration,
        fitted,
        explored,
        targets,
        moved=moved,
        start=start,
        normals=_even_normals(component, start, generator),
        noise=np.stack([each.noise for each in means]),
        choice=np.stack([each.choice for each in means]),
        sd=np.stack([each.sd for each in means]),
        narrow=np.stack([each.narrow_noise for each in means]),
        one=np.array([each.once for each in means]),
        basis=basis,
        steps=steps,
        turns=state.turns,
    )


def _even_normals(
    component: IntArray, start: StartMoves, generator: np.random.Generator
) -> FloatArray:
    """What starts of each fitted proposal's rollouts are made of, ``[N, 1 + S]``."""
    found = np.zeros((component.size, 1 + start.mean.shape[1]))
    if not start.mean.shape[1]:
        return found
    sets = np.where(component > PLAIN, component * (REPLICATES + 1) + replicates(component), -1)
    for number in np.unique(sets[sets >= 0]):
        rows = sets == number
        found[rows] = even_normals(int(np.count_nonzero(rows)), found.shape[1], generator)
    found[:, 1:] = start.turned(found[:, 1:])
    return found


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
class SampledStage:
    """A stage that is sampled.

    Attributes:
        scored: Its rollouts, or those that are held.
        sampled: What is known of all, where not all are held.
        joining: Those that join the pool.
    """

    scored: ScoredRollouts
    sampled: SampledRollouts | None
    joining: Joining

    @property
    def count(self) -> int:
        """How many were sampled."""
        return self.scored.rollouts.count if self.sampled is None else self.sampled.count

    def joining_beside(self, component: IntArray) -> Joining:
        """Those that join: of plain ones what violates, or is lost; the others count.

        ``component`` is what each was sampled from, ``[N]``.
        """
        scored = self.joining.scored
        if self.joining.row is not None or not (component == PLAIN).any():
            return self.joining
        joins = scored.violated | (component != PLAIN) | lost_rows(scored.rollouts)
        row = np.flatnonzero(joins).astype(np.int64)
        return Joining(scored.take(row), row)


@dataclass(frozen=True)
class InParts:
    """How a large stage is sampled.

    Attributes:
        count: So many rollouts at most.
        enough: Violations after which it is over.
    """

    count: int
    enough: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of its parts, if all are sampled."""
        return part_sizes(self.count, largest=max(1, self.enough // PARTS))

    @property
    def most(self) -> int:
        """Violations that it has at most, and the least robust others join up to as many."""
        return self.enough + max(1, self.enough // PARTS)

    def sample(self, problem: Problem, part: Part) -> SampledStage:
        """As many parts as it takes.

        Raises:
            SimulationError: A batch has something that is no finite number, or takes too long.
        """
        thinned, whole = Thinned(count=self.count, most=self.most), Whole()
        done = violations = 0

        def progress(some: int, _: int) -> None:
            problem.progress(done + some, self.count)

        for number, size in enumerate(self.sizes):
            with counted_from(done):
                scored = part(replace(problem, progress=progress), number, size)
            thinned = thinned.extended(scored)
            if not problem.thins:
                whole = whole.extended(scored)
            done, violations = done + size, violations + int(scored.violated.sum())
            if violations >= self.enough:
                break
        held, sampled = thinned.done()
        joining = self._joining(held, sampled)
        if problem.thins:
            return SampledStage(held, sampled, joining)
        return SampledStage(whole.done()[0], None, joining)

    def restored(self, finished: FinishedStage) -> SampledStage:
        """As an interrupted run left it."""
        scored, sampled = finished.scored, finished.sampled
        if sampled is not None:
            return SampledStage(scored, sampled, self._joining(scored, sampled))
        thinned = Thinned(count=self.count, most=self.most).extended(scored)
        return SampledStage(scored, None, self._joining(*thinned.done()))

    def _joining(self, held: ScoredRollouts, sampled: SampledRollouts) -> Joining:
        """The least robust as they are, an even sample for the others."""
        least = np.zeros(sampled.count, dtype=np.bool_)
        least[least_robust(sampled.robustness, sampled.violated)[: self.most]] = True
        own, others = least[sampled.row], sampled.even & ~least[sampled.row]
        standing = np.zeros(sampled.row.size)
        if others.any():
            standing[others] = math.log(np.count_nonzero(~least) / np.count_nonzero(others))
        chosen = own | others
        return Joining(
            held.take(chosen), sampled.row[chosen], standing[chosen], sampled.even[chosen]
        )
