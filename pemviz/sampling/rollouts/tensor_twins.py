"""Twins of simulators, error models and proposals that compute with torch tensors.

`twin` is the registry, by type: a part of one's own joins with ``@twin.register``. Twins do
the arithmetic of their originals in the same order, in double precision; what has no twin is
asked through numpy. Imports torch: import this module where a device is asked for, not before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from pemviz.arrays import AnyArray, BoolArray
from pemviz.config import ScenarioConfig
from pemviz.pem.models.network import NetworkPem
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network import GapNetwork
from pemviz.proposals.offset_logistic import (
    LARGEST_SHIFT,
    STANDARD_RANGE,
    OffsetLogisticProposal,
)
from pemviz.sampling.value_twisted.unsafe_states import UnsafeStates
from pemviz.simulators.braking.emergency_braking import brakes, is_close
from pemviz.simulators.braking.features import BrakingFeatures
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    SPEED_ERROR_INTEGRAL,
    lead_car_salient,
)
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.latched import VIOLATED, LatchedSimulator
from pemviz.stl.semantics import evaluate
from pemviz.stl.torch_twin import TorchClassical
from pemviz.types import StateBatch

POSE = slice(COLUMN["x_m"], COLUMN["rotation_y_rad"] + 1)


@dataclass(frozen=True)
class TensorStates:
    """:class:`pemviz.types.StateBatch` in tensors ``[N]``, all of one step."""

    step: int
    signals: Mapping[str, Tensor]
    memory: Mapping[str, Tensor]

    def to_numpy(self) -> StateBatch:
        """The same states in arrays ``[N]``."""
        return StateBatch(
            step=np.array(self.step, dtype=np.int64),
            signals={name: values.cpu().numpy() for name, values in self.signals.items()},
            memory={name: values.cpu().numpy() for name, values in self.memory.items()},
        )


class SimulatorTwin(Protocol):
    """A scenario; what it is given and gives is on one device."""

    def initial(self, *, count: int) -> TensorStates:
        """``count`` copies of the state in which every rollout starts."""
        ...

    def step(self, states: TensorStates, detected: Tensor) -> TensorStates:
        """The next states, given outcomes ``[N]``."""
        ...

    def salient(self, states: TensorStates) -> Tensor:
        """Salient variables, features first: ``[D, N]``."""
        ...


PemTwin = Callable[[Tensor], Tensor]
"""Salient variables ``[D, N]`` to the logit ``[N]`` of 'detected'."""

ProposalTwin = Callable[[TensorStates, Tensor], Tensor]
"""States and the error model's logit ``[N]`` to the proposal's ``[N]``."""

UnsafeTwin = Callable[[TensorStates], Tensor]
"""States to whether they violate, ``[N]``."""


@singledispatch
def twin(part: object, device: str) -> Any:  # noqa: ARG001
    """The twin of ``part`` on a torch ``device``; ``None`` where there is none.

    A simulator's is a :class:`SimulatorTwin`; an error model's, a proposal's and a rule's are
    functions (``PemTwin``, ``ProposalTwin``, ``UnsafeTwin``).
    """
    return None


def as_tensor(array: AnyArray, device: str) -> Tensor:
    """A copy of an array on ``device``, of the same type."""
    return torch.tensor(np.ascontiguousarray(array), device=device)


@dataclass(frozen=True)
class BrakingTwin:
    """Explicit Euler steps as `simulators.vectorized` takes them."""

    config: ScenarioConfig
    device: str

    def initial(self, *, count: int) -> TensorStates:
        """Both cars at the initial speed."""
        start = VectorizedSimulator(self.config).initial(count=1)
        return TensorStates(
            step=0,
            signals={n: as_tensor(v, self.device).repeat(count) for n, v in start.signals.items()},
            memory={n: as_tensor(v, self.device).repeat(count) for n, v in start.memory.items()},
        )

    def step(self, states: TensorStates, detected: Tensor) -> TensorStates:
        """Positions with the old speeds, then speeds."""
        dt_s = self.config.dt_s
        gap_m, ego_mps, lead_mps = (states.signals[n] for n in (GAP, EGO_SPEED, LEAD_SPEED))
        braking = states.step * dt_s >= self.config.lead_brake_time_s
        lead_mps2 = -self.config.lead_deceleration_mps2 if braking else 0.0
        ego_mps2, integral_m = self._ego_acceleration(states, detected)
        return TensorStates(
            step=states.step + 1,
            signals={
                GAP: (lead_mps - ego_mps) * dt_s + gap_m,
                EGO_SPEED: (ego_mps + ego_mps2 * dt_s).clamp(min=0.0),
                LEAD_SPEED: (lead_mps + lead_mps2 * dt_s).clamp(min=0.0),
            },
            memory={SPEED_ERROR_INTEGRAL: integral_m},
        )

    def salient(self, states: TensorStates) -> Tensor:
        """The lead car's salient variables ``[11, N]``."""
        gap_m = states.signals[GAP]
        at_zero = lead_car_salient(self.config, {GAP: np.zeros(1)}).T
        salient = as_tensor(at_zero, self.device).repeat(1, gap_m.shape[0])
        salient[COLUMN["z_m"]] = gap_m + self.config.lead_length_m / 2
        return salient

    def _ego_acceleration(self, states: TensorStates, detected: Tensor) -> tuple[Tensor, Tensor]:
        config = self.config
        error_mps = config.initial_speed_mps - states.signals[EGO_SPEED]
        held_m = states.memory[SPEED_ERROR_INTEGRAL]
        grown_m = error_mps * config.dt_s + held_m
        wanted_mps2 = error_mps * config.speed_gain_per_s
        wanted_mps2 = wanted_mps2 + config.speed_integral_gain_per_s2 * grown_m
        cruise_mps2 = wanted_mps2.clamp(
            -config.maximum_deceleration_mps2, config.maximum_acceleration_mps2
        )
        emergency = brakes(detected, states.signals[GAP], config)
        return (
            torch.where(emergency, -config.emergency_deceleration_mps2, cruise_mps2),
            torch.where(emergency, held_m, grown_m),
        )


