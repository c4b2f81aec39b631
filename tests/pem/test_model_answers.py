"""What models answer: as torch does, as a walk down every tree; the same in every batch."""

import math
import subprocess
import sys
from dataclasses import replace
from decimal import Decimal, localcontext
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file

from pemviz.config import ScenarioConfig
from pemviz.pem import PemError, load_pem, load_table, shipped_pems
from pemviz.pem.models import trees
from pemviz.pem.models.ensemble import mean_probability_logit
from pemviz.pem.models.network import PAPER_INPUTS, Layer
from pemviz.pem.models.pieces import FEWEST_ROWS, chain_logit_along, kinks, logit_along
from pemviz.pem.models.protocol import COLUMN
from pemviz.pem.models.trees import tree_features
from pemviz.sampling.state.composed import ComposedPem
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.simulators.braking.scenario import lead_car_salient
from tests.pem.helpers import braking_rows, random_rows, seeds


def torch_logits(tensors, inputs, dtype):
    """The authors' network as torch builds it, batch normalisation unfolded."""
    nn = torch.nn
    hidden = [nn.Linear(14, 20), nn.BatchNorm1d(20), nn.ReLU()]
    hidden += [nn.Linear(20, 20), nn.BatchNorm1d(20), nn.ReLU()]
    network = nn.Sequential(*hidden, nn.Linear(20, 1))
    state = {
        key.removeprefix("ff_nn."): torch.tensor(value)
        for key, value in tensors.items()
        if key.startswith("ff_nn.")
    }
    network.load_state_dict(state)
    network = network.to(dtype).eval()
    with torch.no_grad():
        return network(torch.tensor(inputs, dtype=dtype))[:, 0].numpy()


def authors_inputs(rows, tensors):
    pose = (rows[:, 7:] - tensors["input_mean"][7:]) / tensors["input_std"][7:]
    one_hot = (np.eye(7)[rows[:, 0].astype(int)], np.eye(3)[rows[:, 2].astype(int)])
    return np.concatenate([*one_hot, pose], axis=1)


def test_authors_checkpoint_agrees_with_torch(authors_checkpoint, kitti_folder):
    tensors = load_file(authors_checkpoint)
    rows = np.concatenate(
        [load_table(kitti_folder).salient[:3000], braking_rows(np.linspace(-30, 25, 200))]
    )
    ours = load_pem(str(authors_checkpoint)).logit(rows)
    inputs = authors_inputs(rows, tensors)
    np.testing.assert_allclose(ours, torch_logits(tensors, inputs, torch.float64), atol=1e-9)
    single = torch_logits(tensors, inputs, torch.float32)
    np.testing.assert_allclose(ours, single, atol=1e-4)
    probability = 1 / (1 + np.exp(-ours))
    np.testing.assert_allclose(probability, 1 / (1 + np.exp(-single.astype(float))), atol=1e-6)


@pytest.mark.parametrize("name", shipped_pems())
@settings(derandomize=True, deadline=None, max_examples=15)
@given(seed=seeds, count=st.integers(1, 1200))
def test_a_row_gives_the_same_bits_in_every_batch(name, seed, count):
    pem = load_pem(name)
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, count)
    whole = pem.logit(rows)
    order = rng.permutation(count)
    np.testing.assert_array_equal(pem.logit(rows[order]), whole[order])
    first, last = sorted(rng.integers(0, count + 1, 2))
    np.testing.assert_array_equal(pem.logit(rows[first:last]), whole[first:last])
    np.testing.assert_array_equal(pem.logit(rows[0]), whole[0])
    np.testing.assert_array_equal(pem.logit(rows[:, None]), whole[:, None])


def test_running_a_pem_imports_neither_torch_nor_sklearn():
    code = (
        "import sys; from pemviz.pem import load_pem; load_pem('ml-nn').logit([[0] * 9 + [10, 0]]);"
        "assert not {'torch', 'sklearn', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        (0, 7, "class_id is 7"),
        (0, 0.5, "class_id"),
        (2, -1, "occlusion"),
        (9, np.nan, "z_m is nan"),
    ],
)
def test_salient_variables_that_no_model_knows_are_refused(column, value, words):
    rows = braking_rows([5.0, 6.0])
    rows[1, column] = value
    with pytest.raises(PemError, match=f"salient row 1: .*{words}"):
        load_pem("ml-nn").logit(rows)


def test_wrong_number_of_columns_is_refused():
    with pytest.raises(PemError, match=r"shape \[3, 10\]"):
        load_pem("ml-nn").logit(np.zeros((3, 10)))


TREES = load_pem("gb-raw")


def walked(pem, row):
    """Logit of one row [11], node by node."""
    features = tree_features(row[None], feature_set=pem.feature_set)[:, 0]
    leaves = []
    for root in pem.root:
        node = int(root)
        while pem.feature[node] != trees.LEAF:
            goes_right = features[pem.feature[node]] > pem.number[node]
            node = int(pem.left[node]) + int(goes_right)
        leaves.append(float(pem.number[node]))
    return pem.calibration[0] * math.fsum(leaves) + pem.calibration[1]


@pytest.mark.parametrize("largest_cell", [trees.LARGEST_CELL, 100])
@pytest.mark.parametrize(
    "rows",
    [
        braking_rows(np.linspace(-5.0, 40.0, 3000)),
        random_rows(np.random.default_rng(3), 3000),
        braking_rows([]),
    ],
    ids=["along a gap", "anywhere", "none"],
)
def test_walking_down_every_tree(monkeypatch, rows, largest_cell):
    monkeypatch.setattr(trees, "LARGEST_CELL", largest_cell)
    every_75th = slice(None, None, 75)
    expected = [walked(TREES, row) for row in rows[every_75th]]
    np.testing.assert_array_equal(TREES.logit(rows)[every_75th], expected)


def test_rows_on_both_sides_of_a_threshold_are_told_apart():
    # left if feature <= threshold: the threshold itself and the next number above it part
    plan = TREES._plan
    depth = trees.FEATURES[TREES.feature_set].index("z_m")
    threshold = plan.thresholds[depth][plan.thresholds[depth].size // 2]
    features = np.zeros((len(plan.thresholds), 3))
    features[depth] = [np.nextafter(threshold, -np.inf), threshold, np.nextafter(threshold, np.inf)]
    first, place = plan.equal(features)
    np.testing.assert_array_equal(first, [0, 2])
    np.testing.assert_array_equal(place, [0, 0, 1])


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
