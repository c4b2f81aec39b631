"""Compiled loops are loaded when they begin to pay, and comparisons choose the way."""

import pickle
import subprocess
import sys

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


LOOP = """
from pemviz.compiling import is_translated, translated

@translated
def doubled(number):
    return 2 * number

assert is_translated(doubled)
print(doubled(21))
"""


@pytest.mark.slow  # numba is imported six times
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("left", ["of a module that has moved", "damaged"])
def test_what_cannot_be_read_is_compiled_anew(tmp_path, kind, left):
    numba = pytest.importorskip("numba")
    loop = tmp_path / "loop.py"
    loop.write_text(LOOP, encoding="utf-8")

    def said():
        done = subprocess.run(
            [sys.executable, str(loop)], capture_output=True, text=True, check=False
        )
        return done.stdout.strip() or done.stderr

    assert said() == "42"
    (kept,) = (tmp_path / "__pycache__").glob(f"*.{kind}")
    moved = b"cpemviz.moved_long_ago\nLanes\n."  # a pickle's reference to what is not there
    head = pickle.dumps(numba.__version__, protocol=-1) if kind == "nbi" else b""
    kept.write_bytes(head + (moved if left != "damaged" else b"\x00"))
    assert said() == "42"
    assert said() == "42"
    assert moved not in kept.read_bytes()
