"""Text to formula, and mistakes in words: what stands there, what was expected or meant.

Precedence, tightest first: ``not``, ``always``, ``eventually``; ``until``; ``and``;
``or``; ``->`` (which groups from the right). ``a and b and c`` is one conjunction of
three parts.
"""

# ruff: noqa: D102 (the methods are the rules of grammar.lark, which says what they get)

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Collection, Sequence
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

from pemviz.stl import formulas as fo
from pemviz.stl.formulas import MAX_BOUND, Expression, Formula, FormulaError, shorten

if TYPE_CHECKING:
    from lark import Lark, Token

MAX_TEXT = 100_000
"""Most characters of a formula's text."""

WORDS = {
    "true": "TRUE",
    "false": "FALSE",
    "not": "NOT",
    "and": "AND",
    "or": "OR",
    "always": "ALWAYS",
    "G": "ALWAYS",
    "eventually": "EVENTUALLY",
    "F": "EVENTUALLY",
    "until": "UNTIL",
    "U": "UNTIL",
    "abs": "ABS",
    "min": "MIN",
    "max": "MAX",
}

# Longest first: "==" is looked for before "=".
SYMBOL_HINTS = {
    "==": "there is no equality; write abs(a - b) <= tolerance",
    "=>": "implication is written ->, at least is written >=",
    "=<": "at most is written <=",
    "=": "comparisons are >= > <= <",
    "&": "conjunction is written 'and' or '&&'",
    "|": "disjunction is written 'or' or '||'",
    "≥": "at least is written >=",
    "≤": "at most is written <=",
    "¬": "negation is written 'not' or '!'",
    "~": "negation is written 'not' or '!'",
    "∧": "conjunction is written 'and' or '&&'",
    "∨": "disjunction is written 'or' or '||'",
    "→": "implication is written ->",
    "^": "there is no power; write x * x",
    "□": "written always[a,b] or G[a,b]",
    "◇": "written eventually[a,b] or F[a,b]",
    ";": "one formula at a time; join several with 'and'",
    "{": "use ( and )",
}

KEYWORDS = ("always", "eventually", "until", "not", "and", "or", "true", "false")
FUNCTIONS = ("abs", "min", "max")
OTHER_WORDS = {
    "implies": "->",
    "globally": "always",
    "finally": "eventually",
    "historically": "always",
    "next": "always[1,1]",
    "X": "always[1,1]",
}

_OPERAND = {"NUMBER", "NAME"}
_OPERATOR = {"COMPARISON", "AND", "PLUS"}
_PLAIN = {"LPAR": "'('", "RPAR": "')'", "LSQB": "'['", "RSQB": "']'", "COMMA": "','"}

_LAST_WORD = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)[ \t\f\r\n]*\Z")