@twin.register
def _(part: VectorizedSimulator, device: str) -> SimulatorTwin:
    return BrakingTwin(part.config, device)


@dataclass(frozen=True)
class LatchedTwin:
    """Remembers violations as `simulators.latched` does."""

    scenario: SimulatorTwin
    unsafe: UnsafeTwin

    def initial(self, *, count: int) -> TensorStates:
        """The scenario's initial states and whether they violate."""
        states = self.scenario.initial(count=count)
        return self._latched(states, torch.zeros_like(self.unsafe(states)))

    def step(self, states: TensorStates, detected: Tensor) -> TensorStates:
        """The scenario's next states; a violation stays."""
        return self._latched(self.scenario.step(states, detected), states.memory[VIOLATED])

    def salient(self, states: TensorStates) -> Tensor:
        """The scenario's salient variables."""
        return self.scenario.salient(states)

    def _latched(self, states: TensorStates, before: Tensor) -> TensorStates:
        return replace(states, memory={**states.memory, VIOLATED: before | self.unsafe(states)})


@twin.register
def _(part: LatchedSimulator, device: str) -> SimulatorTwin | None:
    scenario = twin(part.scenario, device)
    if scenario is None:
        return None
    return LatchedTwin(scenario, twin(part.unsafe, device) or _asked_whether(part.unsafe, device))


def _asked_whether(unsafe: Callable[[StateBatch], BoolArray], device: str) -> UnsafeTwin:
    return lambda states: as_tensor(unsafe(states.to_numpy()), device)


@twin.register
def _(part: UnsafeStates, device: str) -> UnsafeTwin:
    def unsafe(states: TensorStates) -> Tensor:
        result = torch.zeros_like(next(iter(states.signals.values())), dtype=torch.bool)
        single = {name: values[None, :] for name, values in states.signals.items()}
        for rule in part.rules:
            if rule.first <= states.step <= rule.last:
                value = evaluate(rule.predicate, TorchClassical(), single, start=0, steps=1)
                result = result | (value[0] < 0.0)
        return result.to(device)

    return unsafe


