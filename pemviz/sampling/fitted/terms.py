"""Whom the loop of fitted proposals serves, and what it is told of them."""

import math

import numpy as np

from pemviz.config import ScenarioConfig
from pemviz.pem.models.encoding import POSE_INDEX
from pemviz.pem.models.network import Layer, NetworkPem
from pemviz.pem.models.pieces import bends, kinks
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network import GapNetwork
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.fitted.numbers import (
    ALONG_GAP,
    DIVIDED,
    ERROR_MODEL,
    Chained,
    Fitted,
    Pieces,
    Rules,
    Tracking,
    pieces_of,
)
from pemviz.sampling.memory import RememberingFeatures, RememberingPem
from pemviz.sampling.mixture.draws import DividedProposal
from pemviz.sampling.rollouts.kernels import lead_speeds
from pemviz.sampling.value_twisted.unsafe_states import UnsafeStates
from pemviz.simulators.braking.features import BrakingFeatures
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, scenario_tracker
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.latched import VIOLATED, LatchedSimulator
from pemviz.simulators.remembering import RememberingSimulator
from pemviz.simulators.tracking.filters import LastPosition
from pemviz.stl.expressions import Constant, Predicate, Signal
from pemviz.stl.formulas import And, Formula
from pemviz.types import Proposal, Simulator

SIGNALS = (GAP, EGO_SPEED, LEAD_SPEED)
CELLS = 4096
"""Of the range of gaps, for each of which it is kept which linear piece it begins in."""
NOTHING = np.empty(0)
NO_STEPS = np.empty(0, dtype=np.int64)
NOWHERE = np.empty(0, dtype=np.bool_)


def plain_part(simulator: Simulator) -> VectorizedSimulator | None:
    """The scenario beneath what remembers violations and outcomes; ``None``: another one."""
    part: object = simulator
    if type(part) is LatchedSimulator:
        part = part.scenario
    if type(part) is RememberingSimulator:
        part = part.scenario
    if type(part) is not VectorizedSimulator or part.errors is not None:
        return None
    tracker = part.tracker
    return part if tracker is None or tracker.filter == LastPosition() else None


def model_part(pem: Pem) -> NetworkPem | None:
    """The network of single outcomes beneath a memory of misses; ``None``: another model."""
    part = pem.pem if type(pem) is RememberingPem else pem
    return part if type(part) is NetworkPem else None


def remembers(simulator: Simulator) -> bool:
    """Whether states say what the last outcome was."""
    inner = simulator.scenario if isinstance(simulator, LatchedSimulator) else simulator
    return isinstance(inner, RememberingSimulator)


def is_served(simulator: Simulator, pem: Pem, proposal: Proposal) -> bool:
    """Whether the loop knows the scenario, the model and whom outcomes are drawn from."""
    scenario = plain_part(simulator)
    if scenario is None or model_part(pem) is None:
        return False
    if remembers(simulator) != (type(pem) is RememberingPem) or rules_of(simulator) is None:
        return False
    if type(proposal) is DividedProposal:
        return _is_divided(proposal, scenario.config, remembers=remembers(simulator))
    if type(proposal) is PemProposal:  # without either, whose answers are kept by gap
        return scenario.tracker is not None or remembers(simulator)
    if type(proposal) is ConstantProposal:
        return 0.0 < proposal.detection_probability < 1.0
    return type(proposal) is GapNetwork


def _is_divided(proposal: DividedProposal, config: ScenarioConfig, *, remembers: bool) -> bool:
    """Whether pilots and fits look at nothing but what the loop knows."""
    pilots, fitted = proposal.pilots, proposal.fitted
    alike = fitted is None or (fitted.features == pilots.features and fitted.violated == VIOLATED)
    return (
        alike
        and _are_known(pilots.features, config, remembers=remembers)
        and pilots.violated == VIOLATED
        and pilots.slot is None
        and not proposal.aims.rules
        and proposal.latents is None
    )


def _are_known(features: StateFeatures, config: ScenarioConfig, *, remembers: bool) -> bool:
    if remembers != (type(features) is RememberingFeatures):
        return False
    own = _scenario_features(features)
    if own is None or own.config != config:
        return False
    return own.scenario is None or own.scenario.errors is None


def _scenario_features(features: StateFeatures) -> BrakingFeatures | None:
    own = features.features if isinstance(features, RememberingFeatures) else features
    return own if type(own) is BrakingFeatures else None


def reach_m(simulator: VectorizedSimulator) -> tuple[float, float]:
    """Between which gaps all rollouts stay [m]."""
    first, steps = simulator.initial(count=1), simulator.states - 1
    lowest_m = simulator.signal_bounds(first, steps=steps)[GAP][0]
    way_m = float(lead_speeds(simulator.config).sum()) * simulator.dt_s  # of an ego that stands
    return float(np.min(lowest_m)) - 1.0, float(first.signals[GAP][0]) + way_m + 1.0


def model_numbers(simulator: Simulator, pem: Pem) -> Chained:
    """Of an error model that is served."""
    scenario, network = plain_part(simulator), model_part(pem)
    assert scenario is not None and network is not None  # noqa: S101, PT018  it is served
    low, high = reach_m(scenario)
    row = scenario.salient({GAP: np.array([low])})[0]
    ends = scenario.salient({GAP: np.array([low, high])})
    column = next(c for c in POSE_INDEX if ends[0, c] != ends[1, c])
    # a gap is a place along the column, moved by the same length everywhere
    edge = kinks(network, row, column=column, low=ends[0, column], high=ends[1, column])
    edge = edge - (ends[0, column] - low)
    rho = pem.rho if isinstance(pem, RememberingPem) else 0.0
    value = network.logit(scenario.salient({GAP: edge}))
    return Chained(
        own=pieces_of(edge, value, cells=CELLS),
        remembers=remembers(simulator),
        rho=float(rho),
        log_rest=float(np.log1p(-rho)),
    )


