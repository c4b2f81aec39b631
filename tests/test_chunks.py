import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.chunks import ROWS, distinct, map_distinct, map_rows
from pemviz.pem import load_pem
from pemviz.pem.models.protocol import SALIENT_COLUMNS


def zero_variance_sum(rows):
    return np.einsum("nd,d->n", rows, 1.0 / (1.0 + np.arange(rows.shape[1])))


@given(
    st.integers(0, 3000),
    st.sampled_from([1, 7, 1000, 2**40]),
    st.sampled_from([1, 2**32, -(2**20)]),
    st.integers(0, 2**32),
)
def test_distinct_keys_as_numpy_finds_them_by_sorting(count, values, step, seed):
    """Keys that differ in high or low bits alone, and more of them than places of one hash."""
    keys = np.random.default_rng(seed).integers(0, values, count) * np.int64(step)
    first, place = distinct(keys)
    found, expected = np.unique(keys, return_index=True)
    np.testing.assert_array_equal(np.sort(keys[first]), found)
    np.testing.assert_array_equal(first, np.sort(expected))
    np.testing.assert_array_equal(keys[first][place], keys)


@given(
    st.integers(1, 3 * ROWS),
    st.integers(0, 3),
    st.integers(0, 3),
    st.sampled_from([1, 3, 40, 10_000]),
    st.integers(0, 2**32),
)
def test_equal_rows_change_nothing(count, columns, varying, values, seed):
    generator = np.random.default_rng(seed)
    rows = np.full((count, columns), 0.7)
    for column in range(min(varying, columns)):
        rows[:, column] = generator.normal(size=values)[generator.integers(0, values, count)]
    one_by_one = [float(zero_variance_sum(row[None, :])[0]) for row in rows]
    assert map_rows(zero_variance_sum, rows).tolist() == one_by_one
    assert map_distinct(zero_variance_sum, rows).tolist() == one_by_one


@pytest.mark.parametrize("spoiled", [np.nan, np.inf, -np.inf, -0.0])
def test_unusual_numbers_keep_their_places(spoiled):
    rows = np.repeat([[0.0], [1.0], [spoiled]], ROWS, axis=0)
    np.testing.assert_array_equal(map_rows(lambda chunk: chunk[:, 0] + 1.0, rows), rows[:, 0] + 1.0)


def test_a_row_that_differs_where_no_sample_looks_is_seen():
    rows = np.zeros((40 * ROWS, 2))
    rows[:, 0] = np.arange(40 * ROWS) % 3
    rows[17, 1] = 5.0
    np.testing.assert_array_equal(map_rows(lambda chunk: chunk.sum(axis=1), rows), rows.sum(axis=1))


@pytest.mark.parametrize("name", ["ml-nn", "lr", "gb-raw", "ml-nn-ensemble"])
def test_models_answer_alike_in_any_company(name):
    """To the last bit: among equal rows, among different ones, and alone."""
    pem = load_pem(name)
    generator = np.random.default_rng(0)
    rows = np.zeros((2 * ROWS, len(SALIENT_COLUMNS)))
    rows[:, 4:7] = (1.5, 1.6, 4.0)
    rows[:, 8:] = (1.65, 0.0, -np.pi / 2)
    rows[:, 9] = generator.choice(generator.uniform(2.0, 40.0, 20), len(rows))
    together = pem.logit(rows)
    some = [0, 1, 100, 2 * ROWS - 1]
    assert [float(pem.logit(rows[i : i + 1])[0]) for i in some] == together[some].tolist()
    different = rows.copy()
    different[::2, 7] = generator.normal(size=ROWS)
    np.testing.assert_array_equal(pem.logit(different)[1::2], together[1::2])
