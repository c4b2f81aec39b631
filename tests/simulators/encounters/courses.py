"""Encounters of every kind for tests, and courses through them with outcomes of all kinds."""

import numpy as np

from pemviz.config import EncounterConfig, StartChoice
from pemviz.pem.models.position_errors import NoiseMemory, constant_errors
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.latents import begun, stepped

WIDE = (
    StartChoice("gap", "uniform(3, 60)"),
    StartChoice("closing_speed", "uniform(-3, 15)"),
)
ERRORS = constant_errors(range_sd_m=0.7, cross_range_sd_m=0.3, memory=NoiseMemory(0.3, 0.5))


def scenario(logical_scenario, **given):
    tracker, errors = given.pop("tracker", "none"), given.pop("errors", None)
    config = EncounterConfig(logical_scenario=logical_scenario, states=25, dt_s=0.25, **given)
    return VectorizedEncounters(config, WIDE, tracker, errors)


SCENARIOS = {
    "cut-in": scenario("cut-in"),
    "cut-out, neighbour": scenario("cut-out", neighbour=True),
    "braking": scenario("braking"),
    "ghost": scenario("cut-in", ghost_probability=0.1, neighbour=True),
    "tracker": scenario("cut-in", tracker="2/3,filter=kalman"),
    "errors": scenario("cut-out", errors=ERRORS, ghost_probability=0.1),
}


def steps(simulator, count=40, seed=3):
    """States of a course, their outcomes and their noise."""
    rng = np.random.default_rng(seed)
    latents = simulator.latents
    states = begun(simulator, count=count, start=rng.standard_normal((count, latents.at_start)))
    for _ in range(simulator.states - 1):
        hits = rng.random(count) < 0.6
        noise = rng.standard_normal((count, latents.noise))
        yield states, hits, noise
        states = stepped(simulator, states, hits, noise)


def assert_same(one, other):
    assert one.step == other.step
    for some, like in ((one.signals, other.signals), (one.memory, other.memory)):
        assert list(some) == list(like)
        for name, values in some.items():
            np.testing.assert_array_equal(values, like[name], err_msg=name)
