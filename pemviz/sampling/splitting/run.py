"""Runs of adaptive multilevel splitting: rollouts that come close are cut and continued.

Norden, O'Kelly, Sinha 2019 use it for black-box assessment of driving; the estimator is the
adaptive multilevel splitting of Brehier, Gazeau, Goudenege, Lelievre, Rousset 2016, which is
unbiased with ties.

N particles follow the error model. Level l is their median; the K_l of them that never came below
it are replaced by continuations of others, each from where it first came below. Levels fall until
the median violates, or none came below (then mu_r = 0). F of them violate in the end. What is
compared with levels is the importance function of :mod:`pemviz.sampling.splitting.importance`::

    mu_r = (F / N) prod_l (1 - K_l / N)
"""

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import numpy as np

from pemviz.faults import SimulationError
from pemviz.sampling.method import VIOLATION_THRESHOLD
from pemviz.sampling.particles.runs import (
    ParticleRun,
    copies,
    in_step,
    log_product,
    tell_run,
)
from pemviz.sampling.problem import Problem, in_time, score
from pemviz.sampling.splitting.particles import (
    Continuation,
    Particles,
    beginning,
    continued,
    restart,
)

KILLED_SHARE = 0.5
MOST_LEVELS = 10_000


Levels = Generator[Continuation, Particles, ParticleRun]
"""A run as it goes: what it wants continued, for what came of that; at the end the run."""


@dataclass(frozen=True)
class Splitting:
    """Runs of adaptive multilevel splitting, which need nothing before they begin."""

    moved_share: ClassVar[float] = 1.0

    def prepare(
        self,
        problem: Problem,  # noqa: ARG002  nothing is to be found
        *,
        count: int,  # noqa: ARG002  likewise
        generator: np.random.Generator,  # noqa: ARG002  likewise
    ) -> tuple[Self, int]:
        """Itself."""
        return self, 0

    def carry_out(
        self, problem: Problem, *, count: int, generators: Sequence[np.random.Generator]
    ) -> Sequence[ParticleRun]:
        """See :func:`split`."""
        return split(problem, count=count, generators=generators)


def split(
    problem: Problem, *, count: int, generators: Sequence[np.random.Generator]
) -> Sequence[ParticleRun]:
    """Independent runs with ``count`` particles each, one for each of ``generators``.

    At every level the particles that have not come below it are replaced by continuations of
    those that have, each as often as any other but for one. The estimate is unbiased, ties
    included (Brehier, Gazeau, Goudenege, Lelievre, Rousset 2016). The runs keep step, so that
    the scenario moves all of their particles at once; none depends on another.

    Raises:
        ConfigError: The simulator's states hold more than can be kept.
        SimulationError: Something raises, is no finite number, or a level takes too long.
    """
    done = [0] * len(generators)

    def report(run: int, so_far: int) -> None:
        done[run] = so_far
        problem.progress(sum(done) // len(done), count)

    def answer(wanted: Mapping[int, Continuation]) -> Sequence[Particles]:
        try:
            return in_time(problem, partial(continued, problem, list(wanted.values())))
        except SimulationError as error:
            sizes = {index: each.cut.size for index, each in wanted.items()}
            # those that are kept come first
            tell_run(error, {index: (count - size, size) for index, size in sizes.items()})
            raise

    going = [
        _levels(problem, count=count, generator=generator, report=partial(report, index))
        for index, generator in enumerate(generators)
    ]
    return in_step(going, answer)


def _levels(
    problem: Problem,
    *,
    count: int,
    generator: np.random.Generator,
    report: Callable[[int], None],
) -> Levels:
    """One run; ``report`` gets how many of ``count`` particles are as good as done."""
    particles = yield beginning(problem, count=count, generator=generator)
    shares: list[float] = []
    simulated = count
    while len(shares) < MOST_LEVELS:
        # the score from which on particles are replaced: the median, the higher if there are two
        place = math.ceil((1.0 - KILLED_SHARE) * (particles.count - 1))
        level = float(np.partition(particles.lowest, place)[place])
        report(_on_the_way(log_product(shares), level, count=count))
        killed = particles.lowest >= level
        if level < VIOLATION_THRESHOLD or killed.all():
            break
        shares.append(1.0 - float(killed.mean()))
        survivors, lost = np.flatnonzero(~killed), int(killed.sum())
        simulated += lost
        # each killed one continues a survivor from where that first came below the level
        parent = survivors[copies(survivors.size, lost, generator)]
        cut = np.argmax(particles.score[parent] < level, axis=1)
        new = yield restart(particles, parent=parent, cut=cut, generator=generator)
        particles = Particles.concatenate([particles.take(np.flatnonzero(~killed)), new])
    report(count)
    scored = score(problem, particles.with_proposal)
    return ParticleRun.ended(
        scored, ancestor=particles.ancestor, shares=shares, simulated=simulated
    )


def _on_the_way(log_share: float, level: float, *, count: int) -> int:
    """``count`` times the share of the way to a violation that is done.

    How often particles are cut and continued is not known before. The logarithm of the share
    that came this far tells how far a run is, and the level, about -log of the probability
    of the rest, how far it has to go.
    """
    left = max(level, 0.0)
    return int(count * -log_share / (left - log_share)) if log_share < 0.0 else 0
