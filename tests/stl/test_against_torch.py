"""Robustness against the same operators written in torch; and our own operators on tensors."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pemviz.stl import Agm, Classical, SmoothCumulative, parse, robustness_trace

from .strategies import BOUNDS, formula_and_rollouts

torch = pytest.importorskip("torch")
from . import torch_semantics  # noqa: E402

METRICS = (
    Classical(),
    Agm(BOUNDS),
    SmoothCumulative(),
    SmoothCumulative(part="negative"),
    SmoothCumulative(beta=2.0),
)
MANY = settings(
    max_examples=300, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)


@MANY
@given(formula_and_rollouts(3), st.sampled_from(METRICS))
def test_values_agree_with_torch(case, metric):
    formula, batch = case
    tensors = {name: torch.from_numpy(values) for name, values in batch.items()}
    theirs = torch_semantics.robustness_trace(formula, tensors, metric)
    assert theirs.dtype == torch.float64
    expected = robustness_trace(formula, batch, metric)
    np.testing.assert_allclose(theirs.numpy(), expected, rtol=1e-9, atol=1e-9)


def test_clipping_agrees_with_torch():
    gap = np.array([[30.0, 5.0], [-30.0, 5.0]])
    metric, formula = Agm({"gap": (-10, 10)}, clip=True), parse("always[0,1] (gap >= 2)")
    ours = robustness_trace(formula, {"gap": gap}, metric)
    theirs = torch_semantics.robustness_trace(formula, {"gap": torch.from_numpy(gap)}, metric)
    np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-12)
