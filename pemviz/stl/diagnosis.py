"""Syntax errors in words: what stands there, what was expected, what was perhaps meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection
from typing import TYPE_CHECKING

from pemviz.stl.errors import shorten

if TYPE_CHECKING:
    from lark import Token

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


def explain_character(text: str, position: int) -> str:
    """Why no word of the language starts at ``text[position]``."""
    for symbol, hint in SYMBOL_HINTS.items():
        if text.startswith(symbol, position):
            return f"{symbol!r} is not part of the language: {hint}"
    return f"character {text[position]!r} is not part of the language"


def explain_token(before: str, token: Token, expected: Collection[str]) -> str:
    """Why ``token`` cannot stand behind the text ``before``.

    Args:
        before: all text in front of the token.
        token: the token; of type ``$END`` at the end of the text.
        expected: names of the terminals that could stand there.
    """
    at_end = token.type == "$END"
    met = "the formula ends here" if at_end else f"unexpected '{shorten(token)}'"
    last = _LAST_WORD.search(before)
    hint = _hint(last.group(1) if last else "", token)
    return f"{met}; {hint or 'expected ' + describe(expected)}"


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


def describe(expected: Collection[str]) -> str:
    """The expected terminals in words."""
    terminals = set(expected)
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
