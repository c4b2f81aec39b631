"""What perception depends on at a state is asked once, and what is asked then is the same."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from pemviz.config import EncounterConfig, StartChoice
from pemviz.errors import ConfigError
from pemviz.pem.models.position_errors import NoiseMemory, constant_errors
from pemviz.sampling.state.composed import with_component, with_last_outcome
from pemviz.sampling.state.violated import Monitored, Violated
from pemviz.simulators.check import check_simulator
from pemviz.simulators.encounters.scenario import EncounterFeatures
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.latents import begun, salient_of, stepped
from pemviz.simulators.slots import SIGHT, UnrolledSimulator
from pemviz.stl import FormulaMonitor, parse
from pemviz.types import StateBatch
from tests.slot_toys import TwoCars

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
    "tracker": scenario("cut-in", tracker="2/3,coast=0.3,filter=kalman", ghost_probability=0.1),
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


def plain(states):
    """The same states, of which nothing is known beside signals and memory."""
    return StateBatch(states.step, dict(states.signals), dict(states.memory))


@pytest.mark.parametrize("name", SCENARIOS)
def test_what_is_known_of_states_changes_nothing(name):
    """Salient variables, reactions and next states, with and without what states know."""
    unrolled = UnrolledSimulator(SCENARIOS[name])
    simulator = with_last_outcome(unrolled, tau_s=0.2)
    features = EncounterFeatures(unrolled, SCENARIOS[name])
    for states, hits, noise in steps(simulator):
        assert SIGHT in states.beside
        bare = plain(states)
        np.testing.assert_array_equal(
            salient_of(simulator, states), simulator.salient(states.signals)
        )
        np.testing.assert_array_equal(salient_of(simulator, bare), salient_of(simulator, states))
        assert_same(stepped(simulator, states, hits, noise), stepped(simulator, bare, hits, noise))
        by_row = replace(bare, step=np.full(states.shape, states.step))
        np.testing.assert_array_equal(features.values(states), features.values(by_row))
        np.testing.assert_array_equal(features.reacts(states), features.reacts(by_row))
        np.testing.assert_array_equal(
            features.reacts_within(states, steps=8), features.reacts_within(by_row, steps=8)
        )


@dataclass(frozen=True)
class Counted(TwoCars):
    """It counts how often it is asked."""

    asked: list[str] = field(default_factory=list)

    def present(self, signals):
        self.asked.append("present")
        return super().present(signals)

    def salient(self, signals):
        self.asked.append("salient")
        return super().salient(signals)


@pytest.mark.parametrize("remembers", ["nothing", "states", "monitor"])
def test_a_scenario_is_asked_once_a_step(remembers):
    """In the turns of all slots together, whatever is remembered of violations."""
    cars = Counted()
    simulator = with_last_outcome(UnrolledSimulator(cars), tau_s=0.2)
    rule = parse("always[0,3] (gap_a >= 0.5)")
    if remembers == "states":
        violated = Violated(lambda states: states.signals["gap_a"] < 0.5)
        simulator = with_component(simulator, violated)
    elif remembers == "monitor":
        simulator = with_component(simulator, Monitored(FormulaMonitor(rule)))
    for states, *_ in steps(simulator, count=3):
        salient_of(simulator, states)
    assert cars.asked.count("salient") == cars.states - 1
    assert cars.asked.count("present") == cars.states


@dataclass(frozen=True)
class ChangesWhatItIsGiven(TwoCars):
    """It hands on whatever it does not change."""

    def step(self, states, detected):
        after = super().step(states, detected)
        return replace(states, step=after.step, signals=after.signals)


def test_what_was_seen_before_is_not_taken_for_what_is_seen_after():
    one, other = (UnrolledSimulator(cars()) for cars in (TwoCars, ChangesWhatItIsGiven))
    for (states, *_), (like, *_) in zip(steps(one), steps(other), strict=True):
        assert_same(states, like)
        np.testing.assert_array_equal(salient_of(one, states), salient_of(other, like))


@dataclass(frozen=True)
class SeesElsewhere(TwoCars):
    """What it has under the name that is asked in place of others is something else."""

    def sight(self, signals):
        absent = np.zeros_like(self.present(signals))
        return SimpleNamespace(present=absent, salient=self.salient(signals))


@dataclass(frozen=True)
class ReactsElsewhere(TwoCars):
    """Likewise, of where it reacts."""

    def reacts(self, signals):
        return self.present(signals)

    def reacts_in(self, slot, signals):
        return ~self.present(signals)[..., slot]


def test_what_is_asked_in_place_of_others_must_say_the_same():
    with pytest.raises(ConfigError, match="sight and present differ: both must give the same"):
        check_simulator(SeesElsewhere())
    with pytest.raises(ConfigError, match="reacts_in and reacts differ: both must give the same"):
        check_simulator(ReactsElsewhere())
    for scenario in SCENARIOS.values():
        check_simulator(scenario)
