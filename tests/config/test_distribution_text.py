"""Distributions as texts: against scipy's, whole and cut off, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pemviz.config.distribution_text import read_distribution
from pemviz.errors import ConfigError

Z = np.array([-8.0, -4.0, -1.3, -0.2, 0.0, 0.2, 1.3, 4.0, 8.0])
SAMPLE = (3.0, 1.0, 4.0, 1.0, 5.0, 9.0)


def of(text, z=Z):
    return read_distribution(text, name="gap").of(z)


def by_tail(distribution):
    tail = stats.norm.sf(np.abs(Z))
    return np.where(Z < 0.0, distribution.ppf(tail), distribution.isf(tail))


def cut_normal(mean, sd, low, high):
    """Quantiles of either tail by scipy's lower one, which keeps its digits; by symmetry."""
    a, b, tail = (low - mean) / sd, (high - mean) / sd, stats.norm.sf(np.abs(Z))
    values = np.where(Z < 0.0, stats.truncnorm(a, b).ppf(tail), -stats.truncnorm(-b, -a).ppf(tail))
    return mean + sd * values


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30", np.full(9, 30.0)),
        (" -1.5e1 ", np.full(9, -15.0)),
        ("normal(25, 3)", by_tail(stats.norm(25.0, 3.0))),
        ("lognormal(30, 0.3)", by_tail(stats.lognorm(0.3, scale=30.0))),
        ("uniform(2, 5)", by_tail(stats.uniform(2.0, 3.0))),
        ("uniform(2, 5) in [4, 9]", by_tail(stats.uniform(4.0, 1.0))),
        ("normal(0, 1) in [-1, 2]", cut_normal(0.0, 1.0, -1.0, 2.0)),
        ("normal(25, 3) in [20, inf]", cut_normal(25.0, 3.0, 20.0, np.inf)),
        ("normal(25, 3) in [-inf, 31]", cut_normal(25.0, 3.0, -np.inf, 31.0)),
        ("normal(0,1)in[20,21]", cut_normal(0.0, 1.0, 20.0, 21.0)),
        ("normal(0, 2) in [-42, -40]", cut_normal(0.0, 2.0, -42.0, -40.0)),
        (
            "lognormal(30, 0.5) in [5, 40]",
            30.0 * np.exp(cut_normal(0.0, 0.5, np.log(5 / 30), np.log(40 / 30))),
        ),
        (
            "lognormal(30, 0.5) in [0, 40]",
            30.0 * np.exp(cut_normal(0.0, 0.5, -np.inf, np.log(40 / 30))),
        ),
    ],
)
def test_values_are_the_quantiles_that_scipy_gives(text, expected):
    np.testing.assert_allclose(of(text), expected, rtol=1e-12)


def test_a_sample_cut_off_is_what_lies_inside_of_the_sample():
    """The cut quantile function's distribution is the whole one's, given that it lies inside."""
    whole = of("empirical(3, 1, 4, 1, 5, 9)", stats.norm.ppf(np.linspace(0.0, 1.0, 2_000_001)))
    inside = whole[(whole >= 1.0) & (whole <= 4.5)]
    share = np.array([0.05, 0.2, 0.5, 0.8, 0.95])
    found = of("empirical(3, 1, 4, 1, 5, 9) in [1, 4.5]", stats.norm.ppf(share))
    np.testing.assert_allclose(found, np.quantile(inside, share), atol=1e-5)
    upper = of("empirical(3, 1, 4, 1, 5, 9) in [4.5, inf]", np.array([-40.0, 40.0]))
    np.testing.assert_allclose(upper, [4.5, 9.0])


NUMBER = st.floats(-100.0, 100.0)


@given(
    kind=st.sampled_from(["normal", "lognormal", "uniform", "empirical"]),
    first=NUMBER,
    width=st.floats(0.01, 4.0),
    cut=st.none() | st.tuples(st.floats(-3.0, 3.0), st.floats(0.1, 3.0)),
)
def test_values_increase_stay_inside_and_are_read_back(kind, first, width, cut):
    first = abs(first) + 0.1 if kind == "lognormal" else first
    second = first + width if kind in ("uniform", "empirical") else width
    text = f"{kind}({first!r}, {second!r})"
    if cut is not None:
        low = first + 0.3 * cut[0] * width
        text += f" in [{low!r}, {low + cut[1] * width!r}]"
    try:
        found = read_distribution(text, name="gap")
    except ConfigError:  # what it is cut to lies beside it
        assert cut is not None
        return
    assert read_distribution(str(found), name="gap") == found
    z = np.sort(np.concatenate([np.linspace(-37.0, 37.0, 301), [-0.0, 1e-9]]))
    values = found.of(z)
    assert np.all(np.isfinite(values))
    assert np.all(np.diff(values) >= -1e-12 * np.abs(values[1:]))
    assert np.all((values >= found.low) & (values <= found.high))
    near = (np.abs(z[1:]) < 4.0) & (np.abs(z[:-1]) < 4.0) & (np.diff(z) > 1e-3)
    assert np.all(np.diff(values)[near] > 0.0)


BAD = {
    "": "must be a number, normal(MEAN, SD), lognormal(MEDIAN, SPREAD), uniform(LOW, HIGH)",
    "normal(3)": "normal takes (MEAN, SD), not 1 number",
    "normal(3, 1, 2)": "not 3 number",
    "empirical()": "not 0 number",
    "empirical(2, 2)": "two different values",
    "normal(3, 0)": "SD = 0: must be above 0",
    "lognormal(-1, 2)": "MEDIAN = -1: must be above 0",
    "lognormal(3, 9)": "SPREAD = 9: must be above 0 and at most 5",
    "uniform(5, 2)": "LOW = 5: must be below HIGH = 2",
    "normal(nan, 1)": "'nan': must be from -1e+06 to 1e+06",
    "normal(1e300, 1)": "'1e300': must be from",
    "inf": "must be from",
    "normal(three, 1)": "'three' is no number",
    "gamma(2, 1)": "must be a number, normal",
    "__import__('os')": "must be a number, normal",
    "normal(0, 1) in [2, 1]": "LOW below HIGH",
    "normal(0, 1) in [1]": "LOW below HIGH",
    "normal(0, 1) in [nan, 1]": "must be from",
    "normal(0, 1) in [40, 41]": "nothing of it lies in the interval",
    "lognormal(3, 1) in [-2, 0]": "nothing of it lies in the interval",
    "uniform(0, 1) in [1, 2]": "nothing of it lies in the interval",
    "empirical(1, 2) in [2, 3]": "nothing of it lies in the interval",
    "30 in [20, 40]": "a single number cannot be cut off",
    "normal(0, 1) in [0, 1] in [0, 1]": "is no number",
    "normal(0, 1)\nin [0,\n1": "'in [LOW, HIGH]' behind it",
    "normal(0, 1) [0, 1]": "'in [LOW, HIGH]' behind it",
    "9" * 100_000: "at most 20000 characters",
    "normal(" + "1," * 200_000 + ")": "at most 20000 characters",
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:20])
def test_what_is_no_distribution_is_refused_in_one_short_line(text):
    with pytest.raises(ConfigError) as caught:
        read_distribution(text, name="start: gap")
    message = str(caught.value)
    assert BAD[text] in message
    assert message.startswith("start: gap = ")
    assert "\n" not in message
    assert len(message) < 300
