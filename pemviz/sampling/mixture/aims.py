"""With several rules: which of them a proposal is to break, and until when a rollout is judged.

Whether a rule is broken is known as soon as it is, and what a rollout is drawn from later tells
nothing more of it. So a proposal that is fitted to the ways of breaking a rule leaves the error
model until that rule is broken, and a rollout's likelihood under a rule is that of its outcomes up
to there: what comes later would only spread the weights. Of the rules together, that at least one
is broken, it is that of the outcomes up to the first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray
from pemviz.simulators.latched import violated_rule

Rule = str | None
"""A rule's name; ``None``: all rules together, or the specification where there is none."""


@dataclass(frozen=True, eq=False)
class Aims:
    """The rule that each of N rollouts is drawn to break.

    Attributes:
        rules: Names of all; empty where there is but the specification.
        chosen: Which of them, ``[N]``; -1: none by itself.
    """

    rules: tuple[str, ...]
    chosen: IntArray

    @staticmethod
    def of(rules: tuple[str, ...], aims: Sequence[Rule]) -> "Aims":
        """Of rollouts by name."""
        places = {None: -1, **{rule: place for place, rule in enumerate(rules)}}
        return Aims(rules, np.array([places.get(aim, -1) for aim in aims], dtype=np.int64))

    def reached(self, memory: Mapping[str, AnyArray]) -> BoolArray:
        """Which rollouts have broken theirs, ``[N]``, by what states remember."""
        found = self.chosen != self.chosen
        for place, rule in enumerate(self.rules):
            found = found | (memory[violated_rule(rule)] & (self.chosen == place))
        return found

    def rows(self, rows: slice) -> "Aims":
        """Of some of the rollouts."""
        return Aims(self.rules, self.chosen[rows])


def broken_at(memory: Mapping[str, AnyArray], rules: Sequence[str]) -> BoolArray | None:
    """Which rules are broken at states ``[...]``, ``[..., R]``; ``None`` without rules."""
    if not rules:
        return None
    return np.stack([memory[violated_rule(rule)] for rule in rules], axis=-1)


def still_open(broken: BoolArray | None, rules: Sequence[str], rule: Rule) -> BoolArray | None:
    """Where a rule is not broken yet, ``[...]`` of ``[..., R]``; ``None`` stands for everywhere."""
    if broken is None:
        return None
    closed = broken.any(axis=-1) if rule is None else broken[..., rules.index(rule)]
    return np.logical_not(np.asarray(closed))


def both(first: BoolArray | None, second: BoolArray | None) -> BoolArray | None:
    """Where both are; ``None`` stands for everywhere."""
    if first is None or second is None:
        return second if first is None else first
    return first & second


def where_open(values: AnyArray, open_there: BoolArray | None) -> AnyArray:
    """The values, 0 elsewhere."""
    return values if open_there is None else np.where(open_there, values, 0.0)
