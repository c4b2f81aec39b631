"""Damaged inputs give documented errors, or load to what is sound; and the kit sees what is not."""

import os
import random
import time
import warnings
from collections import Counter
from functools import partial

import numpy as np
import pytest

from pemviz.errors import InputError
from tests.fuzz.__main__ import TARGETS, main, shares
from tests.fuzz.harness import Counts, Target, carry_out, judge, valid_files
from tests.fuzz.mutate import as_json, damage_bytes, damage_tree

QUICK_CASES = 1_500
NIGHTLY_CASES = 120_000


@pytest.fixture(scope="module")
def valid():
    with valid_files() as files:
        yield files


def assert_nothing_found(name, *, cases, valid):
    counts = Counts(name)
    found = list(carry_out(TARGETS[name], range(cases), valid=valid, counts=counts))
    assert not found, f"{len(found)} findings, the first: {found[0]}"
    assert counts.rejected + counts.accepted == cases
    return counts


@pytest.mark.parametrize("name", TARGETS)
def test_damage_is_refused_or_sound(name, valid):
    assert_nothing_found(name, cases=shares(QUICK_CASES, list(TARGETS))[name], valid=valid)


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get("PEMVIZ_NIGHTLY") != "1", reason="PEMVIZ_NIGHTLY=1 runs it")
@pytest.mark.parametrize("name", TARGETS)
def test_damage_is_refused_or_sound_at_length(name, valid):
    cases = shares(NIGHTLY_CASES, list(TARGETS))[name]
    counts = assert_nothing_found(name, cases=cases, valid=valid)
    # damage so coarse that no mutant is valid would not reach far
    assert 0 < counts.accepted < counts.cases


def test_every_share_is_carried_out():
    assert sum(shares(100_000, list(TARGETS)).values()) >= 100_000
    assert min(shares(100, list(TARGETS)).values()) >= 1


def raise_input_error(message, case):
    raise InputError(message)


def hang(case):
    while True:
        sum(range(1000))


def take_memory(case):
    np.ones(10**9)


def warn(case):
    warnings.warn("something", RuntimeWarning, stacklevel=1)


def recurse(case):
    recurse(case)


def draw(drawn, case):
    drawn.append(case.rng.random())


@pytest.mark.parametrize(
    ("planted", "words"),
    [(take_memory, "MemoryError"), (warn, "RuntimeWarning"), (recurse, "RecursionError")],
)
def test_the_kit_sees(planted, words, valid):
    finding = judge(Target("planted", planted, 1), 7, valid=valid, counts=Counts("planted"))
    assert finding is not None
    assert (finding.target, finding.seed) == ("planted", 7)
    assert words in finding.what


def test_the_kit_sees_a_hang(valid, monkeypatch):
    monkeypatch.setattr("tests.fuzz.harness.CASE_S", 0.1)
    started_s = time.process_time()
    finding = judge(Target("planted", hang, 1), 0, valid=valid, counts=Counts("planted"))
    assert finding is not None
    assert "processor time" in finding.what
    assert time.process_time() - started_s < 5.0


def test_a_documented_error_is_no_finding(valid):
    target = Target("planted", partial(raise_input_error, "what, where, allowed"), 1)
    counts = Counts("planted")
    assert judge(target, 0, valid=valid, counts=counts) is None
    assert (counts.cases, counts.rejected, counts.accepted) == (1, 1, 0)


def test_a_case_is_named_by_target_and_seed(valid):
    drawn = []
    for name in ("a", "a", "b"):
        target = Target(name, partial(draw, drawn), 1)
        judge(target, 3, valid=valid, counts=Counts(name))
    assert drawn[0] == drawn[1] != drawn[2]


def test_the_runner_counts_and_gives_the_exit_code(capsys, monkeypatch):
    assert main(["--cases", "40", "--target", "formula"]) == 0
    assert "formula" in capsys.readouterr().out
    monkeypatch.setitem(TARGETS, "formula", Target("formula", recurse, 1))
    assert main(["--cases", "1", "--target", "formula", "--seed", "9"]) == 1
    assert "--cases 1 --target formula --seed 9" in capsys.readouterr().err


def test_mutators_leave_their_input_alone_and_vary():
    tree = {"a": [1, {"b": 2.0}], "c": "text"}
    content = b"0123456789" * 10
    seen = Counter()
    for seed in range(200):
        rng = random.Random(seed)  # noqa: S311
        seen[as_json(damage_tree(rng, tree))] += 1
        damage_bytes(rng, content, [b"other"])
    assert tree == {"a": [1, {"b": 2.0}], "c": "text"}
    assert len(seen) > 100
