"""What the parser does at every rule: check types, build the node, remember the place."""

# ruff: noqa: D102 (the methods are the rules of grammar.lark, which says what they get)

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from pemviz.stl import expressions as ex
from pemviz.stl.errors import FormulaError, shorten
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import And, Formula, Implies, Not, Or, Truth
from pemviz.stl.temporal import MAX_BOUND, Always, Eventually, Until

if TYPE_CHECKING:
    from lark import Token

NodeT = TypeVar("NodeT", bound=ex.Node)


class Mistake(Exception):  # noqa: N818 (never leaves the parser)
    """An error at a position of the text."""

    def __init__(self, position: int, message: str) -> None:
        super().__init__(message)
        self.position = position


class Piece(NamedTuple):
    """A node and where in the text it starts."""

    node: ex.Node
    position: int
    is_literal: bool = False


class Steps(NamedTuple):
    """An interval in steps and where in the text it starts."""

    first: int
    last: int
    position: int


def _build(position: int, make: Callable[..., NodeT], *args: Any) -> Piece:
    try:
        return Piece(make(*args), position)
    except FormulaError as error:
        raise Mistake(position, str(error)) from None


def _formula(piece: Piece, user: str) -> Formula:
    if isinstance(piece.node, Formula):
        return piece.node
    name = shorten(piece.node)
    raise Mistake(
        piece.position,
        f"{name!r} is a number, but {user} needs a formula; compare it, as in {name} >= 2.0",
    )


def _number(piece: Piece, user: str) -> ex.Expression:
    if isinstance(piece.node, ex.Expression):
        return piece.node
    raise Mistake(
        piece.position,
        f"'{shorten(piece.node)}' is a formula (true or false), but {user} needs a number",
    )


ARITHMETIC: dict[str, Callable[[ex.Expression, ex.Expression], ex.Expression]] = {
    "+": ex.Sum,
    "-": ex.Difference,
    "*": ex.Product,
    "/": ex.Quotient,
}


class TreeBuilder:
    """One method per rule of the grammar; children are pieces and named tokens."""

    def start(self, children: Sequence[Piece]) -> Formula:
        return _formula(children[0], "the specification")

    def group(self, children: Sequence[Piece]) -> Piece:
        return children[0]._replace(is_literal=False)

    def truth(self, children: Sequence[Token]) -> Piece:
        return Piece(Truth(), _position(children[0]))

    def falsity(self, children: Sequence[Token]) -> Piece:
        return Piece(Not(Truth()), _position(children[0]))

    def name(self, children: Sequence[Token]) -> Piece:
        return Piece(ex.Signal(str(children[0])), _position(children[0]))

    def number(self, children: Sequence[Token]) -> Piece:
        value = float(children[0])
        if not math.isfinite(value):
            raise Mistake(_position(children[0]), "number is too large for double precision")
        return Piece(ex.Constant(value), _position(children[0]), is_literal=True)

    def negative(self, children: Sequence[Any]) -> Piece:
        minus, operand = children
        if operand.is_literal:
            return Piece(ex.Constant(-operand.node.value), _position(minus))
        return _build(_position(minus), ex.Negative, _number(operand, "'-'"))

    def product(self, children: Sequence[Any]) -> Piece:
        return _fold(children)

    def sum(self, children: Sequence[Any]) -> Piece:
        return _fold(children)

    def function(self, children: Sequence[Any]) -> Piece:
        word, *arguments = children
        operands = tuple(_number(argument, f"'{word}'") for argument in arguments)
        if word.type != "ABS":
            make = ex.Minimum if word.type == "MIN" else ex.Maximum
            return _build(_position(word), make, operands)
        if len(operands) != 1:
            raise Mistake(arguments[1].position, "'abs' takes one number")
        return _build(_position(word), ex.Absolute, operands[0])

    def comparison(self, children: Sequence[Any]) -> Piece:
        left, sign, right = children[:3]
        parts = _number(left, f"'{sign}'"), str(sign), _number(right, f"'{sign}'")
        if len(children) > 3:
            sign2, third = children[3:5]
            a, b, c = (shorten(piece.node, 20) for piece in (left, right, third))
            raise Mistake(
                _position(sign2),
                f"comparisons cannot be chained; write ({a} {sign} {b}) and ({b} {sign2} {c})",
            )
        return _build(left.position, Predicate, *parts)

    def negation(self, children: Sequence[Any]) -> Piece:
        word, operand = children
        return _build(_position(word), Not, _formula(operand, f"'{word}'"))

    def always(self, children: Sequence[Any]) -> Piece:
        return _window(Always, children)

    def eventually(self, children: Sequence[Any]) -> Piece:
        return _window(Eventually, children)

    def until(self, children: Sequence[Any]) -> Piece:
        left, word, steps, right = children[:4]
        if len(children) > 4:
            raise Mistake(
                _position(children[4]),
                "chained until needs parentheses, as in (a until[0,9] b) until[0,9] c",
            )
        parts = _formula(left, f"'{word}'"), _formula(right, f"'{word}'")
        return _build(steps.position, Until, steps.first, steps.last, *parts)._replace(
            position=left.position
        )

    def conjunction(self, children: Sequence[Any]) -> Piece:
        return _junction(And, children)

    def disjunction(self, children: Sequence[Any]) -> Piece:
        return _junction(Or, children)

    def implication(self, children: Sequence[Any]) -> Piece:
        premise, _, conclusion = children
        parts = _formula(premise, "'->'"), _formula(conclusion, "'->'")
        return _build(premise.position, Implies, *parts)

    def interval(self, children: Sequence[tuple[int, int]]) -> Steps:
        (first, position), (last, _) = children
        return Steps(first, last, position)

    def bound(self, children: Sequence[Token]) -> tuple[int, int]:
        position = _position(children[0])
        digits = str(children[-1])
        bound = shorten("".join(children), 20)
        if len(children) > 1:
            raise Mistake(position, f"interval bound {bound} is negative; steps count from 0")
        if not digits.isdigit():
            raise Mistake(position, f"interval bound {bound} must be a whole number of steps")
        if len(digits) > len(str(MAX_BOUND)):
            raise Mistake(position, f"interval bound {bound} is too large; at most {MAX_BOUND}")
        return int(digits), position


def _position(token: Token) -> int:
    return token.start_pos or 0


def _fold(children: Sequence[Any]) -> Piece:
    """``a op b op c`` from the left."""
    result: Piece = children[0]
    for sign, operand in zip(children[1::2], children[2::2], strict=True):
        parts = _number(result, f"'{sign}'"), _number(operand, f"'{sign}'")
        result = _build(_position(sign), ARITHMETIC[sign], *parts)._replace(
            position=children[0].position
        )
    return result


def _junction(make: type[And] | type[Or], children: Sequence[Any]) -> Piece:
    user = f"'{children[1]}'"
    parts = tuple(_formula(piece, user) for piece in children[::2])
    return _build(children[0].position, make, parts)


def _window(make: type[Always] | type[Eventually], children: Sequence[Any]) -> Piece:
    word, steps, operand = children
    formula = _formula(operand, f"'{word}'")
    piece = _build(steps.position, make, steps.first, steps.last, formula)
    return piece._replace(position=_position(word))
