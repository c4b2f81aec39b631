"""Eight doubles at once: what the words say, and that compiled they say the same."""

import hashlib
import importlib
import math
import operator
from pathlib import Path

import numpy as np
import pytest

from pemviz import lanes

HARSH = (
    0.0, -0.0, 1.0, -1.0, 5e-324, -5e-324, 2.0**-1030, 1e-300, 1.5, -3e7,
    math.inf, -math.inf, 1.7976931348623157e308, -1.7976931348623157e308, 0.1, -0.1,
)  # fmt: skip


def arithmetic(values, others, edge, result):
    """Each word once, on the first eight of each, to ``result``; where the packing ends."""
    left, right = lanes.loaded(lanes.memory(values), 0), lanes.loaded(lanes.memory(others), 0)
    written = lanes.memory(result)
    lanes.store(left + right, written, 0)
    lanes.store(left - right, written, 8)
    lanes.store(left * right, written, 16)
    lanes.store(left / right, written, 24)
    lanes.store(lanes.smaller(left, right), written, 32)
    lanes.store(lanes.larger(left, right), written, 40)
    lanes.store(lanes.filled(lanes.least_of(left)), written, 48)
    lanes.store(lanes.filled(lanes.most_of(left)), written, 56)
    lanes.store(lanes.filled(lanes.sum_of(left)), written, 64)
    return lanes.pack(left, right, lanes.filled(edge), written, 72)


def halved(join, numbers):
    """One of many, half upon half."""
    half = len(numbers) // 2
    if not half:
        return numbers[0]
    return halved(join, [join(a, b) for a, b in zip(numbers[:half], numbers[half:], strict=True)])


def one_by_one(values, others, edge):
    """The same by plain doubles."""
    pairs = list(zip(values[:8], others[:8], strict=True))
    rows = [
        [a + b for a, b in pairs], [a - b for a, b in pairs], [a * b for a, b in pairs],
        [a / b for a, b in pairs], [min(a, b) for a, b in pairs], [max(a, b) for a, b in pairs],
        [halved(min, values[:8])] * 8, [halved(max, values[:8])] * 8,
        [halved(operator.add, values[:8])] * 8,
    ]  # fmt: skip
    return np.array([*np.ravel(rows), *(a for a, b in pairs if b <= edge)])


def cases():
    rng = np.random.default_rng(3)
    for _ in range(60):
        values, others = rng.choice(HARSH, (2, 11))
        for edge in (-math.inf, -1.0, 0.0, 5e-324, 1.0, math.inf):
            yield values, others, edge


def check(function):
    with np.errstate(all="ignore"):
        for values, others, edge in cases():
            result = np.full(80, 7.0)
            end = function(values, others, edge, result)
            expected = one_by_one(values, others, edge)
            assert end == expected.size
            given = result[:end]
            same = (given == expected) | (np.isnan(given) & np.isnan(expected))
            assert same.all(), (values, others, edge)
            signed = ~np.isnan(expected)
            np.testing.assert_array_equal(np.signbit(given[signed]), np.signbit(expected[signed]))


def test_eight_are_each_what_one_is():
    check(arithmetic)


def test_reading_and_writing_leave_the_rest_alone():
    values = np.arange(20.0)
    lanes.store(lanes.loaded(values, 9), values, 1)
    np.testing.assert_array_equal(values, [0.0, *range(9, 17), *range(9, 20)])
    lanes.store(lanes.filled(2.5), values, 12)
    np.testing.assert_array_equal(values[11:], [11.0, *[2.5] * 8])


def compiler():
    """numba's; once it has been taught the words they are there."""
    return importlib.import_module("numba").njit(error_model="numpy")


def turned(numbers, first, apart, width):
    result = np.full(8 * width + 3, -1.0)
    lanes.turn(lanes.memory(numbers), first, apart, lanes.memory(result), 3, width)
    return result


def check_turning(function):
    numbers = np.random.default_rng(0).random(200)
    for first, apart, width in ((0, 8, 8), (5, 21, 8), (7, 9, 13)):
        result = np.full((8, width), -1.0)
        square = [numbers[first + i * apart : first + i * apart + 8] for i in range(8)]
        result[:, :8] = np.transpose(square)
        expected = [-1.0, -1.0, -1.0, *result.ravel()]
        np.testing.assert_array_equal(function(numbers, first, apart, width), expected)


def test_rows_become_columns():
    check_turning(turned)


@pytest.fixture
def wide_lanes():
    pytest.importorskip("numba")
    return importlib.import_module("pemviz.wide_lanes")


@pytest.mark.slow  # a second, to compile
def test_compiled_they_are_as_well(wide_lanes):
    function = compiler()(arithmetic)
    check(function)
    compiled = "".join(function.inspect_llvm().values())
    assert ("vector.compress" in compiled) == wide_lanes.PACKS


@pytest.mark.slow  # as above
def test_compiled_rows_become_columns(wide_lanes):
    check_turning(compiler()(turned))


@pytest.mark.slow  # as above
@pytest.mark.parametrize("by_itself", [True, False])
def test_packing_has_two_ways(wide_lanes, by_itself):
    if by_itself and not wide_lanes.KNOWS_PACKING:
        pytest.skip("this version of LLVM packs one by one")
    pack = wide_lanes.packing(by_itself)

    def by_hand(values, others, edge, result):
        left, right = lanes.loaded(lanes.memory(values), 0), lanes.loaded(lanes.memory(others), 0)
        return pack(left, right, lanes.filled(edge), lanes.memory(result), 1)

    function = compiler()(by_hand)
    for values, others, edge in cases():
        results = np.full((2, 9), 7.0)
        end = function(values, others, edge, results[0])
        eight = (lanes.loaded(values, 0), lanes.loaded(others, 0), lanes.filled(edge))
        assert end == lanes.pack(*eight, results[1], 1)
        np.testing.assert_array_equal(results[0, :end], results[1, :end])
    assert ("vector.compress" in "".join(function.inspect_llvm().values())) == by_itself


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        ("stl/loops.py", ("lanes.py", "wide_lanes.py", "stl/tasks.py")),
        ("pem/models/network_loops.py", ("lanes.py", "wide_lanes.py")),
    ],
)
def test_what_is_compiled_is_kept_until_the_words_change(loop, words):
    """numba looks at the file of a loop alone when it asks whether what it keeps is still right."""
    folder = Path(lanes.__file__).parent
    used = b"".join((folder / name).read_bytes() for name in words)
    written = (folder / loop).read_text(encoding="utf-8")
    assert f'USED_AS_OF = "{hashlib.sha256(used).hexdigest()[:16]}"' in written
