import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file

from pemviz.proposals.gap_network import (
    GapLoss,
    GapNetwork,
    OutcomeTable,
    Parameters,
    fit_gap_network,
    gap_network_from_arrays,
    initial_gap_network,
)
from tests.pooled import pool_outcomes


def as_torch(network: GapNetwork) -> torch.nn.Module:
    layers = torch.nn.Sequential(
        torch.nn.Linear(1, 32), torch.nn.ReLU(), torch.nn.Linear(32, 32), torch.nn.ReLU(),
        torch.nn.Linear(32, 2), torch.nn.LogSoftmax(dim=1),
    ).double()  # fmt: skip
    layers.load_state_dict({n: torch.from_numpy(a) for n, a in network.arrays().items()})
    return layers


def test_forward_agrees_with_torch():
    network = initial_gap_network(seed=7)
    gap_m = np.linspace(-5, 30, 500)
    with torch.no_grad():
        log_probability = as_torch(network)(torch.from_numpy(gap_m[:, None] / 12.0)).numpy()
    np.testing.assert_allclose(
        network.logit_at(gap_m), log_probability[:, 1] - log_probability[:, 0], rtol=1e-12
    )


def test_authors_proposals_load_and_agree_with_torch(authors_proposals):
    assert len(authors_proposals) == 3
    gap_m = np.linspace(0, 15, 200)
    for path in authors_proposals:
        arrays = load_file(path)
        renamed = {
            f"{layer}.{kind}": array
            for layer, (weight, bias) in zip((0, 2, 4), pairs(arrays), strict=True)
            for kind, array in (("weight", weight), ("bias", bias))
        }
        network = gap_network_from_arrays(renamed)
        with torch.no_grad():
            expected = as_torch(network)(torch.from_numpy(gap_m[:, None] / 12.0)).numpy()
        np.testing.assert_allclose(
            1 / (1 + np.exp(-network.logit_at(gap_m))), np.exp(expected[:, 1]), atol=1e-12
        )


def pairs(arrays):
    """Weight and bias of each layer, in the order of the layers' names."""
    names = sorted({name.rsplit(".", 1)[0] for name in arrays})
    return [(arrays[f"{name}.weight"], arrays[f"{name}.bias"]) for name in names]


@given(st.lists(st.floats(-20, 30), min_size=1, max_size=600), st.integers(0, 599))
def test_a_gap_gives_the_same_bits_in_every_batch(gaps, start):
    network = initial_gap_network(seed=1)
    gap_m = np.array(gaps)
    whole = network.logit_at(gap_m)
    start = start % gap_m.size
    np.testing.assert_array_equal(network.logit_at(gap_m[start:]), whole[start:])
    np.testing.assert_array_equal(network.logit_at(gap_m[start : start + 1])[0], whole[start])


@given(st.integers(1, 20), st.integers(1, 30), st.integers(0, 10_000))
def test_pooling_keeps_the_cross_entropy(rollouts, steps, seed):
    generator = np.random.default_rng(seed)
    gap_m = generator.choice(np.linspace(2, 15, 9), size=(rollouts, steps))
    detected = generator.random((rollouts, steps)) < 0.7
    weight = generator.dirichlet(np.ones(rollouts))
    table = pool_outcomes(gap_m=gap_m, detected=detected, rollout_weight=weight)
    logit = initial_gap_network(seed=3).logit_at

    def loss(logits, hit, weights):
        return np.sum(weights * np.logaddexp(0.0, np.where(hit, -logits, logits)))

    naive = loss(logit(gap_m), detected, weight[:, None] / steps)
    ones = np.ones(table.gap_m.size, dtype=bool)
    pooled = loss(logit(table.gap_m), ones, table.detected_weight) + loss(
        logit(table.gap_m), ~ones, table.missed_weight
    )
    assert pooled == pytest.approx(naive, rel=1e-12)
    assert table.detected_weight.sum() + table.missed_weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0, 1, 2**32 + 7, 2**63 - 1, 3_141_592_653_589])
def test_the_first_network_is_torchs_own_to_the_last_bit(seed):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [torch.nn.Linear(*sizes) for sizes in ((1, 32), (32, 32), (32, 2))]
    ours = initial_gap_network(seed=seed)
    for layer, weight, bias in zip(layers, ours.weights, ours.biases, strict=True):
        np.testing.assert_array_equal(weight, layer.weight.detach().double().numpy())
        np.testing.assert_array_equal(bias, layer.bias.detach().double().numpy())


