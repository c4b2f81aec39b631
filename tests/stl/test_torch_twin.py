"""The torch twin: the same values, and gradients that finite differences confirm."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pemviz.errors import InputError
from pemviz.stl import Agm, Classical, SmoothCumulative, parse, robustness, robustness_trace

from .strategies import BOUNDS, formula_and_rollouts, rollouts

torch = pytest.importorskip("torch")
from pemviz.stl import torch_twin  # noqa: E402

METRICS = (
    Classical(),
    Agm(BOUNDS),
    SmoothCumulative(),
    SmoothCumulative(part="negative"),
    SmoothCumulative(beta=2.0),
)


@settings(
    max_examples=300, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)
@given(formula_and_rollouts(3), st.sampled_from(METRICS))
def test_values_agree_in_double(case, metric):
    formula, batch = case
    tensors = {name: torch.from_numpy(values) for name, values in batch.items()}
    trace = torch_twin.robustness_trace(formula, tensors, metric)
    assert trace.dtype == torch.float64
    expected = robustness_trace(formula, batch, metric)
    np.testing.assert_allclose(trace.numpy(), expected, rtol=1e-9, atol=1e-9)
    start = torch_twin.robustness(formula, tensors, metric)
    np.testing.assert_allclose(start.numpy(), expected[:, 0], rtol=1e-9, atol=1e-9)


FORMULAS = (
    "always[0,9] (gap >= 2)",
    "eventually[0,9] (gap - 2 * ego_speed >= -30)",
    "always[0,3] (not (gap < 5) or eventually[0,6] (ego_speed < 10))",
    "always[0,2] ((gap > -20) until[1,5] (ego_speed > 7))",
    "min(gap, x_1) > abs(ego_speed - 3) -> always[2,3] (x_1 * gap > 1)",
    "true until[0,4] (x_1 > 1 and not (gap > 3 or true))",
    "always[0,2] (gap > 3 or true) and gap > x_1",
)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("text", FORMULAS)
def test_gradients_agree_with_finite_differences(text, metric):
    formula = parse(text)
    batch = rollouts(3, 10, 2, 0.4)
    rng = np.random.default_rng(8)  # off the grid, where the metrics have kinks
    batch = {
        name: np.clip(v + rng.uniform(0.01, 0.1, v.shape), *BOUNDS[name]) * 0.98
        for name, v in batch.items()
    }
    tensors = {name: torch.from_numpy(v).requires_grad_() for name, v in batch.items()}
    torch_twin.robustness(formula, tensors, metric).sum().backward()
    step = 1e-6
    for name in sorted(formula.signals()):
        gradient = tensors[name].grad.numpy()
        assert np.isfinite(gradient).all()
        for i, t in np.ndindex(batch[name].shape):
            shifted = []
            for sign in (1, -1):
                moved = {key: values.copy() for key, values in batch.items()}
                moved[name][i, t] += sign * step
                shifted.append(robustness(formula, moved, metric)[i])
            constant = shifted[0] == shifted[1]  # perhaps infinite
            expected = 0.0 if constant else (shifted[0] - shifted[1]) / (2 * step)
            assert gradient[i, t] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_gradient_ascent_repairs_a_violation():
    gap = torch.full((1, 20), 1.0, dtype=torch.float64, requires_grad=True)
    formula = parse("always[0,19] (gap >= 2)")
    optimizer = torch.optim.Adam([gap], lr=0.1)
    for _ in range(100):
        optimizer.zero_grad()
        (-torch_twin.robustness(formula, {"gap": gap}, SmoothCumulative(beta=2.0))).sum().backward()
        optimizer.step()
    assert robustness(formula, {"gap": gap.detach().numpy()}, Classical())[0] > 0


def test_single_precision_stays_single():
    gap = torch.ones(2, 5)
    value = torch_twin.robustness(parse("min(gap, 2.1, 2.2) > 0.5"), {"gap": gap}, Classical())
    assert value.dtype == torch.float32
    np.testing.assert_allclose(value.numpy(), 0.5)


def test_mistakes_are_named():
    formula = parse("always[0,3] (gap >= 2)")
    gap = torch.ones(2, 5, dtype=torch.float64)
    bad = gap.clone()
    bad[1, 4] = torch.nan
    for signals, message in (
        ({"gap": bad}, "signal 'gap' is nan at rollout 1, step 4"),
        ({"gap": gap[:, :3]}, "needs 4 states; the rollouts have 3"),
        ({"gap": gap[0]}, "real, .N, T. and alike"),
        ({"gap": gap.int()}, "real, .N, T. and alike"),
        ({"gpa": gap}, "unknown signal 'gap'; did you mean 'gpa'"),
    ):
        with pytest.raises(InputError, match=message):
            torch_twin.robustness(formula, signals, Classical())
    with pytest.raises(InputError, match="declared bounds"):
        torch_twin.robustness(formula, {"gap": gap}, Agm({"gap": (2, 3)}))
    with pytest.raises(InputError, match="clipping to the bounds would change whether"):
        torch_twin.robustness(formula, {"gap": gap}, Agm({"gap": (2.5, 3)}, clip=True))
    with pytest.raises(InputError, match="is inf at rollout 0, step 0"):
        torch_twin.robustness(parse("1 / (gap - 1) > 0"), {"gap": gap}, Classical())


def test_clipping_agrees():
    gap = np.array([[30.0, 5.0], [-30.0, 5.0]])
    metric, formula = Agm({"gap": (-10, 10)}, clip=True), parse("always[0,1] (gap >= 2)")
    ours = robustness(formula, {"gap": gap}, metric)
    twin = torch_twin.robustness(formula, {"gap": torch.from_numpy(gap)}, metric)
    np.testing.assert_allclose(twin.numpy(), ours, rtol=1e-12)
