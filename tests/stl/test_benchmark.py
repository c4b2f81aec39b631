"""The benchmark compares like with like."""

import numpy as np
import pytest

from benchmarks import stl as bench
from pemviz.stl import Classical, parse, robustness


@pytest.mark.parametrize("text", bench.BY_HAND)
def test_what_is_written_by_hand_is_the_formula(text):
    batch = bench.random_batch(rollouts=300, states=100)
    ours = robustness(parse(text), batch, Classical())
    np.testing.assert_array_equal(bench.BY_HAND[text](batch), ours)


def test_the_random_batch_fits_its_metrics():
    batch = bench.random_batch(rollouts=50, states=1000)
    for metric in bench.METRICS.values():
        for text in bench.BY_HAND:
            assert np.isfinite(robustness(parse(text), batch, metric)).all()
