"""The numbers behind a chart, as CSV: every mark, every digit, units in the heads."""

import csv
import io
import math
from typing import get_args

import numpy as np
import pytest

from pemviz.charts.chart import (
    Axis,
    Band,
    Bars,
    Box,
    Cells,
    IntervalChart,
    Level,
    Line,
    Mark,
    PlaneChart,
    Points,
    Row,
    Rule,
    Strokes,
    Veil,
    Whiskers,
)
from pemviz.charts.drawing import drawing
from pemviz.charts.svg import svg
from pemviz.charts.table import chart_csv

X, Y = Axis(0.0, 4.0, "time [s]"), Axis(-1.0, 3.0, "gap [m]")
TIMES = np.array([0.0, 1.0, 2.0])
SHADES = Cells(
    np.array([[-1.0, math.nan], [-2.0, -3.0]]), (Level(-2.0, "much", "#000000"),), "#eeeeee",
    "P(violation)", "log10 of P(violation)",
)  # fmt: skip
MARKS = {
    Line: (
        Line(TIMES, np.array([1.0 / 3.0, math.nan, 1e-300]), "#111111", "a"),
        [("a", "0.0", repr(1.0 / 3.0)), ("a", "1.0", ""), ("a", "2.0", "1e-300")],
    ),
    Points: (
        Points(TIMES[:2], TIMES[1:], "#111111", name="b", crosses=True, joined=True),
        [("b", "0.0", "1.0"), ("b", "1.0", "2.0")],
    ),
    Strokes: (Strokes(TIMES[:1], TIMES[1:2], "#111111", "c", above=0.1), [("c", "0.0", "1.0")]),
    Whiskers: (
        Whiskers(TIMES[:1], TIMES[1:2], TIMES[2:], "#111111", (False,), "d"),
        [("d", "0.0", "", "1.0", "2.0", "no")],
    ),
    Band: (Band(0.5, 1.5, "#111111", "e"), [("e", "", "", "0.5", "1.5", "yes")]),
    Bars: (
        Bars(np.array([0.0, 1.0, 3.0]), np.array([2.0, math.nan]), "#111111", "f"),
        [("f", "0.5", "2.0"), ("f", "2.0", "")],
    ),
    Cells: (
        SHADES,
        [("P(violation)", "1.0", "0.0", "", "", "-1.0"), ("P(violation)", "3.0", "0.0"),
         ("P(violation)", "1.0", "2.0", "", "", "-2.0"),
         ("P(violation)", "3.0", "2.0", "", "", "-3.0")],
    ),
    Box: (
        Box(0.0, 1.0, 2.0, 3.0, "#111111", "g"),
        [("g: from", "0.0", "2.0"), ("g: to", "1.0", "3.0")],
    ),
    Rule: (Rule(2.0, "h", "#111111", upright=False), [("h", "", "2.0")]),
    Veil: (Veil(2.0, "contact"), [("contact", "2.0", "")]),
}  # fmt: skip


def rows(chart):
    heads, *found = csv.reader(io.StringIO(chart_csv(chart)))
    return heads, found


def test_every_kind_of_mark_is_held_to_its_numbers():
    assert set(MARKS) == set(get_args(Mark))


@pytest.mark.parametrize("kind", MARKS)
def test_a_mark_is_told_with_every_digit_and_is_drawn_by_every_engine(kind):
    mark, expected = MARKS[kind]
    chart = PlaneChart("title", X, Y, (mark,))
    heads, found = rows(chart)
    assert heads[0] == "series"
    assert {"time [s]", "gap [m]"} >= {head for head in heads[1:3] if ":" not in head}
    filled = [[value for value in row if value] for row in expected]
    assert [[value for value in row if value] for row in found] == filled
    assert svg(chart).startswith("<svg")
    assert drawing(chart).axes


def test_columns_are_those_that_something_stands_in():
    plain = PlaneChart("title", X, Y, (Line(TIMES, TIMES, "#111111", "a"),))
    assert rows(plain)[0] == ["series", "time [s]", "gap [m]"]
    tipped = Points(TIMES, TIMES, "#111111", "a", tips=("one", 'of "two"', "x, y"))
    heads, found = rows(PlaneChart("title", X, Y, (tipped,)))
    assert heads[-1] == "note"
    assert [row[-1] for row in found] == ["one", 'of "two"', "x, y"]
    heads, (row,) = rows(PlaneChart("title", X, Y, (MARKS[Whiskers][0],)))
    assert heads == [
        "series", "time [s]", "gap [m]: low", "gap [m]: high", "interval at its level",
    ]  # fmt: skip
    assert row == ["d", "0.0", "1.0", "2.0", "no"]


def test_kinds_on_an_axis_are_told_by_their_names():
    slots = Axis(2.5, 0.5, "", ticks=(1.0, 2.0), words=("lead", "cutter"))
    strokes = Strokes(TIMES[:2], np.array([2.0, 1.0]), "#111111", "error")
    heads, found = rows(PlaneChart("title", X, slots, (strokes,)))
    assert heads == ["series", "time [s]", "about"]
    assert found == [["error", "0.0", "cutter"], ["error", "1.0", "lead"]]


def test_intervals_are_told_with_all_their_values():
    chart = IntervalChart(
        "title",
        (
            Row("refits", 1e-9, 1e-7, (1e-8, 2e-8), "#111111", holds=False, figures="about"),
            Row("not known", None, None, (), "#111111"),
        ),
        "probability",
        rules=(Rule(3e-8, "the answer", "#111111"),),
    )
    heads, found = rows(chart)
    assert heads == [
        "series", "probability", "probability: low", "probability: high", "interval at its level",
        "note",
    ]  # fmt: skip
    assert found == [
        ["refits", "1e-08", "1e-09", "1e-07", "no", "about"],
        ["refits", "2e-08", "1e-09", "1e-07", "no", "about"],
        ["not known", "", "", "", "", ""],
        ["the answer", "3e-08", "", "", "", ""],
    ]


def test_a_strangers_name_is_no_formula_of_a_spreadsheet():
    line = Line(TIMES[:1], -TIMES[1:2], "#111111", "=HYPERLINK(1)")
    _, (row,) = rows(PlaneChart("title", X, Y, (line,)))
    assert row == ["'=HYPERLINK(1)", "0.0", "-1.0"]
