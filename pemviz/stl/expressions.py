"""Predicates of Signal Temporal Logic, and the numeric expressions over signals that they compare.

Python's operators build both: ``signal("gap") - 2.5`` is an expression, and one of the four order
comparisons turns two expressions into a predicate.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias

from pemviz.stl.errors import FormulaError, shorten
from pemviz.stl.formulas import Formula
from pemviz.stl.nodes import Node

RESERVED_WORDS = frozenset(
    {"true", "false", "not", "and", "or", "always", "eventually", "until"}
    | {"G", "F", "U", "abs", "min", "max"}
)

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


Number: TypeAlias = int | float
Comparison: TypeAlias = Literal[">=", ">", "<=", "<"]


@dataclass(frozen=True)
class Expression(Node):
    """A number at every step of a rollout. ``str`` gives the text form."""

    strength: ClassVar[int] = 4  # how tightly the text form binds: sum 1, product 2, minus 3

    def __add__(self, other: Expression | Number) -> Expression:
        return Sum(self, as_expression(other))

    def __radd__(self, other: Number) -> Expression:
        return Sum(as_expression(other), self)

    def __sub__(self, other: Expression | Number) -> Expression:
        return Difference(self, as_expression(other))

    def __rsub__(self, other: Number) -> Expression:
        return Difference(as_expression(other), self)

    def __mul__(self, other: Expression | Number) -> Expression:
        return Product(self, as_expression(other))

    def __rmul__(self, other: Number) -> Expression:
        return Product(as_expression(other), self)

    def __truediv__(self, other: Expression | Number) -> Expression:
        return Quotient(self, as_expression(other))

    def __rtruediv__(self, other: Number) -> Expression:
        return Quotient(as_expression(other), self)

    def __neg__(self) -> Expression:
        return Negative(self)

    def __abs__(self) -> Expression:
        return Absolute(self)

    def __ge__(self, other: Expression | Number) -> Predicate:
        return _compare(self, ">=", other)

    def __gt__(self, other: Expression | Number) -> Predicate:
        return _compare(self, ">", other)

    def __le__(self, other: Expression | Number) -> Predicate:
        return _compare(self, "<=", other)

    def __lt__(self, other: Expression | Number) -> Predicate:
        return _compare(self, "<", other)


def _compare(left: Expression, comparison: Comparison, right: Expression | Number) -> Predicate:
    return Predicate(left, comparison, as_expression(right))


@dataclass(frozen=True)
class Constant(Expression):
    """A finite number."""

    value: float

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "value", float(self.value))
        if not math.isfinite(self.value):
            raise FormulaError(f"number {self.value} in a formula must be finite")

    def __str__(self) -> str:
        return repr(self.value)


@dataclass(frozen=True)
class Signal(Expression):
    """A signal, by name."""

    name: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.match(self.name):
            raise FormulaError(
                f"signal name {shorten(repr(self.name))}: allowed are letters, digits and _,"
                " no digit first"
            )
        if self.name in RESERVED_WORDS:
            raise FormulaError(f"signal name {self.name!r} is a word of the language")

    def own_signals(self) -> frozenset[str]:  # noqa: D102
        return frozenset({self.name})

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class _Binary(Expression):
    left: Expression
    right: Expression

    symbol: ClassVar[str]

    def children(self) -> tuple[Node, ...]:
        return (self.left, self.right)

    def __str__(self) -> str:
        # The text form groups from the left, so an equally strong right side needs parentheses.
        left = _text(self.left, self.strength)
        return f"{left} {self.symbol} {_text(self.right, self.strength + 1)}"


@dataclass(frozen=True)
class Sum(_Binary):
    """``left + right``."""

    symbol: ClassVar[str] = "+"
    strength: ClassVar[int] = 1


@dataclass(frozen=True)
class Difference(_Binary):
    """``left - right``."""

    symbol: ClassVar[str] = "-"
    strength: ClassVar[int] = 1


@dataclass(frozen=True)
class Product(_Binary):
    """``left * right``."""

    symbol: ClassVar[str] = "*"
    strength: ClassVar[int] = 2


@dataclass(frozen=True)
class Quotient(_Binary):
    """``left / right``."""

    symbol: ClassVar[str] = "/"
    strength: ClassVar[int] = 2


@dataclass(frozen=True)
class Negative(Expression):
    """``-operand``."""

    operand: Expression

    strength: ClassVar[int] = 3

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (self.operand,)

    def __str__(self) -> str:
        # "-2.0" is a number of its own: the minus of a number stays outside parentheses.
        inner = str(self.operand)
        bare = self.operand.strength >= self.strength and not isinstance(self.operand, Constant)
        return f"-{inner}" if bare else f"-({inner})"


@dataclass(frozen=True)
class Absolute(Expression):
    """``abs(operand)``."""

    operand: Expression

    def children(self) -> tuple[Node, ...]:  # noqa: D102
        return (self.operand,)

    def __str__(self) -> str:
        return f"abs({self.operand})"


@dataclass(frozen=True)
class _Extreme(Expression):
    operands: tuple[Expression, ...]

    word: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.operands) < 2:
            raise FormulaError(f"{self.word} takes two or more numbers, separated by commas")

    def children(self) -> tuple[Node, ...]:
        return self.operands

    def __str__(self) -> str:
        return f"{self.word}({', '.join(str(operand) for operand in self.operands)})"


@dataclass(frozen=True)
class Minimum(_Extreme):
    """``min(a, b, ...)``, step by step."""

    word: ClassVar[str] = "min"


@dataclass(frozen=True)
class Maximum(_Extreme):
    """``max(a, b, ...)``, step by step."""

    word: ClassVar[str] = "max"


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

    @property
    def is_strict(self) -> bool:
        """Whether it fails where both sides are equal (``>``, ``<``)."""
        return self.comparison in (">", "<")

    def __str__(self) -> str:
        return f"{self.left} {self.comparison} {self.right}"


def as_expression(value: Expression | Number) -> Expression:
    """``value`` itself, or the constant of that number.

    Raises:
        FormulaError: ``value`` is neither an expression nor a number.
    """
    if isinstance(value, Expression):
        return value
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        raise FormulaError(
            f"{shorten(repr(value))} is no number; allowed: signals, numbers, arithmetic on them"
        )
    return Constant(float(value))


def _expression(value: object) -> Expression:
    if isinstance(value, Expression):
        return value
    raise FormulaError(f"{shorten(value)} is no number and cannot be compared")


def _text(operand: Expression, strength: int) -> str:
    return str(operand) if operand.strength >= strength else f"({operand})"
