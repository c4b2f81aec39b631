"""What a simulator with latents must keep to beyond what every simulator must."""

from typing import NoReturn

import numpy as np

from pemviz.errors import ConfigError
from pemviz.latents import LatentCounts, StandardNormals
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import begun, latent_counts, stepped
from pemviz.types import Simulator, StateBatch

TRIED = 4
"""Rollouts by which it is found out whether latents make a difference."""


def check_counts(simulator: object, where: str) -> None:
    """The declaration: whole numbers from 0.

    Raises:
        ConfigError: One line, which begins with ``where``.
    """
    declared = getattr(simulator, "latents", None)
    if declared is None:
        return
    if not isinstance(declared, LatentCounts):
        _refuse(f"{where}: latents is a {type(declared).__name__}: must be pemviz.LatentCounts")
    for name in ("start", "noise", "seeds"):
        number = getattr(declared, name)
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 0:
            _refuse(f"{where}: latents: {name} = {number!r}: must be a whole number from 0")


def tried_normals(simulator: Simulator, *, count: int) -> StandardNormals:
    """Latents of ``count`` rollouts, of which the last two have the same."""
    latents, generator = latent_counts(simulator), np.random.default_rng(0)
    normals = StandardNormals(
        start=generator.standard_normal((count, latents.at_start)),
        noise=generator.standard_normal((count, simulator.states - 1, latents.noise)),
        choice=np.zeros((count, simulator.states - 1)),
        spread_choice=np.zeros(count),
    )
    return normals.take(np.array([*range(count - 1), count - 2]))


def latent_warnings(simulator: Simulator) -> tuple[str, ...]:
    """Latents that are declared and make no difference, which may be meant.

    A latent at the start that only shows later counts as ignored if nothing in signals and memory
    differs at the start.
    """
    latents, found = latent_counts(simulator), list[str]()
    generator = np.random.default_rng(1)
    for place in range(latents.start):
        start = np.zeros((TRIED, latents.at_start))
        start[:, place] = generator.standard_normal(TRIED)
        if _alike(begun(simulator, count=TRIED, start=start)):
            found.append(f"simulator {simulator.name}: initial ignores start latent {place}")
    if episodic(simulator) is not None:  # few at a time, and each step is dear
        return tuple(found)
    states = begun(simulator, count=TRIED)
    for place in range(latents.noise):
        noise = np.zeros((TRIED, latents.noise))
        noise[:, place] = generator.standard_normal(TRIED)
        if _ignored(simulator, states, noise):
            found.append(f"simulator {simulator.name}: step ignores noise {place}")
    return tuple(found)


def _ignored(simulator: Simulator, states: StateBatch, noise: np.ndarray) -> bool:
    """Whether noise makes no difference at any step, be all missed or all detected."""
    for outcome in (False, True):
        reached, outcomes = states, np.full(TRIED, outcome)
        for _ in range(simulator.states - 1):
            reached = stepped(simulator, reached, outcomes, noise)
            if not _alike(reached):
                return False
    return True


def _alike(states: StateBatch) -> bool:
    """Whether all rows are one state, as far as numbers tell."""
    for values in (*states.signals.values(), *states.memory.values()):
        if values.dtype == np.object_ or np.any(values != values[:1]):
            return False
    return True


def _refuse(message: str) -> NoReturn:
    raise ConfigError(message)
