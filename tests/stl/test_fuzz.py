"""Whatever is typed, the parser answers with a formula or with its own error."""

import random

import pytest

from pemviz.stl import FormulaError, parse

CORPUS = (
    "always[0,99] (gap >= 2.0)",
    "always[0,60] (not (d < 5) or eventually[0,20] (v < 1))",
    "(a > 0) until[0,50] (b > 0)",
    "G[0:9] (F[1:2] !(abs(x - y) <= 1e-3) && true) || min(a, b, 3) > max(-c / 2, .5)",
    "x > 1 -> (y + 2) * z < 4 -> false",
)
PIECES = (
    *"()[],:+-*/<>!&|=.0123456789 \t\n",
    *("always", "eventually", "until", "G", "F", "U", "not", "and", "or", "true", "false"),
    *("abs", "min", "max", "->", ">=", "<=", "&&", "||", "gap", "x", "1e999", "1e-400", "-1"),
    *("99999999999999999999", "\0", "\ud800", "é", "٣", "²", "\u2028", "🚗", "None", "__", "^"),
)


def random_text(rng):
    if rng.random() < 0.1:
        return "".join(chr(rng.randrange(0x110000)) for _ in range(rng.randrange(20)))
    return rng.choice(("", " ")).join(rng.choices(PIECES, k=rng.randrange(25)))


def mutated(rng):
    text = rng.choice(CORPUS)
    for _ in range(rng.randrange(1, 5)):
        start = rng.randrange(len(text) + 1)
        stop = min(len(text), start + rng.randrange(6))
        kind = rng.randrange(4)
        if kind == 0:
            text = text[:start] + text[stop:]
        elif kind == 1:
            text = text[:start] + rng.choice(PIECES) + text[start:]
        elif kind == 2:
            text = text[:start] + rng.choice(PIECES) + text[stop:]
        else:
            text = text[:stop] + text[start:]
    return text


def assert_only_own_errors(count, seed):
    rng = random.Random(seed)  # noqa: S311
    parsed = complete = 0
    for _ in range(count):
        text = rng.choice((random_text, mutated))(rng)
        try:
            formula = parse(text, signals=("gap", "x", "y", "d", "v", "a", "b", "c", "z"))
        except FormulaError as error:
            complete += "\n" not in str(error) and None not in (error.line, error.column)
        else:
            parsed, complete = parsed + 1, complete + 1
            assert parse(str(formula)) == formula, repr(text)
    assert complete == count
    assert parsed > count // 50  # the mutations do reach past the first error


def test_fuzz():
    assert_only_own_errors(5_000, seed=1)


@pytest.mark.slow
def test_fuzz_at_length():
    assert_only_own_errors(200_000, seed=2)


@pytest.mark.parametrize("piece", ["(", "not ", "-", "always[0,1] ", "abs(", "x>1 -> ", "min(x,"])
@pytest.mark.parametrize("count", [10, 1000, 5000])
def test_deep_nesting_is_an_error_not_a_crash(piece, count):
    closing = ")" * count if piece.endswith(("(", ",")) else ""
    for text in (piece * count, piece * count + "x" + closing, piece * count + "x > 1" + closing):
        try:
            length = len(str(parse(str(parse(text)))))
        except FormulaError as error:
            length = len(str(error))
        assert length < 3000