def network_pieces(network: GapNetwork, *, low: float, high: float) -> Pieces:
    """A proposal by gap, between two gaps [m]."""
    layers = [
        Layer(weight, bias) for weight, bias in zip(network.weights, network.biases, strict=True)
    ]
    slope, offset = np.array([[1.0 / network.gap_scale_m]]), np.zeros((1, 1))
    edge = bends(layers[:-1], slope, offset, low=low, high=high)
    return pieces_of(edge, network.logit_at(edge), cells=CELLS)


def rules_of(simulator: Simulator) -> Rules | None:
    """What violates; ``None`` where it takes more than to compare signals with numbers."""
    if not isinstance(simulator, LatchedSimulator):
        return Rules(False, NO_STEPS, NO_STEPS, NO_STEPS, NOWHERE, NOTHING)
    unsafe = simulator.unsafe
    if not isinstance(unsafe, UnsafeStates) or unsafe.turns != 1:
        return None
    rows: list[tuple[int, int, int, bool, float]] = []
    for rule in unsafe.rules:
        parts = _compared(rule.predicate)
        if parts is None:
            return None
        rows += [(rule.first, rule.last, *part) for part in parts]
    first, last, signal, is_lower, bound = zip(*rows, strict=True)
    return Rules(
        latched=True,
        first=np.array(first, dtype=np.int64),
        last=np.array(last, dtype=np.int64),
        signal=np.array(signal, dtype=np.int64),
        is_lower=np.array(is_lower, dtype=np.bool_),
        bound=np.array(bound, dtype=np.float64),
    )


def _compared(predicate: Formula) -> list[tuple[int, bool, float]] | None:
    """Signals, and their lower or upper bounds, all of which must be kept."""
    match predicate:
        case And(parts=parts):
            each = [_compared(part) for part in parts]
            known = [one for one in each if one is not None]
            return [row for one in known for row in one] if len(known) == len(each) else None
        case Predicate(left=Signal(name=name), right=Constant(value=value)) if name in SIGNALS:
            bound = float(value)
            if predicate.is_strict:  # what is above a number is at least the next one
                bound = math.nextafter(bound, math.inf if predicate.is_lower_bound else -math.inf)
            return [(SIGNALS.index(name), predicate.is_lower_bound, bound)]
        case _:
            return None


def tracking_numbers(config: ScenarioConfig) -> Tracking:
    """Of the scenario's tracker, if it has one."""
    tracker = scenario_tracker(config)
    if tracker is None:
        return Tracking(False, 0, 0, 0, 0, 0.0, 0.0)
    known_s = (tracker.window - 1 + tracker.coast_steps) * config.dt_s
    closing_mps2 = config.lead_deceleration_mps2 + config.maximum_acceleration_mps2
    return Tracking(
        tracks=True,
        hits=tracker.hits,
        window=tracker.window,
        coast_steps=tracker.coast_steps,
        none_since=max(tracker.window - 1, tracker.coast_steps + 1),
        known_s=known_s,
        known_m=0.5 * closing_mps2 * known_s**2,
    )


def proposal_numbers(proposal: Proposal, model: Chained) -> Fitted:
    """Of a proposal that is served; ``model`` is the error model's."""
    low, high = float(model.own.edge[0]), float(model.own.edge[-1])
    if isinstance(proposal, GapNetwork):
        return _alike(ALONG_GAP, network_pieces(proposal, low=low, high=high))
    if isinstance(proposal, ConstantProposal):
        probability = proposal.detection_probability
        logit = float(np.log(probability) - np.log1p(-probability))
        flat = pieces_of(np.array([low, high]), np.full(2, logit), cells=1)
        return _alike(ALONG_GAP, flat)
    if not isinstance(proposal, DividedProposal):
        return _alike(ERROR_MODEL, model.own)
    pilots, fitted, features = proposal.pilots, proposal.fitted, proposal.pilots.features
    count = pilots.strength.size
    factors = np.array(fitted.basis.factors if fitted else [], dtype=np.int64).reshape(-1, 2)
    ignores = not isinstance(features, RememberingFeatures) or features.ignores
    return Fitted(
        kind=DIVIDED,
        network=model.own,
        everywhere=not ignores,
        strength=np.ascontiguousarray(pilots.strength, dtype=np.float64),
        begin=np.ascontiguousarray(pilots.first, dtype=np.int64),
        stop=np.ascontiguousarray(pilots.stop, dtype=np.int64),
        piloted=np.ascontiguousarray(proposal.piloted),
        coefficients=np.ascontiguousarray(
            fitted.coefficients if fitted else np.empty((count, 0)), dtype=np.float64
        ),
        mean=fitted.basis.mean if fitted else NOTHING,
        spread=fitted.basis.spread if fitted else NOTHING,
        lower=np.ascontiguousarray(factors[:, 0]),
        feature=np.ascontiguousarray(factors[:, 1]),
        share=float(fitted.defensive) if fitted else 0.0,
    )


def _alike(kind: int, network: Pieces) -> Fitted:
    """What does not differ from rollout to rollout."""
    return Fitted(
        kind, network, False, NOTHING, NO_STEPS, NO_STEPS, NOWHERE, np.empty((0, 0)), NOTHING,
        NOTHING, NO_STEPS, NO_STEPS, 0.0,
    )  # fmt: skip
