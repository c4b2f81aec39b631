"""The simulator of an experiment with what is known about it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from pemviz.config import CLIENTS, ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.faults import refusing
from pemviz.pem import load_position_errors
from pemviz.proposals.offset_logistic import SignalFeatures, StateFeatures
from pemviz.sampling.back_end import GAP, BackEnd, SlotFeatures, StepFeatures, TrackFeatures
from pemviz.sampling.description import MethodDescription, Need
from pemviz.sampling.problem import BATCH_ROLLOUTS
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.large_stages import largest_part
from pemviz.sampling.slots import turns_of, unrolled
from pemviz.simulators.braking.scenario import BrakingFeatures
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.check import check_simulator
from pemviz.simulators.detector_loop import DetectorItself, detecting
from pemviz.simulators.encounters.scenario import EncounterFeatures
from pemviz.simulators.episodic import EpisodicSimulator, episodic, side_by_side
from pemviz.simulators.latents import LatentSimulator, latent_counts, parts_of
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
DETECTOR_KNOWS = "simulator {!r} has the detector itself in the loop, which knows how it misses"
FIT_ANYWHERE = "use mixture, with {check} as an independent check"


def build_back_end(config: ExperimentConfig) -> BackEnd:
    """The back end that ``config`` names, shipped or registered, with its surrogate.

    Raises:
        ConfigError: There is none of that name, or it does not keep to the protocol.
        PemError: The model of position errors cannot be used.
    """
    return with_surrogate(_named_back_end(config), config)


def with_surrogate(
    back_end: BackEnd,
    config: ExperimentConfig,
    *,
    given: Simulator | SlotSimulator | EpisodicSimulator | None = None,
) -> BackEnd:
    """The back end with the surrogate that is ``given``, or else that ``config`` names, if any.

    Raises:
        ConfigError: There is none of that name, or it is no simulator of the same signals.
    """
    if config.surrogate is None:
        return back_end
    where = f"surrogate = {config.surrogate!r}"
    if given is None and config.surrogate == config.simulator:
        raise ConfigError(f"{where}: is the simulator itself; name a faster one, or leave it out")
    if detecting(back_end.simulator) is not None:
        raise ConfigError(f"{where}: {DETECTOR_KNOWS.format(back_end.simulator.name)}")
    named = replace(config, simulator=config.surrogate, surrogate=None)
    try:
        other = _named_back_end(named) if given is None else own_back_end(given)
    except ConfigError as error:
        words = str(error).replace(f"simulator = {config.surrogate!r}", where, 1)
        raise ConfigError(words) from error
    _check_alike(other.simulator, back_end.simulator, where=where)
    return replace(back_end, surrogate=other.simulator)


def _check_alike(other: Simulator, simulator: Simulator, *, where: str) -> None:
    """Refuse a twin or a surrogate that rollouts of the simulator could not be rollouts of.

    Raises:
        ConfigError: It has other parts than the simulator.
    """
    theirs = _parts_of(simulator)
    for what, own in _parts_of(other).items():
        if own != theirs[what]:
            raise ConfigError(
                f"{where}: {what} {own}: must be those of simulator {simulator.name!r}, "
                f"{theirs[what]}"
            )


def _parts_of(simulator: Simulator) -> Mapping[str, str]:
    """What a twin and a surrogate must share with the simulator, in words."""
    turns, scenario = turns_of(simulator), unrolled(simulator)
    slots = () if scenario is None else scenario.slots
    tracker = next(filter(None, map(tracker_of, parts_of(simulator))), None)
    return {
        "slots": ", ".join(slot.name for slot in slots) or "none",
        "states": f"{(simulator.states - 1) // turns + 1} of {simulator.dt_s:g} s",
        "signals": ", ".join(signal.name for signal in simulator.signals),
        "latents": str(latent_counts(simulator)),
        "tracker": "none" if tracker is None else str(tracker),
    }


def _named_back_end(config: ExperimentConfig) -> BackEnd:
    errors = None
    if config.position_errors is not None:
        check_measures(config)
        errors = load_position_errors(config.position_errors)
    if config.is_encounter:  # each slot takes its turn
        encounter = build_encounter_simulator(config, errors=errors)
        unrolled = UnrolledSimulator(encounter)
        return BackEnd(
            simulator=unrolled,
            features=EncounterFeatures(unrolled, encounter),
            twin=None,
            batch_rollouts=_batch_rollouts(config),
            is_own=True,
            position_errors=errors,
        )
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
    has_twin = errors is None and config.simulator != "sumo"
    return BackEnd(
        simulator=simulator,
        features=BrakingFeatures(config.scenario, errors),
        twin=VectorizedSimulator(config.scenario) if has_twin else None,
        batch_rollouts=_batch_rollouts(config),
        position_errors=errors,
    )


def check_measures(config: ExperimentConfig) -> None:
    """Refuse position errors for a simulator that takes none.

    Raises:
        ConfigError: It is none of the shipped ones.
    """
    if config.position_errors is None or config.is_braking_scenario or config.is_encounter:
        return
    raise ConfigError(
        f"position_errors = {config.position_errors!r}: simulator {config.simulator!r} takes none, "
        f"only the braking scenario and logical scenarios on {' and '.join(SHIPPED)} do"
    )


def _batch_rollouts(config: ExperimentConfig) -> int:
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
        ConfigError: One of them does not keep to the protocol, or they differ in their steps,
            signals, slots or tracker, or there are latents, which no twin can have.
    """
    # a batch of rollouts may have a field of any name, reset among them
    if isinstance(simulator, EpisodicSimulator) and not (
        isinstance(simulator, type) or hasattr(simulator, "initial")
    ):
        simulator = side_by_side(simulator)
    simulator = cast(Simulator | SlotSimulator | LatentSimulator, simulator)
    given: Any = simulator
    loop = detecting(given)
    if loop is not None:
        with refusing():
            loop.check_detector()
    check_simulator(given)
    own = _single_outcome(given)
    unrolled = own if isinstance(own, UnrolledSimulator) else None
    features = SignalFeatures(own.signals) if unrolled is None else SlotFeatures(unrolled)
    tracker = tracker_of(simulator)
    at_once = OWN_BATCH_ROLLOUTS if episodic(given) is None else SLOW_BATCH_ROLLOUTS
    return BackEnd(
        simulator=own,
        features=features if tracker is None else TrackFeatures(features, tracker, unrolled),
        twin=None if twin is None else _checked_twin(twin, given),
        batch_rollouts=min(at_once, largest_part(states=own.states)),
        is_own=True,
    )


