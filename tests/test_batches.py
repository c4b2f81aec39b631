"""Rows of batches, taken and put together: the laws, and every array looked at by name."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.latents import Latents
from pemviz.sampling.splitting.particles import Particles
from pemviz.types import RolloutBatch, ScoredRollouts, StateBatch

STATES = 4


def rollouts(generator, count):
    """Time-major below, as they are drawn."""
    shape = STATES - 1, count
    return RolloutBatch(
        signals={name: generator.normal(size=(STATES, count)).T for name in ("gap", "speed")},
        memory={"integral": generator.normal(size=(STATES, count)).T},
        detected=generator.random(shape).T < 0.5,
        pem_logit=generator.normal(size=shape).T,
        proposal_logit=generator.normal(size=shape).T,
        latents=Latents(
            *(generator.normal(size=(2, count)).T for _ in range(2)),
            generator.normal(size=count),
            *(generator.normal(size=(2, STATES - 1, count)).T for _ in range(2)),
            generator.random(size=shape).T,
            generator.random(size=(2, STATES - 1, count)).T,
            generator.normal(size=(2, STATES - 1, count)).T,
            generator.random(size=shape).T,
        ),
    )


def scored(generator, count):
    return ScoredRollouts(
        rollouts=rollouts(generator, count),
        robustness=generator.normal(size=count),
        violated=generator.random(count) < 0.5,
        timings_s={"simulation": 2.0},
    )


def particles(generator, count):
    return Particles(
        rollouts=rollouts(generator, count),
        score=generator.normal(size=(count, STATES)),
        evaluations=generator.integers(9, size=(count, STATES)),
        ancestor=np.arange(count),
    )


def states(generator, count, step):
    def values():
        return generator.normal(size=(count, STATES))

    return StateBatch(step=step, signals={"gap": values()}, memory={"integral": values()})


def states_of_one_step(generator, count):
    return states(generator, count, np.array(3))


def states_by_step(generator, count):
    return states(generator, count, np.arange(STATES)[None, :])


def states_by_row(generator, count):
    return states(generator, count, generator.integers(0, 9, size=(count, 1)))


each_kind = pytest.mark.parametrize(
    "kind", [rollouts, scored, particles, states_of_one_step, states_by_step, states_by_row]
)
seeds = st.integers(0, 2**32 - 1)


def arrays(batch, path=""):
    """Every array below a batch, by its place; a step as each row has it."""
    if isinstance(batch, StateBatch):
        batch = {**vars(batch), "step": np.broadcast_to(batch.step, batch.shape)}
    if is_dataclass(batch):
        batch = {f.name: getattr(batch, f.name) for f in fields(batch) if f.name != "timings_s"}
    if not isinstance(batch, dict):
        return {path: batch}
    return {
        name: array
        for key, value in batch.items()
        for name, array in arrays(value, f"{path}.{key}").items()
    }


def assert_same(one, other):
    assert arrays(one).keys() == arrays(other).keys()
    for place, array in arrays(one).items():
        np.testing.assert_array_equal(array, arrays(other)[place], err_msg=place)
        assert array.dtype == arrays(other)[place].dtype, place


def drawn(kind, seed):
    generator = np.random.default_rng(seed)
    count = int(generator.integers(2, 7))
    return kind(generator, count), count, generator


@each_kind
@given(seed=seeds)
def test_take_takes_the_same_rows_of_every_array(kind, seed):
    batch, count, generator = drawn(kind, seed)
    index = generator.integers(0, count, size=5)
    expected = {place: array[index] for place, array in arrays(batch).items()}
    assert len(expected) >= 3
    for place, array in arrays(batch.take(index)).items():
        np.testing.assert_array_equal(array, expected[place], err_msg=place)


@each_kind
@given(seed=seeds)
def test_concatenate_of_takes_is_take(kind, seed):
    batch, count, generator = drawn(kind, seed)
    parts = [generator.integers(0, count, size=size) for size in (3, 0, 2)]
    joined = type(batch).concatenate([batch.take(part) for part in parts])
    assert_same(joined, batch.take(np.concatenate(parts)))
    assert_same(batch.take(parts[0]).take(np.array([2, 0])), batch.take(parts[0][[2, 0]]))


@each_kind
@given(seed=seeds)
def test_parts_come_back_out_of_what_they_were_put_into(kind, seed):
    batch, count, generator = drawn(kind, seed)
    other = kind(generator, 3)
    joined = type(batch).concatenate([batch, other])
    assert_same(joined.take(slice(count)), batch)
    assert_same(joined.take(slice(count, None)), other)
    assert_same(type(batch).concatenate([batch]), batch)


@each_kind
@given(seed=seeds)
def test_masks_slices_and_indices_agree(kind, seed):
    batch, count, generator = drawn(kind, seed)
    mask = generator.random(count) < 0.5
    assert_same(batch.take(mask), batch.take(np.flatnonzero(mask)))
    assert_same(batch.take(slice(1, None, 2)), batch.take(np.arange(count)[1::2]))


@each_kind
@given(seed=seeds)
def test_map_reaches_every_array_and_commutes_with_take(kind, seed):
    batch, count, _ = drawn(kind, seed)
    kept = slice(0, count, 2)

    def as_numbers(array):
        return array.astype(np.float64) + 1.0

    for place, array in arrays(batch.map(as_numbers)).items():
        np.testing.assert_array_equal(array, arrays(batch)[place] + 1.0, err_msg=place)
    assert_same(batch.map(as_numbers).take(kept), batch.take(kept).map(as_numbers))


@given(seed=seeds)
def test_likelihoods_follow_the_rows(seed):
    batch, count, generator = drawn(rollouts, seed)
    index = generator.integers(0, count, size=4)
    for name in ("log_p", "log_q", "log_weight"):
        np.testing.assert_array_equal(getattr(batch.take(index), name), getattr(batch, name)[index])


def test_timings_add_up_and_stay_with_what_is_taken():
    batch = scored(np.random.default_rng(0), 4)
    assert ScoredRollouts.concatenate([batch, batch]).timings_s == {"simulation": 4.0}
    assert batch.take(slice(2)).timings_s == {"simulation": 2.0}


def test_rows_of_different_steps_are_put_together_with_their_steps():
    generator = np.random.default_rng(0)
    early, late = (states(generator, 2, np.array(step)) for step in (1, 5))
    joined = StateBatch.concatenate([early, late])
    np.testing.assert_array_equal(joined.step[:, 0], [1, 1, 5, 5])


def test_slices_copy_nothing():
    batch = scored(np.random.default_rng(0), 4)
    before, after = arrays(batch), arrays(batch.take(slice(1, 3)))
    assert all(np.shares_memory(array, before[place]) for place, array in after.items())


def test_rows_of_monitored_states_are_states_without_what_the_monitor_knew():
    one = states_of_one_step(np.random.default_rng(0), 3)
    monitored = replace(one, beside={"known": "of three rollouts"})
    assert not monitored.take(slice(2)).beside
