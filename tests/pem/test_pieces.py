"""Networks asked along one pose variable by their pieces answer as they do row by row."""

from dataclasses import replace
from decimal import Decimal, localcontext
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.config import ScenarioConfig
from pemviz.errors import PemError
from pemviz.pem import load_pem
from pemviz.pem.models.ensemble import mean_probability_logit
from pemviz.pem.models.network import PAPER_INPUTS, Layer
from pemviz.pem.models.pieces import FEWEST_ROWS, chain_logit_along, kinks, logit_along
from pemviz.pem.models.protocol import COLUMN
from pemviz.sampling.state.composed import ComposedPem
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.simulators.braking.scenario import lead_car_salient

PEM = load_pem("ml-nn")
POSES = ("x_m", "y_m", "z_m", "rotation_y_rad")


def rows_along(name, values):
    rows = lead_car_salient(ScenarioConfig(), {"gap": np.full(values.size, 7.0)})
    rows = np.ascontiguousarray(rows)
    rows[:, COLUMN[name]] = values
    return rows


@given(
    seed=st.integers(0, 2**32 - 1),
    hidden=st.lists(st.integers(1, 24), max_size=3),
    name=st.sampled_from(POSES),
    low=st.floats(-1e3, 1e3),
    span=st.floats(1e-3, 1e3),
)
@settings(deadline=None, max_examples=40)
def test_any_network_along_any_pose_variable(seed, hidden, name, low, span):
    rng = np.random.default_rng(seed)
    sizes = [len(PAPER_INPUTS), *hidden, 1]
    layers = tuple(
        Layer(rng.normal(size=(after, before)), rng.normal(size=after))
        for before, after in pairwise(sizes)
    )
    pem = replace(PEM, layers=layers)
    rows = rows_along(name, rng.uniform(low, low + span, FEWEST_ROWS))
    expected = pem.logit(rows)
    largest = np.abs(expected).max() + 1.0
    np.testing.assert_allclose(logit_along(pem, rows), expected, rtol=0.0, atol=1e-12 * largest)


def test_the_shipped_network_along_the_gap():
    gaps = np.random.default_rng(0).uniform(-20.0, 150.0, 20_000)
    salient = lead_car_salient(ScenarioConfig(), {"gap": gaps})
    np.testing.assert_allclose(logit_along(PEM, salient), PEM.logit(salient), rtol=0.0, atol=1e-12)
    bends = kinks(PEM, salient[0], column=COLUMN["z_m"], low=-20.0, high=150.0)
    assert (np.diff(bends) > 0.0).all()
    assert 10 < bends.size < 200
    # between two bends the logit is straight: at a third of the way it is a third of the change
    third = bends[:-1] + np.diff(bends) / 3.0
    left, at, right = (
        PEM.logit(rows_along("z_m", values)) for values in (bends[:-1], third, bends[1:])
    )
    np.testing.assert_allclose(at, left + (right - left) / 3.0, atol=1e-12)


def test_an_ensemble_along_the_gap():
    gaps = np.repeat(np.random.default_rng(1).uniform(0.0, 60.0, 2 * FEWEST_ROWS), 2)
    salient = lead_car_salient(ScenarioConfig(), {"gap": gaps.reshape(4, -1)})
    ensemble = load_pem("ml-nn-ensemble")
    expected = ensemble.logit(salient)
    np.testing.assert_allclose(logit_along(ensemble, salient), expected, rtol=0.0, atol=1e-12)


@given(st.lists(st.floats(-1000.0, 1000.0), min_size=2, max_size=12), st.integers(0, 2**32))
def test_the_mean_of_members_is_that_of_their_probabilities(logits, seed):
    """In 60 digits, and the same to the last bit beside rows of any size."""
    values = np.array(logits)
    with localcontext(prec=60):
        shares = [1 / (1 + (-Decimal(v)).exp()) for v in logits]
        rests = [1 / (1 + Decimal(v).exp()) for v in logits]
        expected = float((sum(shares) / sum(rests)).ln())
    (found,) = mean_probability_logit(values[None])
    # near 0 what is left of the logs of two means of at least 0.3
    assert found == pytest.approx(expected, rel=1e-14, abs=2e-15)
    others = np.random.default_rng(seed).uniform(-1000.0, 1000.0, (5, values.size))
    assert mean_probability_logit(np.vstack([others, values]))[-1] == found


@pytest.mark.parametrize("pem", ["lr", "gb-raw"])
def test_other_models_and_other_rows_are_asked_as_they_are(pem):
    asked = load_pem(pem)
    rows = rows_along("z_m", np.linspace(1.0, 60.0, FEWEST_ROWS))
    rows[:, COLUMN["x_m"]] = np.linspace(-3.0, 3.0, FEWEST_ROWS)  # two vary
    np.testing.assert_array_equal(logit_along(asked, rows), asked.logit(rows))
    np.testing.assert_array_equal(logit_along(PEM, rows), PEM.logit(rows))
    shaped = rows.reshape(2, -1, rows.shape[1])
    np.testing.assert_array_equal(logit_along(asked, shaped), asked.logit(shaped))


@pytest.mark.parametrize(("column", "value"), [("z_m", np.nan), ("x_m", np.inf), ("class_id", 9.0)])
def test_bad_rows_are_refused_as_ever(column, value):
    rows = rows_along("z_m", np.linspace(1.0, 60.0, FEWEST_ROWS))
    rows[3, COLUMN[column]] = value
    with pytest.raises(PemError, match=f"salient row 3: {column}"):
        logit_along(PEM, rows)


@pytest.mark.parametrize("name", ["ml-nn", "ml-nn-ensemble", "gb-raw"])
def test_a_model_that_remembers_is_asked_along_the_gap_too(name):
    pem = ComposedPem(load_pem(name), (LastOutcome(0.3, 0.05),))
    rng = np.random.default_rng(3)
    own = lead_car_salient(ScenarioConfig(), {"gap": rng.uniform(-20.0, 150.0, (40, 50))})
    last = rng.integers(-1, 2, (40, 50)).astype(np.float64)
    salient = np.concatenate([own, last[..., None]], axis=-1)
    expected = pem.logit(salient)
    assert np.unique(expected).size > 60
    found = chain_logit_along(pem, salient)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(chain_logit_along(PEM, own), logit_along(PEM, own))