def parse(text: str, *, signals: Collection[str] | None = None) -> Formula:
    """The formula that ``text`` says.

    Args:
        text: for example ``always[0,99] (gap >= 2.0)``; intervals are in steps.
        signals: the names that exist; any name is taken if None.

    Raises:
        FormulaError: the text is no formula, is ill-typed, nested more than
            ``MAX_DEPTH`` levels, longer than ``MAX_TEXT`` or names an unknown signal; line and
            column point at the mistake.

    Example:
        >>> from pemviz import stl
        >>> formula = stl.parse("always[0,99] (gap >= 2.0)", signals=["gap", "ego_speed"])
        >>> formula.horizon_steps()
        99
        >>> try:
        ...     stl.parse("always[0,99] (gab >= 2.0)", signals=["gap", "ego_speed"])
        ... except stl.FormulaError as error:
        ...     print(error)
        formula, line 1, column 15: unknown signal 'gab'; did you mean 'gap'? known: ego_speed, gap
    """
    import lark  # noqa: PLC0415 (only needed where text is parsed)

    if not isinstance(text, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise FormulaError(f"formula must be text, not {type(text).__name__}")
    if len(text) > MAX_TEXT:
        raise FormulaError(f"formula has {len(text)} characters; at most {MAX_TEXT}")
    try:
        formula: Formula = _parser().parse(text)  # pyright: ignore[reportAssignmentType]
        if signals is not None:
            for token in _parser().lex(text):
                if token.type == "NAME" and str(token) not in signals:
                    raise Mistake(_position(token), unknown_signal(str(token), signals))
    except Mistake as mistake:
        position, message = mistake.position, str(mistake)
    except lark.UnexpectedCharacters as error:
        position = error.pos_in_stream
        message = _about_character(text, position)
    except lark.UnexpectedToken as error:
        position = len(text.rstrip()) if error.token.type == "$END" else _position(error.token)
        message = _about_token(text[:position], error.token, error.accepts or error.expected)
    else:
        return formula
    line_start = text.rfind("\n", 0, position) + 1
    line = text.count("\n", 0, position) + 1
    raise FormulaError(message, line=line, column=position - line_start + 1)


@lru_cache(maxsize=1)
def _parser() -> Lark:
    import lark  # noqa: PLC0415

    def sort_word(token: Token) -> Token:
        token.type = WORDS.get(token, token.type)
        return token

    return lark.Lark(
        files("pemviz.stl").joinpath("grammar.lark").read_text(encoding="utf-8"),
        parser="lalr",
        lexer="basic",
        transformer=TreeBuilder(),
        lexer_callbacks={"NAME": sort_word},
        maybe_placeholders=False,
    )


def unknown_signal(name: str, known: Collection[str]) -> str:
    """What to say of a signal that does not exist, with the nearest that does."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]!r}? " if near else ""
    names = ", ".join(sorted(known)) or "none"
    return f"unknown signal {shorten(repr(name))}; {hint}known: {names}"


def _about_character(text: str, position: int) -> str:
    """Why no word of the language starts at ``text[position]``."""
    for symbol, hint in SYMBOL_HINTS.items():
        if text.startswith(symbol, position):
            return f"{symbol!r} is not part of the language: {hint}"
    return f"character {text[position]!r} is not part of the language"


def _about_token(before: str, token: Token, expected: Collection[str]) -> str:
    """Why ``token`` cannot stand behind the text ``before``, where terminals were expected."""
    at_end = token.type == "$END"
    met = "the formula ends here" if at_end else f"unexpected '{shorten(token)}'"
    last = _LAST_WORD.search(before)
    hint = _hint(last.group(1) if last else "", token)
    return f"{met}; {hint or 'expected ' + _in_words(set(expected))}"


def _hint(last_word: str, token: Token) -> str:  # noqa: PLR0911 (one case per mistake)
    if last_word in ("always", "eventually", "until", "G", "F", "U"):
        return f"'{last_word}' needs an interval in steps, as in {last_word}[0,99]"
    if last_word in FUNCTIONS:
        return (
            f"'{last_word}' is a function, as in {last_word}(x - y{', z' * (last_word != 'abs')})"
        )
    if token.type == "NAME":
        return _meant(str(token), KEYWORDS)
    if not last_word or last_word in KEYWORDS:
        return ""
    if token.type == "LSQB":
        return _meant(last_word, KEYWORDS) or f"'{shorten(last_word)}' takes no interval or index"
    if token.type == "LPAR":
        near = _meant(last_word, FUNCTIONS + KEYWORDS)
        return near or f"no function '{shorten(last_word)}'; there are abs, min, max"
    return ""


def _meant(word: str, candidates: Collection[str]) -> str:
    if word in OTHER_WORDS:
        return f"'{word}' is written {OTHER_WORDS[word]}"
    near = difflib.get_close_matches(word.lower()[:40], candidates, n=1, cutoff=0.65)
    return f"did you mean '{near[0]}'?" if near else ""


def _in_words(terminals: set[str]) -> str:
    words: list[str] = []
    if terminals >= _OPERAND:
        words.append("a formula, a signal, a number" if "ALWAYS" in terminals else "a number")
    elif "NUMBER" in terminals:
        words.append("a whole number of steps")
    if terminals >= _OPERATOR:
        words.append("a comparison (>= > <= <), an operator (+ - * / and or -> until)")
    elif "AND" in terminals:
        words.append("'and', 'or', '->', 'until'")
    words += [text for terminal, text in _PLAIN.items() if terminal in terminals]
    if "$END" in terminals:
        words.append("the end")
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words) or "nothing"


class Mistake(Exception):  # noqa: N818 (never leaves the parser)
    """An error at a position of the text."""

    def __init__(self, position: int, message: str) -> None:
        super().__init__(message)
        self.position = position


class Piece(NamedTuple):
    """A node and where in the text it starts."""

    node: fo.Node
    position: int
    is_literal: bool = False


class Steps(NamedTuple):
    """An interval in steps and where in the text it starts."""

    first: int
    last: int
    position: int


def _build(position: int, make: Callable[..., fo.Node], *args: Any) -> Piece:
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


def _number(piece: Piece, user: str) -> Expression:
    if isinstance(piece.node, Expression):
        return piece.node
    raise Mistake(
        piece.position,
        f"'{shorten(piece.node)}' is a formula (true or false), but {user} needs a number",
    )


ARITHMETIC = {"+": fo.Sum, "-": fo.Difference, "*": fo.Product, "/": fo.Quotient}


class TreeBuilder:
    """One method per rule of the grammar; children are pieces and named tokens."""

    def start(self, children: Sequence[Piece]) -> Formula:
        return _formula(children[0], "the specification")

    def group(self, children: Sequence[Piece]) -> Piece:
        return children[0]._replace(is_literal=False)

    def truth(self, children: Sequence[Token]) -> Piece:
        return Piece(fo.Truth(), _position(children[0]))

    def falsity(self, children: Sequence[Token]) -> Piece:
        return Piece(fo.Not(fo.Truth()), _position(children[0]))

    def name(self, children: Sequence[Token]) -> Piece:
        return Piece(fo.Signal(str(children[0])), _position(children[0]))

    def number(self, children: Sequence[Token]) -> Piece:
        value = float(children[0])
        if not math.isfinite(value):
            raise Mistake(_position(children[0]), "number is too large for double precision")
        return Piece(fo.Constant(value), _position(children[0]), is_literal=True)

    def negative(self, children: Sequence[Any]) -> Piece:
        minus, operand = children
        if operand.is_literal:
            return Piece(fo.Constant(-operand.node.value), _position(minus))
        return _build(_position(minus), fo.Negative, _number(operand, "'-'"))

    def sum(self, children: Sequence[Any]) -> Piece:
        """``a op b op c`` from the left."""
        result: Piece = children[0]
        for sign, operand in zip(children[1::2], children[2::2], strict=True):
            parts = _number(result, f"'{sign}'"), _number(operand, f"'{sign}'")
            made = _build(_position(sign), ARITHMETIC[sign], *parts)
            result = made._replace(position=children[0].position)
        return result

    product = sum

    def function(self, children: Sequence[Any]) -> Piece:
        word, *arguments = children
        operands = tuple(_number(argument, f"'{word}'") for argument in arguments)
        if word.type != "ABS":
            make = fo.Minimum if word.type == "MIN" else fo.Maximum
            return _build(_position(word), make, operands)
        if len(operands) != 1:
            raise Mistake(arguments[1].position, "'abs' takes one number")
        return _build(_position(word), fo.Absolute, operands[0])

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
        return _build(left.position, fo.Predicate, *parts)

    def negation(self, children: Sequence[Any]) -> Piece:
        word, operand = children
        return _build(_position(word), fo.Not, _formula(operand, f"'{word}'"))

    def window(self, children: Sequence[Any]) -> Piece:
        word, steps, operand = children
        make = fo.Always if word.type == "ALWAYS" else fo.Eventually
        formula = _formula(operand, f"'{word}'")
        piece = _build(steps.position, make, steps.first, steps.last, formula)
        return piece._replace(position=_position(word))

    def until(self, children: Sequence[Any]) -> Piece:
        left, word, steps, right = children[:4]
        if len(children) > 4:
            raise Mistake(
                _position(children[4]),
                "chained until needs parentheses, as in (a until[0,9] b) until[0,9] c",
            )
        parts = _formula(left, f"'{word}'"), _formula(right, f"'{word}'")
        piece = _build(steps.position, fo.Until, steps.first, steps.last, *parts)
        return piece._replace(position=left.position)

    def conjunction(self, children: Sequence[Any]) -> Piece:
        word = children[1]
        parts = tuple(_formula(piece, f"'{word}'") for piece in children[::2])
        return _build(children[0].position, fo.And if word.type == "AND" else fo.Or, parts)

    disjunction = conjunction

    def implication(self, children: Sequence[Any]) -> Piece:
        premise, _, conclusion = children
        parts = _formula(premise, "'->'"), _formula(conclusion, "'->'")
        return _build(premise.position, fo.Implies, *parts)

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
        if len(digits) > len(str(MAX_BOUND)) or int(digits) > MAX_BOUND:
            raise Mistake(position, f"interval bound {bound} is too large; at most {MAX_BOUND}")
        return int(digits), position


def _position(token: Token) -> int:
    return token.start_pos or 0
