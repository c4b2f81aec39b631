"""The syntax tree of Signal Temporal Logic over discrete steps.

The language is that of Innes & Ramamoorthy (arXiv 2209.09674): true, predicates,
not, and, or, implies, and always, eventually, until over closed intervals of steps.
``str(formula)`` is text that parses back to an equal formula.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import ClassVar, Literal, NoReturn, TypeAlias

from pemviz.stl.errors import FormulaError, shorten
from pemviz.stl.expressions import Expression, Node

Comparison: TypeAlias = Literal[">=", ">", "<=", "<"]

MAX_BOUND = 1_000_000_000
"""Largest interval bound in steps."""


@dataclass(frozen=True)
class Formula(Node):
    """Something that holds or fails at every step of a rollout."""

    strength: ClassVar[int]  # how tightly the text form binds, see the grammar

    def horizon_steps(self) -> int:
        """How many steps past step t decide the formula at t.

        A rollout needs ``horizon_steps() + 1`` states for the formula to have a
        value at step 0.
        """
        return max(
            (part.horizon_steps() for part in self.children() if isinstance(part, Formula)),
            default=0,
        )

    def __and__(self, other: Formula) -> And:
        """``a & b & c`` is the text's ``a and b and c``: one conjunction of three parts."""
        parts = self.parts if isinstance(self, And) else (self,)
        return And((*parts, other))

    def __or__(self, other: Formula) -> Or:
        """``a | b | c`` is the text's ``a or b or c``: one disjunction of three parts."""
        parts = self.parts if isinstance(self, Or) else (self,)
        return Or((*parts, other))

    def __invert__(self) -> Not:
        return Not(self)

    def implies(self, other: Formula) -> Implies:
        """``self -> other``."""
        return Implies(self, other)

    def __bool__(self) -> NoReturn:
        raise FormulaError(
            f"formula ({shorten(self)}) has no truth value in Python: combine formulas with & | ~,"
            " and write 1 < x < 3 as (1 < x) & (x < 3)"
        )


@dataclass(frozen=True)
class Truth(Formula):
    """``true``."""

    strength: ClassVar[int] = 7

    def __str__(self) -> str:
        return "true"


@dataclass(frozen=True)
class Predicate(Formula):
    """``left >= right`` and its kin: an order comparison of two numbers."""

    left: Expression
    comparison: Comparison
    right: Expression

    strength: ClassVar[int] = 6

    def __post_init__(self) -> None:
        if self.comparison not in (">=", ">", "<=", "<"):
            raise FormulaError(f"comparison {self.comparison!r}: allowed are >= > <= <")
        super().__post_init__()

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (_expression(self.left), _expression(self.right))

    @property
    def is_lower_bound(self) -> bool:
        """Whether more of ``left`` is better (``>=``, ``>``)."""
        return self.comparison in (">=", ">")

    def __str__(self) -> str:
        return f"{self.left} {self.comparison} {self.right}"


@dataclass(frozen=True)
class Not(Formula):
    """``not operand``."""

    operand: Formula

    strength: ClassVar[int] = 5

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (_formula(self.operand),)

    def __str__(self) -> str:
        return f"not {_text(self.operand, Truth.strength)}"


@dataclass(frozen=True)
class _Junction(Formula):
    parts: tuple[Formula, ...]

    word: ClassVar[str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if len(self.parts) < 2:
            raise FormulaError(f"'{self.word}' takes two or more formulas")
        super().__post_init__()

    def children(self) -> tuple[Node, ...]:
        return tuple(_formula(part) for part in self.parts)

    def __str__(self) -> str:
        return f" {self.word} ".join(_text(part, self.strength + 1) for part in self.parts)


@dataclass(frozen=True)
class And(_Junction):
    """``a and b and ...``: one conjunction of all its parts (agm averages over them)."""

    word: ClassVar[str] = "and"
    strength: ClassVar[int] = 3


@dataclass(frozen=True)
class Or(_Junction):
    """``a or b or ...``: one disjunction of all its parts (agm averages over them)."""

    word: ClassVar[str] = "or"
    strength: ClassVar[int] = 2


@dataclass(frozen=True)
class Implies(Formula):
    """``premise -> conclusion``, that is ``not premise or conclusion``."""

    premise: Formula
    conclusion: Formula

    strength: ClassVar[int] = 1

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (_formula(self.premise), _formula(self.conclusion))

    def __str__(self) -> str:
        return f"{_text(self.premise, 2)} -> {_text(self.conclusion, 2)}"


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
        return (_formula(self.operand),)

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
        return (_formula(self.left), _formula(self.right))

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


def _formula(value: object) -> Formula:
    if isinstance(value, Formula):
        return value
    raise FormulaError(
        f"{shorten(value)} is no formula; compare it with something, as in (gap >= 2.0)"
    )


def _expression(value: object) -> Expression:
    if isinstance(value, Expression):
        return value
    raise FormulaError(f"{shorten(value)} is no number and cannot be compared")


def _text(operand: Formula, strength: int) -> str:
    return str(operand) if operand.strength >= strength else f"({operand})"
