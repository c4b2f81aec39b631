"""The simulator of an experiment with what is known about it."""

from dataclasses import replace
from typing import Any, cast

from pemviz.config import CLIENTS, ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.errors import ConfigError
from pemviz.pem import PositionErrorModel, load_position_errors
from pemviz.proposals.offset_logistic import SignalFeatures, StateFeatures
from pemviz.sampling.back_end import GAP, BackEnd, SlotFeatures, StepFeatures, TrackFeatures
from pemviz.sampling.description import Need
from pemviz.sampling.problem import BATCH_ROLLOUTS
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.large_stages import largest_part
from pemviz.sampling.slots import turns_of
from pemviz.simulators.braking.scenario import BrakingFeatures, BrakingScenario
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.check import check_simulator
from pemviz.simulators.encounters.scenario import EncounterFeatures
from pemviz.simulators.episodic import EpisodicSimulator, episodic, side_by_side
from pemviz.simulators.latents import LatentSimulator, latent_counts
from pemviz.simulators.merge.scenario import MergeSimulator
from pemviz.simulators.quantised import start_cells
from pemviz.simulators.registry import SHIPPED, build_encounter_simulator, build_named_simulator
from pemviz.simulators.slots import SlotSimulator, UnrolledSimulator
from pemviz.simulators.sumo.traffic.simulator import TrafficSimulator
from pemviz.simulators.tracked_cars import TrackedCarFeatures
from pemviz.simulators.tracking.tracker import tracker_of
from pemviz.types import Simulator

SLOW_BATCH_ROLLOUTS = 50
SUMO_BATCH_ROLLOUTS = 512
OWN_BATCH_ROLLOUTS = 500
MOST_ROLLOUTS = 10_000_000
"""Final rollouts that are weighted, or all kept: 4 GB a million of 100 states."""
FIT_ANYWHERE = "use mixture, with splitting as an independent check"


def build_back_end(config: ExperimentConfig) -> BackEnd:
    """The back end that ``config`` names, shipped or registered.

    Raises:
        ConfigError: There is none of that name, or it does not keep to the protocol.
        PemError: The model of position errors cannot be used.
    """
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        return _encounter_back_end(config)
    errors = _position_errors(config)
    simulator = build_named_simulator(
        config.simulator, config.scenario, errors=errors, carla=config.carla, sumo=config.sumo
    )
    if config.simulator in CLIENTS:  # not tried out: physics there need not repeat themselves
        return BackEnd(
            simulator=simulator,
            features=BrakingFeatures(config.scenario),
            twin=None,
            batch_rollouts=SLOW_BATCH_ROLLOUTS,
            is_own=True,
        )
    if isinstance(simulator, MergeSimulator | TrafficSimulator):
        back_end = own_back_end(simulator)
        turns = cast(UnrolledSimulator, back_end.simulator)
        return replace(back_end, features=TrackedCarFeatures(turns, simulator))
    if config.simulator not in SHIPPED:
        return own_back_end(simulator)
    if errors is not None and isinstance(simulator, BrakingScenario):
        return BackEnd(
            simulator=simulator,
            features=BrakingFeatures(config.scenario, errors),
            twin=None,
            batch_rollouts=batch_rollouts(config),
            position_errors=errors,
        )
    return BackEnd(
        simulator=simulator,
        features=BrakingFeatures(config.scenario),
        twin=None if config.simulator == "sumo" else VectorizedSimulator(config.scenario),
        batch_rollouts=batch_rollouts(config),
    )


def _encounter_back_end(config: ExperimentConfig) -> BackEnd:
    """Of a logical scenario, each slot of which takes its turn.

    Raises:
        ConfigError: A start value's distribution cannot be.
        PemError: The model of position errors cannot be used.
    """
    errors = _position_errors(config)
    scenario = build_encounter_simulator(config, errors=errors)
    unrolled = UnrolledSimulator(scenario)
    return BackEnd(
        simulator=unrolled,
        features=EncounterFeatures(unrolled, scenario),
        twin=None,
        batch_rollouts=batch_rollouts(config),
        is_own=True,
        position_errors=errors,
    )


