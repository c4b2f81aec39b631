"""Networks: agreement with torch, and answers that do not depend on the batch."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file

from pemviz.pem import PemError, load_pem, load_table, shipped_pems
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
