"""Text to syntax tree.

Precedence, tightest first: ``not``, ``always``, ``eventually``; ``until``; ``and``;
``or``; ``->`` (which groups from the right). ``a and b and c`` is one conjunction of
three parts.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from pemviz.stl.checks import check_horizon, unknown_signal
from pemviz.stl.diagnosis import explain_character, explain_token
from pemviz.stl.errors import FormulaError, error_at
from pemviz.stl.formulas import Formula
from pemviz.stl.treebuilding import Mistake, TreeBuilder

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


def parse(
    text: str, *, signals: Collection[str] | None = None, states: int | None = None
) -> Formula:
    """The formula that ``text`` says.

    Args:
        text: for example ``always[0,99] (gap >= 2.0)``; intervals are in steps.
        signals: the names that exist; any name is taken if None.
        states: number of states T of the rollouts, which the formula's horizon must
            not exceed; not checked if None.

    Raises:
        FormulaError: the text is no formula, is ill-typed, nested more than
            ``MAX_DEPTH`` levels, longer than ``MAX_TEXT``, names an unknown signal or
            looks past the rollouts' end. Line, column and a caret point at the mistake.
    """
    import lark  # noqa: PLC0415 (only needed where text is parsed)

    if not isinstance(text, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise FormulaError(f"formula must be text, not {type(text).__name__}")
    if len(text) > MAX_TEXT:
        raise FormulaError(f"formula has {len(text)} characters; at most {MAX_TEXT}")
    try:
        formula: Formula = _parser().parse(text)  # pyright: ignore[reportAssignmentType]
    except Mistake as mistake:
        raise error_at(text, mistake.position, str(mistake)) from None
    except lark.UnexpectedCharacters as error:
        position = error.pos_in_stream
        raise error_at(text, position, explain_character(text, position)) from None
    except lark.UnexpectedToken as error:
        position = len(text.rstrip()) if error.token.type == "$END" else error.token.start_pos
        message = explain_token(text[:position], error.token, error.accepts or error.expected)
        raise error_at(text, position or 0, message) from None
    if signals is not None:
        _check_names(text, signals)
    if states is not None:
        check_horizon(formula, states)
    return formula


@lru_cache(maxsize=1)
def _parser() -> Lark:
    import lark  # noqa: PLC0415

    grammar = files("pemviz.stl").joinpath("grammar.lark").read_text(encoding="utf-8")
    return lark.Lark(
        grammar,
        parser="lalr",
        lexer="basic",
        transformer=TreeBuilder(),
        lexer_callbacks={"NAME": _sort_word},
        maybe_placeholders=False,
    )


def _sort_word(token: Token) -> Token:
    token.type = WORDS.get(token, token.type)
    return token


def _check_names(text: str, signals: Collection[str]) -> None:
    for token in _parser().lex(text):
        if token.type == "NAME" and str(token) not in signals:
            raise error_at(text, token.start_pos or 0, unknown_signal(str(token), signals))
