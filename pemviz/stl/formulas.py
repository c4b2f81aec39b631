"""Signal Temporal Logic over discrete steps: formulas, and the numbers over signals they compare.

The language is that of Innes & Ramamoorthy (arXiv 2209.09674): true, order comparisons, not, and,
or, implies, and always, eventually, until over closed intervals of steps from the present one.
``str(formula)`` is text that parses back to an equal formula. Depth and number of parts are
limited, so that no text can exhaust stack or memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal, NoReturn, TypeAlias

from pemviz.errors import InputError

MAX_DEPTH = 100
"""Most levels of nesting a formula may have."""
MAX_NODES = 10_000
"""Most parts (operators, signals, numbers) a formula may have."""
MAX_BOUND = 1_000_000_000
"""Largest interval bound in steps."""
Comparison: TypeAlias = Literal[">=", ">", "<=", "<"]


class FormulaError(InputError):
    """A formula is malformed, ill-typed, or does not fit the signals it is evaluated on.

    Attributes:
        line: Line of the mistake, counted from 1; ``None`` without a text.
        column: Column of the mistake, counted from 1; ``None`` without a text.
    """

    def __init__(self, message: str, *, line: int | None = None, column: int | None = None) -> None:
        where = "" if line is None else f"formula, line {line}, column {column}: "
        super().__init__(where + message)
        self.line = line
        self.column = column


def shorten(text: object, length: int = 40) -> str:
    """``text`` cut to ``length`` characters."""
    whole = str(text)
    return whole if len(whole) <= length else whole[: length - 3] + "..."


@dataclass(frozen=True)
class Node(ABC):
    """What formulas and numbers share: parts, and limits on how many."""

    strength: ClassVar[int]  # how tightly the text form binds, see the grammar
    _children: tuple[Node, ...] = field(init=False, repr=False, compare=False)
    _signals: frozenset[str] = field(init=False, repr=False, compare=False)
    _depth: int = field(init=False, repr=False, compare=False)
    _nodes: int = field(init=False, repr=False, compare=False)

    @abstractmethod
    def __str__(self) -> str:
        """The text form."""

    def children(self) -> tuple[Node, ...]:
        """The direct parts, left to right."""
        return self._children

    def __post_init__(self) -> None:
        values = [getattr(self, one.name) for one in fields(self) if one.init]
        flat = [part for value in values for part in (value if type(value) is tuple else [value])]
        parts = tuple(part for part in flat if isinstance(part, Node))
        depth = 1 + max((part._depth for part in parts), default=0)
        nodes = 1 + sum(part._nodes for part in parts)
        if depth > MAX_DEPTH:
            raise FormulaError(f"formula is nested too deeply; at most {MAX_DEPTH} levels")
        if nodes > MAX_NODES:
            raise FormulaError(f"formula is too long; at most {MAX_NODES} parts")
        # asked for with every batch of rollouts
        names = frozenset[str]().union(*(part._signals for part in parts))
        object.__setattr__(self, "_signals", names)
        object.__setattr__(self, "_children", parts)
        object.__setattr__(self, "_depth", depth)
        object.__setattr__(self, "_nodes", nodes)

    def walk(self) -> Iterator[Node]:
        """This node and everything below it, parents first, left to right."""
        pending: list[Node] = [self]
        while pending:
            node = pending.pop()
            yield node
            pending.extend(reversed(node.children()))

    def signals(self) -> frozenset[str]:
        """Names of all signals used."""
        return self._signals

    def _text(self, operand: Node, strength: int) -> str:
        """An operand's text, in parentheses if it binds less tightly than ``strength``."""
        return str(operand) if operand.strength >= strength else f"({operand})"


@dataclass(frozen=True)
class Expression(Node):
    """A number at every step of a rollout."""

    strength: ClassVar[int] = 4


@dataclass(frozen=True)
class Constant(Expression):
    """A finite number."""

    value: float

    def __str__(self) -> str:
        return repr(self.value)


@dataclass(frozen=True)
class Signal(Expression):
    """A signal, by name."""

    name: str

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_signals", frozenset({self.name}))

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class _Binary(Expression):
    left: Expression
    right: Expression

    symbol: ClassVar[str]

    def __str__(self) -> str:
        # The text form groups from the left, so an equally strong right side needs parentheses.
        left = self._text(self.left, self.strength)
        return f"{left} {self.symbol} {self._text(self.right, self.strength + 1)}"


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

    def __str__(self) -> str:
        # "-2.0" is a number of its own: the minus of a number stays outside parentheses.
        if isinstance(self.operand, Constant):
            return f"-({self.operand})"
        return f"-{self._text(self.operand, self.strength)}"


@dataclass(frozen=True)
class Absolute(Expression):
    """``abs(operand)``."""

    operand: Expression

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
class Formula(Node):
    """Something that holds or fails at every step of a rollout."""

    def __bool__(self) -> NoReturn:
        """Refuse Python's ``and`` and ``or``, which would pass over one of two formulas."""
        raise FormulaError(
            f"formula ({shorten(self)}) has no truth value in Python: combine formulas in their "
            "text, with and, or, not"
        )

    def horizon_steps(self) -> int:
        """How many steps past step t decide the formula at t.

        A rollout needs ``horizon_steps() + 1`` states for the formula to have a
        value at step 0.
        """
        return max((part.horizon_steps() for part in self.formulas()), default=0)

    def formulas(self) -> tuple[Formula, ...]:
        """Its direct parts that are formulas."""
        return tuple(part for part in self.children() if isinstance(part, Formula))


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


@dataclass(frozen=True)
class Not(Formula):
    """``not operand``."""

    operand: Formula

    strength: ClassVar[int] = 5

    def __str__(self) -> str:
        return f"not {self._text(self.operand, Truth.strength)}"


@dataclass(frozen=True)
class _Junction(Formula):
    parts: tuple[Formula, ...]

    word: ClassVar[str]

    def __str__(self) -> str:
        return f" {self.word} ".join(self._text(part, self.strength + 1) for part in self.parts)


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

    def __str__(self) -> str:
        return f"{self._text(self.premise, 2)} -> {self._text(self.conclusion, 2)}"


@dataclass(frozen=True)
class _Timed(Formula):
    first: int
    last: int

    word: ClassVar[str]

    def __post_init__(self) -> None:
        if self.first > self.last:
            raise FormulaError(
                f"interval [{self.first},{self.last}] of '{self.word}' is reversed; did you mean"
                f" [{self.last},{self.first}]?"
            )
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

    def __str__(self) -> str:
        return f"({self.left}) {self.head} ({self.right})"