@twin.register
def _(part: NetworkPem, device: str) -> PemTwin:
    layers = [(as_tensor(x.weight, device), as_tensor(x.bias, device)) for x in part.layers]
    mean, std = as_tensor(part.pose_mean, device), as_tensor(part.pose_std, device)
    classes = torch.arange(len(CLASS_NAMES), dtype=torch.float64, device=device)
    occlusions = torch.arange(len(OCCLUSION_NAMES), dtype=torch.float64, device=device)

    def logit(salient: Tensor) -> Tensor:
        inputs = torch.cat(
            [
                (salient[COLUMN["class_id"]] == classes[:, None]).double(),
                (salient[COLUMN["occlusion"]] == occlusions[:, None]).double(),
                (salient[POSE] - mean[:, None]) / std[:, None],
            ]
        )
        return _forward(layers, inputs)[0]

    return logit


@twin.register
def _(part: PemProposal, device: str) -> ProposalTwin:  # noqa: ARG001
    return lambda _, pem_logit: pem_logit


@twin.register
def _(part: ConstantProposal, device: str) -> ProposalTwin:  # noqa: ARG001
    value = float(part.logit(StateBatch(np.array(0), {}), np.zeros(1))[0])
    return lambda _, pem_logit: torch.full_like(pem_logit, value)


@twin.register
def _(part: GapNetwork, device: str) -> ProposalTwin:
    pairs = zip(part.weights, part.biases, strict=True)
    layers = [(as_tensor(weight, device), as_tensor(bias, device)) for weight, bias in pairs]

    def logit(states: TensorStates, _: Tensor) -> Tensor:
        missed, detected = _forward(layers, states.signals[GAP][None, :] / part.gap_scale_m)
        return detected - missed

    return logit


@twin.register
def _(part: OffsetLogisticProposal, device: str) -> ProposalTwin | None:
    if not isinstance(part.features, BrakingFeatures):
        return None
    config, basis = part.features.config, part.basis
    mean, spread = as_tensor(basis.mean, device), as_tensor(basis.spread, device)
    coefficients = as_tensor(part.coefficients, device)
    share = float(part.defensive)

    def logit(states: TensorStates, pem_logit: Tensor) -> Tensor:
        gap_m = states.signals[GAP]
        closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
        time_s = torch.full_like(gap_m, states.step * config.dt_s)
        values = torch.stack([gap_m, closing_mps, time_s])
        standard = ((values - mean[:, None]) / spread[:, None]).clamp(
            -STANDARD_RANGE, STANDARD_RANGE
        )
        monomials = torch.stack([_product(standard, chosen) for chosen in basis.exponents])
        shift = (coefficients @ monomials).clamp(-LARGEST_SHIFT, LARGEST_SHIFT)
        acts = is_close(gap_m, config)
        if part.violated in states.memory:
            acts = acts & ~states.memory[part.violated]
        return torch.where(acts, _defended(pem_logit - shift, pem_logit, share), pem_logit)

    return logit


def _product(rows: Tensor, chosen: Sequence[int]) -> Tensor:
    """The product ``[N]`` of the chosen rows of ``[D, N]``; 1 of none."""
    # row by row: an index list would be copied to the device at every step
    result = torch.ones_like(rows[0])
    for row in chosen:
        result = result * rows[row]
    return result


def _defended(logit: Tensor, pem_logit: Tensor, share: float) -> Tensor:
    """`proposals.defence.defended`."""
    detected, missed = (
        torch.logaddexp(
            float(np.log1p(-share)) + logsigmoid(sign * logit),
            float(np.log(share)) + logsigmoid(sign * pem_logit),
        )
        for sign in (1.0, -1.0)
    )
    return detected - missed


def _forward(layers: list[tuple[Tensor, Tensor]], inputs: Tensor) -> Tensor:
    """Outputs ``[outputs, N]`` of a rectified network on inputs ``[features, N]``."""
    hidden = inputs
    for weight, bias in layers[:-1]:
        hidden = torch.addmm(bias[:, None], weight, hidden).clamp_(min=0.0)
    weight, bias = layers[-1]
    return torch.addmm(bias[:, None], weight, hidden)
