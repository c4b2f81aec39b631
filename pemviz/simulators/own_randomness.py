"""Whether a simulator draws random numbers that are the same in every rollout.

Generators that a reset seeds anew, and seeds that are written in the code, repeat exactly: rollouts
that are simulated again are the same, and an answer is right for one course of such numbers alone.
"""

import gc
import random
import sys
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from pemviz.errors import ConfigError
from pemviz.simulators.latents import parts_of
from pemviz.types import StateBatch

OTHER_SEEDS = 5
"""Tried where random numbers are drawn at the start alone."""
MOST_OBJECTS = 100_000
"""Of a simulator's, among which its generators are looked for."""
ALIKE = "its random numbers are the same in every rollout"
SEEDED = (
    (np.random, "default_rng"),
    (np.random, "seed"),
    (np.random, "RandomState"),
    (np.random, "PCG64"),
    (np.random, "MT19937"),
    (random, "seed"),
    (random, "Random"),
)
"""What takes a seed, by module and name; torch's is added where torch is in use."""
ADAPTER = "reset"
"""The source of an environment's seed: it is asked for whether anything is drawn or not."""

Asked = tuple[str, str]
"""What was given a seed, and the seed in words."""
Bound = tuple[dict[str, Any], str, Any, str]
"""A module's names, one of them, what it stands for, and what this is called at home."""


@dataclass
class Sources:
    """Seeds that are asked for while it is in force.

    Attributes:
        asked: All of them so far.
        others: For these another seed is taken.
        shift: Which other seed: a number from 1.
    """

    asked: set[Asked] = field(default_factory=set[Asked])
    others: frozenset[Asked] = frozenset()
    shift: int = 0

    def seed(self, source: str, seed: Any) -> Any:
        """The seed to take where ``seed`` was asked for."""
        key = source, repr(seed)
        self.asked.add(key)
        if key not in self.others:
            return seed
        return zlib.crc32(f"{source} {seed!r} {self.shift}".encode())


_IN_FORCE: list[Sources] = []


def seed_of_reset(seed: int) -> int:
    """An environment's seed, or another one while it is tried whether that makes a difference."""
    return _IN_FORCE[-1].seed(ADAPTER, seed) if _IN_FORCE else seed


def fixed_randomness(simulator: object) -> bool:
    """Whether it states that its own randomness is the same in every rollout on purpose."""
    return any(getattr(part, "fixed_randomness", False) for part in parts_of(simulator))


def drawn_alike(
    simulator: object,
    rollout: Callable[[int], Iterator[StateBatch]],
    *,
    difference: Callable[[StateBatch, StateBatch], str],
) -> str:
    """What of its random numbers is the same in every rollout, in words; empty if nothing is.

    Args:
        simulator: As it is.
        rollout: The states ``[1]`` of a rollout, one after the other, with latents of its own by
            number (0 or 1) and always the same outcomes.
        difference: In which two states differ, in words; empty if they do not.
    """
    bound = _bound()
    (states, drawn, seeds), (_, drawn_too, seeds_too) = (
        _watched(simulator, rollout(number), bound) for number in range(2)
    )
    if drawn & drawn_too:
        return f"{ALIKE}: its steps draw them"
    fixed = frozenset(seeds & seeds_too)
    for shift in range(1, OTHER_SEEDS + 1) if fixed else ():
        try:
            with _in_force(Sources(others=fixed, shift=shift), bound):
                others = list(rollout(0))
        except ConfigError as error:  # it knows no other course
            return f"{ALIKE}; from another seed there is none: {error}"
        for step, (one, other) in enumerate(zip(states, others, strict=True)):
            if where := difference(one, other):
                return f"{ALIKE}; from another seed it differs at step {step} ({where})"
    return ""


def _watched(
    simulator: object, rollout: Iterator[StateBatch], bound: Sequence[Bound]
) -> tuple[list[StateBatch], set[Asked], set[Asked]]:
    """The states, what is drawn in steps, and all seeds asked for."""
    with _in_force(Sources(), bound) as sources:
        states = [next(rollout)]
        at_start, generators = set(sources.asked), _generators((simulator, states[0]))
        states.extend(rollout)
        in_steps = {one for one in sources.asked - at_start if one[0] != ADAPTER}
    moved = _generators((simulator, states[-1])) - generators
    return states, in_steps | moved, sources.asked


