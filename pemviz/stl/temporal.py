"""Temporal operators of Signal Temporal Logic: always, eventually, until.

Intervals are closed, in steps from the present one.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import ClassVar

from pemviz.stl.errors import FormulaError
from pemviz.stl.formulas import Formula, as_formula
from pemviz.stl.nodes import Node

MAX_BOUND = 1_000_000_000
"""Largest interval bound in steps."""


@dataclass(frozen=True)
class _Timed(Formula):
    first: int
    last: int

    word: ClassVar[str]

    def __post_init__(self) -> None:
        first, last = _bound(self.word, self.first), _bound(self.word, self.last)
        if first > last:
            raise FormulaError(
                f"interval [{first},{last}] of '{self.word}' is reversed; did you mean"
                f" [{last},{first}]?"
            )
        object.__setattr__(self, "first", first)
        object.__setattr__(self, "last", last)
        super().__post_init__()

    @property
    def width(self) -> int:
        """Number of steps in the interval."""
        return self.last - self.first + 1

    @property
    def head(self) -> str:
        """The operator with its interval, as in ``always[0,99]``."""
        return f"{self.word}[{self.first},{self.last}]"

    def horizon_steps(self) -> int:
        return self.last + super().horizon_steps()


@dataclass(frozen=True)
class _Window(_Timed):
    operand: Formula

    strength: ClassVar[int] = 5

    def children(self) -> tuple[Node, ...]:
        return (as_formula(self.operand),)

    def __str__(self) -> str:
        return f"{self.head} ({self.operand})"


@dataclass(frozen=True)
class Always(_Window):
    """``always[first,last] (operand)``."""

    word: ClassVar[str] = "always"


@dataclass(frozen=True)
class Eventually(_Window):
    """``eventually[first,last] (operand)``."""

    word: ClassVar[str] = "eventually"


@dataclass(frozen=True)
class Until(_Timed):
    """``(left) until[first,last] (right)``, inclusive.

    At t: ``right`` holds at some t' in [t + first, t + last], and ``left`` at every
    step of [t, t'], both ends included.
    """

    left: Formula
    right: Formula

    word: ClassVar[str] = "until"
    strength: ClassVar[int] = 4

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (as_formula(self.left), as_formula(self.right))

    def __str__(self) -> str:
        return f"({self.left}) {self.head} ({self.right})"


def _bound(word: str, bound: object) -> int:
    try:
        steps = operator.index(bound)  # pyright: ignore[reportArgumentType]
    except TypeError:
        raise FormulaError(
            f"interval bound {bound!r} of '{word}' must be a whole number of steps"
        ) from None
    if not 0 <= steps <= MAX_BOUND:
        raise FormulaError(
            f"interval bound {steps} of '{word}' must be between 0 and {MAX_BOUND} steps"
        )
    return steps