def _position_errors(config: ExperimentConfig) -> PositionErrorModel | None:
    """The errors by which a shipped back end measures.

    Raises:
        InputError: They cannot be used, or the back end is none that takes them.
    """
    if config.position_errors is None:
        return None
    check_measures(config)
    return load_position_errors(config.position_errors)


def check_measures(config: ExperimentConfig) -> None:
    """Refuse position errors for a simulator that takes none.

    Raises:
        ConfigError: It is none of the shipped ones.
    """
    is_encounter = config.encounter.logical_scenario != NO_LOGICAL_SCENARIO
    if config.position_errors is None or config.is_braking_scenario or is_encounter:
        return
    message = (
        f"position_errors = {config.position_errors!r}: simulator {config.simulator!r} takes none, "
        f"only the braking scenario and logical scenarios on {' and '.join(SHIPPED)} do"
    )
    raise ConfigError(message)


def batch_rollouts(config: ExperimentConfig) -> int:
    """How many rollouts are simulated at a time; the result does not depend on it."""
    if config.simulator == "highway-env":
        return SLOW_BATCH_ROLLOUTS
    if config.simulator == "sumo":
        return SUMO_BATCH_ROLLOUTS
    largest = largest_part(states=config.states)
    # parts of a large final batch are not joined from smaller batches, which costs as much as they
    return largest if config.final_rollouts > largest else min(BATCH_ROLLOUTS, largest)


def own_back_end(
    simulator: Simulator | SlotSimulator | LatentSimulator | EpisodicSimulator,
    *,
    twin: Simulator | SlotSimulator | None = None,
) -> BackEnd:
    """A simulator of the user's own, tried out, with a twin of its own if it has one.

    One with slots is unrolled; an environment that can only be reset and stepped is one of one
    rollout at a time.

    Raises:
        ConfigError: One of them does not keep to the protocol, or they differ in their states, or
            there are latents, which no twin can have.
    """
    simulator = _at_once(simulator)
    check_simulator(simulator)
    if twin is not None and episodic(simulator) is not None:
        message = (
            f"twin of simulator {simulator.name!r}: it is episodic, and its states cannot be kept; "
            "without a twin, use mixture"
        )
        raise ConfigError(message)
    if twin is not None:
        _check_latents(simulator, twin)
        check_simulator(twin)
        if _of_states(twin) != _of_states(simulator):
            message = f"twin of simulator {simulator.name!r}: must have the same states and signals"
            raise ConfigError(message)
    own = _single_outcome(simulator)
    return BackEnd(
        simulator=own,
        features=_features(own, simulator),
        twin=None if twin is None else _single_outcome(twin),
        batch_rollouts=min(OWN_BATCH_ROLLOUTS, largest_part(states=own.states)),
        is_own=True,
    )


def _check_latents(simulator: object, twin: object) -> None:
    """A twin's states must be few: its start may be random where it is quantised, its steps not."""
    counts = latent_counts(simulator)
    if counts and not (start_cells(twin) and latent_counts(twin) == counts):
        name = getattr(simulator, "name", "")
        message = (
            f"twin of simulator {name!r}: it has latents, and a twin's states must be "
            "those that outcomes alone lead to; of a random start alone, give "
            f"pemviz.quantised_start(simulator, cells=...); without a twin, {FIT_ANYWHERE}"
        )
        raise ConfigError(message)


def _at_once(
    simulator: Simulator | SlotSimulator | LatentSimulator | EpisodicSimulator,
) -> Simulator | SlotSimulator | LatentSimulator:
    """A simulator whose states are arrays; of one environment, one of one rollout at a time."""
    if isinstance(simulator, EpisodicSimulator) and not isinstance(simulator, type):
        return side_by_side(simulator)
    return cast(Any, simulator)


