"""Compiled loops are loaded when they begin to pay, and comparisons choose the way."""

import pytest

from pemviz import compiling
from pemviz.compiling import LoadedInTime


@pytest.mark.parametrize(("loaded", "enough"), [(False, 1000), (True, 10)])
def test_loops_are_loaded_when_they_begin_to_pay(monkeypatch, loaded, enough):
    monkeypatch.setattr(compiling, "is_loaded", lambda: loaded)
    decision = LoadedInTime(lambda: "loops", first_by_numpy=1000, first_where_loaded=10)
    assert decision.loops_for(enough) is None
    assert decision.loops_for(1) == "loops"


def test_comparisons_choose_the_way_and_leave_no_trace():
    decision = LoadedInTime(lambda: "loops", first_by_numpy=1000, first_where_loaded=10, done=3.0)
    with decision.from_the_start(True):
        assert decision.loops_for(1) == "loops"
    with decision.from_the_start(False):
        assert decision.loops_for(10**18) is None
    assert decision.done == 3.0
