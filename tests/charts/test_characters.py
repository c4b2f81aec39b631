import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.charts.characters import WIDTH, characters
from pemviz.charts.chart import IntervalChart, Row


def drawn(*rows):
    """Rows of a name, a value and its ends, as they are drawn."""
    made = tuple(
        Row(name, *ends or (None, None), () if value is None else (value,), "#000000")
        for name, value, *ends in rows
    )
    return characters(IntervalChart("", made, ""))


def test_figures_stand_where_their_logarithm_says():
    # three decades over 64 columns: 1e-16 at 0, 1e-15 at 21, 1e-14 at 42, 1e-13 at 63
    text = drawn(("run", 1e-15, 1e-16, 1e-14), ("gate", 1e-13))
    run, gate, ruler, labels = text.split("\n")
    offset = len("gate") + 2
    assert run[offset + 0] == "|"
    assert run[offset + 21] == "o"
    assert run[offset + 42] == "|"
    assert gate.index("o") == offset + 63
    assert [i - offset for i, c in enumerate(ruler) if c == "+"] == [0, 21, 42, 63]
    assert labels.split() == ["1e-16", "1e-15", "1e-14", "1e-13"]
    assert labels.index("1e-14") - offset == 42


def test_an_interval_down_to_zero_has_an_arrow():
    first = drawn(("mc", 0.0, 0.0, 3e-4)).split("\n")[0]
    assert first.startswith("mc  <-")
    assert "o" not in first


def test_rows_without_a_figure_say_so():
    text = drawn(("a", 1e-3), ("b", 0.0))
    assert "no violation was seen" in text.split("\n")[1]


def test_nothing_to_draw_is_no_plot():
    assert drawn(("a", 0.0), ("b", None)) == ""


figures = st.one_of(
    st.none(), st.just(0.0), st.floats(5e-324, 1.0), st.sampled_from([1.0, 1e-15, 0.1, math.inf])
)


@given(st.lists(st.tuples(figures, figures, figures), max_size=4))
def test_any_figures_fit_the_width(rows):
    text = drawn(*(("r", *row) for row in rows))
    for line in text.split("\n"):
        assert len(line) <= 3 + WIDTH + 8


@pytest.mark.parametrize("value", [1.0, 1e-15, 0.3])
def test_a_single_figure_has_an_axis_around_it(value):
    text = drawn(("r", value))
    assert text.split("\n")[1].count("+") >= 2