def _checked_twin(
    twin: Simulator | SlotSimulator,
    simulator: Simulator | SlotSimulator | LatentSimulator,
) -> Simulator:
    where = f"twin of simulator {simulator.name!r}"
    if episodic(simulator) is not None:
        raise ConfigError(
            f"{where}: it is episodic, and its states cannot be kept; without a twin, use mixture"
        )
    counts = latent_counts(simulator)
    # a twin's states must be few: its start may be random where it is quantised, its steps not
    if counts and not (start_cells(twin) and latent_counts(twin) == counts):
        raise ConfigError(
            f"{where}: it has latents, and a twin's states must be those that outcomes alone "
            "lead to; of a random start alone, give pemviz.quantised_start(simulator, "
            f"cells=...); without a twin, {FIT_ANYWHERE.format(check='subset')}"
        )
    if twin is not simulator:
        check_simulator(twin)
    own = _single_outcome(twin)
    _check_alike(own, _single_outcome(cast(Simulator, simulator)), where=where)
    return own


def _single_outcome(simulator: Simulator | SlotSimulator) -> Simulator:
    return UnrolledSimulator(simulator) if isinstance(simulator, SlotSimulator) else simulator


def observed_outcomes(
    config: ExperimentConfig, back_end: BackEnd, *, given: object, hidden: Sequence[object]
) -> DetectorItself | None:
    """What stands in the error model's place where the detector itself is in the loop.

    Raises:
        ConfigError: It is, and there is an error model beside it, or something that belongs to one.
    """
    loop = detecting(back_end.simulator)
    if loop is None:
        return None
    settings = {"memory_s": config.memory_s, "frailty": config.frailty}
    settings |= {"memory_curve": config.memory_curve or None, "hidden": hidden or None}
    for name, value in {"pem": given, **settings}.items():
        if value is not None and not isinstance(value, DetectorItself):
            why = DETECTOR_KNOWS.format(back_end.simulator.name)
            raise ConfigError(f"{name}: {why}; leave it out, or give the scenario alone")
    return DetectorItself()