def _bound() -> list[Bound]:
    """Where modules have what takes a seed."""
    torch = sys.modules.get("torch")
    seeded = [*SEEDED, *((module, "manual_seed") for module in [torch] if module is not None)]
    names_of = {id(getattr(module, name)): name for module, name in seeded}
    dicts = [getattr(module, "__dict__", None) for module in list(sys.modules.values())]
    return [
        (names, name, value, names_of[id(value)])
        for names in dicts
        if isinstance(names, dict) and not names_of.keys().isdisjoint(map(id, list(names.values())))
        for name, value in list(names.items())
        if id(value) in names_of
    ]


@contextmanager
def _in_force(sources: Sources, bound: Sequence[Bound]) -> Generator[Sources]:
    """With what takes a seed replaced, wherever it is bound, by what tells it to ``sources``."""
    proxies = {id(value): _telling(own, value, sources) for _, _, value, own in bound}
    _IN_FORCE.append(sources)
    try:
        for names, name, value, _ in bound:
            names[name] = proxies[id(value)]
        yield sources
    finally:
        for names, name, value, _ in bound:
            names[name] = value
        _IN_FORCE.pop()


def _telling(name: str, original: Any, sources: Sources) -> Any:
    """In place of a function or class that takes a seed, and is one for ``isinstance`` too."""

    class Telling(type):
        def __call__(cls, seed: Any = None, *args: Any, **kwargs: Any) -> Any:
            key = next((key for key in ("seed", "x") if key in kwargs), "")
            if key:
                seed = kwargs.pop(key)
            if seed is None or isinstance(seed, np.random.BitGenerator | np.random.Generator):
                return original(seed, *args, **kwargs)
            return original(sources.seed(name, seed), *args, **kwargs)

        def __instancecheck__(cls, instance: object) -> bool:
            return isinstance(instance, original)

        def __subclasscheck__(cls, subclass: type) -> bool:
            return issubclass(subclass, original)

    return Telling(name, (), {})


def _generators(roots: Iterable[object]) -> set[Asked]:
    """The states of all random generators within, and of those that a process has once."""
    numpys = np.random.get_state(legacy=False)  # noqa: NPY002  of the process, not ours
    found = {("random", repr(hash(random.getstate()))), ("numpy.random", _words(numpys))}
    torch: Any = sys.modules.get("torch")
    if torch is not None:
        found.add(("torch", repr(hash(torch.get_rng_state().numpy().tobytes()))))
    for one in _within(roots):
        state = one.getstate() if isinstance(one, random.Random) else one.state
        found.add((type(one).__name__, _words(state)))
    return found


def _words(state: Any) -> str:
    if isinstance(state, dict):
        return repr([_words(value) for value in state.values()])
    return repr(hash(state.tobytes())) if isinstance(state, np.ndarray) else repr(hash(state))


def _within(roots: Iterable[object]) -> Iterator[Any]:
    """Random generators among all that objects hold; not what modules, classes and globals do."""
    waiting, seen = list[Any](roots), set[int]()
    held = list[Any]()  # so that no identity is given twice
    while waiting and len(seen) < MOST_OBJECTS:
        one = waiting.pop()
        if id(one) in seen or issubclass(type(one), type | ModuleType | str | bytes | int | float):
            continue
        seen.add(id(one))
        held.append(one)
        if issubclass(type(one), random.SystemRandom):
            continue  # has no state, and never gives the same again
        if issubclass(type(one), np.random.BitGenerator | random.Random):
            yield one
        elif issubclass(type(one), np.ndarray):
            waiting.extend(one.tolist() if one.dtype == np.object_ and one.ndim else ())
        elif issubclass(type(one), FunctionType):
            waiting.extend((one.__closure__, one.__defaults__, one.__kwdefaults__))
        else:
            waiting.extend(gc.get_referents(one))
