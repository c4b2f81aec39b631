"""The support check: the counts that KITTI really has, exact bounds, and words that fire."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from pemviz.binomial import exact_interval, exact_upper_bound
from pemviz.pem import (
    PemError,
    SalientTable,
    data_bound_pem,
    load_pem,
    load_table,
    support_check,
    support_of,
)
from pemviz.pem.data.support import (
    SHAPE,
    band_in_words,
    cell_of,
    closing_warnings,
    summarise_support,
    support_from_json,
)
from pemviz.pem.models.cards import fitted_memory
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS
from tests.pem.helpers import braking_rows, random_rows

DEFAULT_GAPS = np.linspace(-5.0, 15.0, 200)


@pytest.fixture(scope="module")
def report():
    pem = load_pem("ml-nn")
    return support_check(braking_rows(DEFAULT_GAPS), support=support_of(pem), pem=pem)


def by_edges(report):
    return {(band.low_m, band.high_m): band for band in report.bands}


def test_the_check_counts_what_kitti_has_ahead_of_the_default_scenario(report):
    bands = by_edges(report)
    for edges in ((0.0, 3.0), (3.0, 5.0), (5.0, 7.0)):
        assert bands[edges].obstacles == 0
    assert (bands[(7.0, 13.0)].obstacles, bands[(7.0, 13.0)].missed) == (132, 0)
    assert (bands[(13.0, 15.0)].obstacles, bands[(13.0, 15.0)].missed) == (27, 2)


def test_the_shipped_counts_are_those_of_the_table(kitti_folder, report):
    table = load_table(kitti_folder)
    rows = table.salient
    near = (rows[:, 0] == 0) & (rows[:, 2] == 0) & (np.abs(rows[:, 7]) < 1.5)
    near &= np.abs(rows[:, 10] + np.pi / 2) < 0.3
    for (low, high), band in by_edges(report).items():
        inside = near & (rows[:, 9] >= (-np.inf if low is None else low))
        inside &= rows[:, 9] < (np.inf if high is None else high)
        assert band.obstacles == inside.sum()
        assert band.missed == (inside & ~table.detected).sum()
    shipped = support_of(load_pem("ml-nn"))
    np.testing.assert_array_equal(shipped.obstacles, summarise_support(table).obstacles)


def test_the_default_scenario_is_warned_about_in_words(report):
    text = "\n".join(report.warnings)
    assert "extrapolation: no training obstacle (Car, occlusion none, straight ahead" in text
    assert "z from 5 to 7 m" in text
    assert "132 training obstacles" in text
    assert "none missed, so the data allow P(missed) up to 0.022" in text
    assert "2 of 27 training obstacles" in text
    # 28 of 192 missed between 15 and 20 m, where the network says 4 %.
    assert "misfit: 28 of 192 training obstacles" in text


def test_a_well_covered_scenario_is_warned_about_only_where_the_model_misfits():
    rng = np.random.default_rng(0)
    rows = braking_rows(rng.uniform(5.0, 7.0, 20_000))
    pem = load_pem("ml-nn")
    share = float(np.mean(1 / (1 + np.exp(pem.logit(rows)))))
    fitting = support_check(
        rows, support=summarise_support(table_of(rows, missed_share=share)), pem=pem
    )
    assert fitting.warnings == ()
    misfitting = support_check(
        rows, support=summarise_support(table_of(rows, missed_share=10 * share)), pem=pem
    )
    assert len(misfitting.warnings) == 1
    assert misfitting.warnings[0].startswith("misfit: ")


def table_of(rows, *, missed_share):
    detected = np.arange(len(rows)) >= missed_share * len(rows)
    return SalientTable(rows, detected, "made")


@settings(derandomize=True, deadline=None, max_examples=60)
@given(obstacles=st.integers(1, 400), share=st.floats(0, 1), confidence=st.floats(0.5, 0.999))
def test_exact_bounds_solve_the_binomial_equations(obstacles, share, confidence):
    missed = round(share * obstacles)
    bound = exact_upper_bound(missed, obstacles, confidence=confidence)
    if missed < obstacles:
        assert binom.cdf(missed, obstacles, bound) == pytest.approx(1 - confidence, rel=1e-6)
    else:
        assert bound == 1.0
    low, high = exact_interval(missed, obstacles, confidence=confidence)
    tail = (1 - confidence) / 2
    if missed:
        assert binom.sf(missed - 1, obstacles, low) == pytest.approx(tail, rel=1e-6)
    if missed < obstacles:
        assert binom.cdf(missed, obstacles, high) == pytest.approx(tail, rel=1e-6)


def test_the_rule_of_three():
    assert exact_upper_bound(0, 132) == pytest.approx(1 - 0.05 ** (1 / 132), rel=1e-9)
    assert exact_interval(0, 0) == (0.0, 1.0)
    assert exact_upper_bound(0, 0) == 1.0


def test_the_datas_own_bound_as_a_model():
    support = support_of(load_pem("ml-nn"))
    rows = braking_rows(DEFAULT_GAPS)
    pem = data_bound_pem(rows, support=support, confidence=0.95)
    miss = 1 / (1 + np.exp(pem.logit(braking_rows(np.array([4.0, 6.9, 10.0, 14.0, 16.0]) - 2.5))))
    # Bands with data on the way: 7-13, 13-15, 15-20; each takes a third of the 5 %.
    each = 1 - 0.05 / 3
    assert miss[:2] == pytest.approx(1.0, abs=1e-11)
    assert miss[2] == pytest.approx(exact_upper_bound(0, 132, confidence=each), rel=1e-9)
    assert miss[3] == pytest.approx(exact_upper_bound(2, 27, confidence=each), rel=1e-9)
    assert miss[4] < miss[3]


@settings(derandomize=True, deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 300))
def test_counts_survive_json_and_add_up(seed, count):
    rng = np.random.default_rng(seed)
    table = SalientTable(random_rows(rng, count), rng.random(count) < 0.7, "made")
    summary = summarise_support(table)
    again = support_from_json(summary.to_json(), where="here")
    np.testing.assert_array_equal(again.obstacles, summary.obstacles)
    np.testing.assert_array_equal(again.missed, summary.missed)
    assert summary.obstacles.sum() == count
    assert summary.missed.sum() == (~table.detected).sum()


def test_heading_wraps_around_and_bands_close_below():
    rows = braking_rows([4.5, 10.5, -3.0])
    rows[1, 10] = 3 * np.pi / 2
    *_, heading, band = cell_of(rows)
    assert heading.tolist() == [0, 0, 0]
    assert [band_in_words(index) for index in band] == [
        "z from 7 to 13 m",
        "z from 13 to 15 m",
        "z < 0 m",
    ]
    assert max(band) < SHAPE[-1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cells": [[0, 0, 0, 0, 99, 1, 0]]}, "malformed"),
        ({"cells": [[0, 0, 0, 0, 1, 1, 2]]}, "contradictory"),
        ({"distance_edges_m": [1.0]}, "other bands"),
        *(({"cells": cells}, "support counts") for cells in (
            [[0, 0, 0, 0, 0, 1.5, 0]], [[0, 0, 0, 0, 0, 10**30, 0]], [[0, 0, 0, 0, 0, True, "x"]],
            [[0, 0, 0, 0, 0, 10**15, 0]], "x", [[1]], [[-1, 0, 0, 0, 0, 1, 0]],
        )),
    ],
)  # fmt: skip
def test_malformed_counts_are_refused(change, words):
    values = {**support_of(load_pem("ml-nn")).to_json(), **change}
    with pytest.raises(PemError, match=words):
        support_from_json(values, where="file")


def test_a_memory_of_slow_tracks_says_so_where_obstacles_come_closer_fast():
    """At 20 m/s until the obstacle lies behind the camera, where its speed says nothing."""
    salient = np.zeros((3, 12, len(SALIENT_COLUMNS)))
    salient[..., COLUMN["z_m"]] = [*np.arange(9.0, 0.0, -2.0), *[-1.0] * 7]
    memory = fitted_memory(load_pem("rrc").card.memory, where="rrc")
    slow, fast = (replace(memory, closing_mps=speed) for speed in (19.9, 20.1))
    (told,) = closing_warnings(salient, dt_s=0.1, memory=slow)
    assert "95% of the pairs" in told
    assert "under 19.9 m/s, half of the steps of violations at over 20.0 m/s" in told
    for other in (fast, memory, None):  # as shipped it says nothing of speeds
        assert closing_warnings(salient, dt_s=0.1, memory=other) == ()
    assert closing_warnings(salient[:0], dt_s=0.1, memory=slow) == ()