def _features(own: Simulator, simulator: Simulator | SlotSimulator) -> StateFeatures:
    """What proposals look at in states of the user's simulator, unrolled to ``own``."""
    unrolled = own if isinstance(own, UnrolledSimulator) else None
    features = SignalFeatures(own.signals) if unrolled is None else SlotFeatures(unrolled)
    tracker = tracker_of(simulator)
    return features if tracker is None else TrackFeatures(features, tracker, unrolled)


def with_choices(
    back_end: BackEnd, *, features: StateFeatures | None, batch_rollouts: int | None
) -> BackEnd:
    """The back end with what the user chose of it; ``None``: as it is.

    Raises:
        ConfigError: A batch is empty, or the features lack a method.
    """
    if batch_rollouts is not None:
        if batch_rollouts < 1:
            message = f"batch_rollouts = {batch_rollouts}: must be at least 1"
            raise ConfigError(message)
        back_end = replace(back_end, batch_rollouts=batch_rollouts)
    if features is None:
        return back_end
    lacks = [method for method in ("values", "reacts") if not hasattr(features, method)]
    if lacks:
        message = f"features = {type(features).__name__}: has no method {' and no '.join(lacks)}"
        raise ConfigError(message)
    turns = turns_of(back_end.simulator)
    return replace(back_end, features=StepFeatures(features, turns) if turns > 1 else features)


def _of_states(simulator: Simulator | SlotSimulator) -> tuple[object, ...]:
    return simulator.states, simulator.signals, getattr(simulator, "slots", ())


def _single_outcome(simulator: Simulator | SlotSimulator | LatentSimulator) -> Simulator:
    return UnrolledSimulator(simulator) if isinstance(simulator, SlotSimulator) else simulator


def _check_rollouts(config: ExperimentConfig) -> None:
    """Refuse more rollouts than are to be weighted, or kept.

    Raises:
        ConfigError: In one line that names what takes more.
    """
    counted = by_name(config.method).interval_basis == "counts"
    if config.final_rollouts > MOST_ROLLOUTS and not (counted and config.keep == "violations"):
        message = (
            f"final_rollouts = {config.final_rollouts}: must be at most {MOST_ROLLOUTS}; "
            "more take method monte-carlo and keep = 'violations'"
        )
        raise ConfigError(message)


def check_method_fits(config: ExperimentConfig, back_end: BackEnd) -> None:
    """Check that the back end has what the method needs.

    Raises:
        ConfigError: It has not; the line names methods that fit.
    """
    _check_rollouts(config)
    name = back_end.simulator.name
    lacking: dict[Need, str] = {}
    counts = latent_counts(back_end.simulator)
    if counts and back_end.twin is None:
        lacking["twin"] = f"runs through all states, and simulator {name!r} has latents"
    elif counts and config.frailty > 0.0:
        lacking["twin"] = "takes a quantised start or frailty, not both"
    elif back_end.twin is None:
        lacking["twin"] = f"needs a fast twin, and simulator {name!r} has none"
    if episodic(back_end.simulator) is not None:
        kept = f"goes on from kept states, and simulator {name!r} is episodic"
        lacking |= {"twin": kept, "restarts": kept}
    if back_end.farthest_m is None:
        lacking["gap"] = f"needs the gap, and simulator {name!r} has no signal {GAP!r}"
    elif turns_of(back_end.simulator) > 1:
        lacking["gap"] = f"looks at one gap alone, and simulator {name!r} has several slots"
    for need, complaint in lacking.items():
        if need in by_name(config.method).needs:
            fits = "use mixture" if "restarts" in lacking else FIT_ANYWHERE
            message = f"method = {config.method!r}: {complaint}; {fits}"
            raise ConfigError(message)
    if config.memory_curve and turns_of(back_end.simulator) > 1:
        message = f"memory_curve = true: not with slots, and simulator {name!r} has them"
        raise ConfigError(message)
    if config.reference and "twin" in lacking:
        fits = "leave it out" if "restarts" in lacking else "use splitting as an independent check"
        message = f"reference = true: the reference {lacking['twin']}; {fits}"
        raise ConfigError(message)
