"""Formulas of Signal Temporal Logic over discrete steps, and the connectives between them.

The language is that of Innes & Ramamoorthy (arXiv 2209.09674): true, not, and, or, implies stand
here; predicates in ``expressions.py``; always, eventually, until over closed intervals of steps in
``temporal.py``. ``str(formula)`` is text that parses back to an equal formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NoReturn

from pemviz.stl.errors import FormulaError, shorten
from pemviz.stl.nodes import Node


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
class Not(Formula):
    """``not operand``."""

    operand: Formula

    strength: ClassVar[int] = 5

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (as_formula(self.operand),)

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
        return tuple(as_formula(part) for part in self.parts)

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
        return (as_formula(self.premise), as_formula(self.conclusion))

    def __str__(self) -> str:
        return f"{_text(self.premise, 2)} -> {_text(self.conclusion, 2)}"


def negates(formula: Formula, index: int) -> bool:
    """Whether ``formula`` holds sooner where its child of that index does not."""
    return isinstance(formula, Not) or (isinstance(formula, Implies) and index == 0)


def as_formula(value: object) -> Formula:
    """``value`` itself.

    Raises:
        FormulaError: ``value`` is no formula.
    """
    if isinstance(value, Formula):
        return value
    raise FormulaError(
        f"{shorten(value)} is no formula; compare it with something, as in (gap >= 2.0)"
    )


def _text(operand: Formula, strength: int) -> str:
    return str(operand) if operand.strength >= strength else f"({operand})"