@given(st.integers(1, 400), st.integers(0, 10_000), st.sampled_from((0.0, 0.3, 3.0)))
def test_closed_gradients_are_those_that_torch_derives(places, seed, scatter):
    """Also of units that see no input, and of those that turn far outside or between neighbours."""
    random = np.random.default_rng(seed)
    inputs = np.sort(random.normal(size=places)) if seed % 2 else np.linspace(-0.2, 1.3, places)
    detected, missed = random.random((2, places)) / places
    at, gradient = Parameters(), Parameters()
    at.flat[:] = random.normal(size=at.flat.size) * scatter
    at.layer_1[:, :3] *= np.array([[0.0, 1.0, 0.0], [1.0, 1e-9, 0.0]])
    loss = GapLoss(inputs, detected_weight=detected, missed_weight=missed)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        loss.gradient(at, into=gradient)
        value = loss.value(at)
    names = ("layer_1", "weight_2", "bias_2", "weight_3", "bias_3")
    first, second, bias_2, third, bias_3 = (
        torch.tensor(getattr(at, name), requires_grad=True) for name in names
    )
    hidden = torch.relu(torch.from_numpy(inputs)[:, None] * first[0] + first[1])
    logit = torch.relu(hidden @ second.T + bias_2) @ third + bias_3
    logs = torch.nn.functional.logsigmoid  # softplus is linear beyond 20
    expected = -(logs(logit) @ torch.from_numpy(detected) + logs(-logit) @ torch.from_numpy(missed))
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-12)
    derived = np.concatenate([tensor.grad.numpy().ravel() for tensor in
                              (first, second, bias_2, third, bias_3)])  # fmt: skip
    np.testing.assert_allclose(
        gradient.flat, derived, rtol=0, atol=1e-12 * (1 + abs(derived).max())
    )


def test_fit_follows_plain_adam_on_the_unpooled_data():
    """A naive loop over every outcome, in double precision, ends with the same parameters."""
    generator = np.random.default_rng(0)
    gap_m = generator.choice(np.linspace(2, 15, 12), size=(8, 20))
    detected = generator.random((8, 20)) < 0.8
    weight = np.full(8, 1 / 8)
    start = initial_gap_network(seed=5)
    layers = as_torch(start)
    optimiser = torch.optim.Adam(layers.parameters(), lr=1e-3)
    inputs = torch.from_numpy(gap_m.reshape(-1, 1) / 12.0)
    hit = torch.from_numpy(detected.ravel())
    for _ in range(60):
        optimiser.zero_grad()
        both = layers(inputs)
        loss = -torch.where(hit, both[:, 1], both[:, 0]).mean()
        loss.backward()
        optimiser.step()
    table = pool_outcomes(gap_m=gap_m, detected=detected, rollout_weight=weight)
    fitted, last = fit_gap_network(start, table, epochs=60, learning_rate=1e-3)
    for name, array in fitted.arrays().items():
        np.testing.assert_allclose(array, layers.state_dict()[name].numpy(), rtol=0, atol=1e-10)
    with torch.no_grad():
        both = layers(inputs)
        assert last == pytest.approx(-torch.where(hit, both[:, 1], both[:, 0]).mean().item())


def test_fit_lowers_the_loss_and_leaves_its_start_alone():
    table = OutcomeTable(
        gap_m=np.array([4.0, 12.0]),
        detected_weight=np.array([0.1, 0.45]),
        missed_weight=np.array([0.4, 0.05]),
    )
    start = initial_gap_network(seed=2)
    before = {name: array.copy() for name, array in start.arrays().items()}
    fitted, loss = fit_gap_network(start, table, epochs=2000, learning_rate=1e-2)
    for name, array in start.arrays().items():
        np.testing.assert_array_equal(array, before[name])
    probability = 1 / (1 + np.exp(-fitted.logit_at(table.gap_m)))
    np.testing.assert_allclose(probability, [0.2, 0.9], atol=0.02)
    entropy = -(0.1 * np.log(0.2) + 0.4 * np.log(0.8) + 0.45 * np.log(0.9) + 0.05 * np.log(0.1))
    assert loss == pytest.approx(entropy, abs=1e-3)


def test_initialisation_leaves_torchs_own_generator_alone():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    initial_gap_network(seed=9)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("4.bias", lambda array: np.full_like(array, 1.7e308)),
        ("2.weight", lambda array: np.full_like(array, 1e308)),
        ("0.weight", lambda array: array.T),
        ("4.weight", lambda array: array[:1]),
        ("2.bias", lambda array: np.array([np.nan])),
        ("0.bias", lambda array: np.full_like(array, np.nan)),
    ],
)
def test_parameters_that_form_no_network_or_overflow_are_refused(name, change):
    rng = np.random.default_rng(1)
    shapes = {"0.weight": (32, 1), "0.bias": 32, "2.weight": (32, 32), "2.bias": 32,
              "4.weight": (2, 32), "4.bias": 2}  # fmt: skip
    arrays = {key: rng.normal(size=shape) for key, shape in shapes.items()}
    gap_network_from_arrays(arrays)
    with pytest.raises(ValueError, match=r"layer|finite"):
        gap_network_from_arrays({**arrays, name: change(arrays[name])})