def with_choices(
    back_end: BackEnd, *, features: StateFeatures | None, batch_rollouts: int | None
) -> BackEnd:
    """The back end with what the user chose of it; ``None``: as it is.

    Raises:
        ConfigError: A batch is empty, or the features lack a method.
    """
    if batch_rollouts is not None:
        if batch_rollouts < 1:
            raise ConfigError(f"batch_rollouts = {batch_rollouts}: must be at least 1")
        back_end = replace(back_end, batch_rollouts=batch_rollouts)
    if features is None:
        return back_end
    lacks = [method for method in ("values", "reacts") if not hasattr(features, method)]
    if lacks:
        message = f"features = {type(features).__name__}: has no method {' and no '.join(lacks)}"
        raise ConfigError(message)
    turns = turns_of(back_end.simulator)
    return replace(back_end, features=StepFeatures(features, turns) if turns > 1 else features)


def _check_losses_fit(config: ExperimentConfig, described: MethodDescription) -> None:
    """Refuse to lose rollouts where they have to go through."""
    if config.lost == "end":
        return
    if described.interval_basis == "runs":
        raise ConfigError(
            f"lost = {config.lost!r}: method {config.method} goes on from its rollouts, and none "
            "does from one that breaks; use mixture"
        )
    if config.memory_curve:
        raise ConfigError(
            f"lost = {config.lost!r}: not with memory_curve, whose own rollouts all must go through"
        )


def _no_twin_because(
    config: ExperimentConfig, back_end: BackEnd, *, frailty: float | None
) -> str | None:
    """Why no method can go through all states; ``None`` where one can."""
    name, counts = back_end.simulator.name, latent_counts(back_end.simulator)
    if counts and back_end.twin is None:
        return f"runs through all states, and simulator {name!r} has latents"
    if counts and (config.frailty if frailty is None else frailty):
        return "takes a quantised start or frailty, not both"
    if config.memory_law == "visibility":
        return "runs through all states, and works with memory_law outcomes alone"
    if back_end.twin is None:
        return f"needs a fast twin, and simulator {name!r} has none"
    return None


def _check_curves_fit(config: ExperimentConfig, back_end: BackEnd) -> None:
    """Refuse curves over memories of a system that has none like these."""
    name = back_end.simulator.name
    if turns_of(back_end.simulator) > 1:
        raise ConfigError(f"memory_curve = true: not with slots, and simulator {name!r} has them")
    if config.memory_law == "visibility":
        raise ConfigError("memory_curve = true: works with memory_law outcomes alone")


def check_method_fits(
    config: ExperimentConfig, back_end: BackEnd, *, frailty: float | None = None
) -> None:
    """Check that the back end has what the method needs.

    ``frailty`` is that of the run; if it is not given, what ``config`` says.

    Raises:
        ConfigError: It has not; the line names methods that fit.
    """
    name, described = back_end.simulator.name, by_name(config.method)
    thins = described.interval_basis == "counts" and config.keep == "violations"
    if config.final_rollouts > MOST_ROLLOUTS and not thins:
        raise ConfigError(
            f"final_rollouts = {config.final_rollouts}: must be at most {MOST_ROLLOUTS}; "
            "more take method monte-carlo and keep = 'violations'"
        )
    _check_losses_fit(config, described)
    lacking: dict[Need, str] = {}
    counts = latent_counts(back_end.simulator)
    if complaint := _no_twin_because(config, back_end, frailty=frailty):
        lacking["twin"] = complaint
    if episodic(back_end.simulator) is not None:
        kept = f"goes on from kept states, and simulator {name!r} is episodic"
        lacking |= {"twin": kept, "restarts": kept}
    if detecting(back_end.simulator) is not None:
        observed = f"samples outcomes, and simulator {name!r} has the detector itself in the loop"
        lacking |= {"twin": observed, "restarts": observed, "gap": observed}
    elif back_end.farthest_m is None:
        lacking["gap"] = f"needs the gap, and simulator {name!r} has no signal {GAP!r}"
    elif turns_of(back_end.simulator) > 1:
        lacking["gap"] = f"looks at one gap alone, and simulator {name!r} has several slots"
    # splitting keeps the starts that rollouts were given, and goes on from kept states
    check = "subset" if "restarts" in lacking or counts.at_start else "splitting"
    loses = config.lost != "end"  # as those would refuse
    for need, complaint in lacking.items():
        if need in described.needs:
            fits = "use mixture" if loses else FIT_ANYWHERE.format(check=check)
            raise ConfigError(f"method = {config.method!r}: {complaint}; {fits}")
    if config.memory_curve:
        _check_curves_fit(config, back_end)
    if config.reference and "twin" in lacking:
        fits = "leave it out" if loses else f"use {check} as an independent check"
        raise ConfigError(f"reference = true: the reference {lacking['twin']}; {fits}")
