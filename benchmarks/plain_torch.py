"""The paper's Algorithm 1 as one would write it in plain torch, to measure against.

Batched over rollouts, with `torch.nn`, `torch.optim` and automatic differentiation, and nothing of
the engine: the scenario of `pemviz.simulators.braking` in a dozen lines, the formula
``always (gap >= 2.0)``, fits of all outcomes of the elites. Dynamics in double precision, networks
in single precision, as torch has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.pem.models.network import PAPER_INPUTS, NetworkPem, paper_inputs
from pemviz.proposals.gap_network import GAP_SCALE_M, HIDDEN_UNITS
from pemviz.simulators.braking.scenario import GAP, lead_car_salient

LEAST_GAP_M = 2.0
Logit = Callable[[torch.Tensor], torch.Tensor]
"""Gaps ``[N]`` [m] to the logit of 'detected' ``[N]``."""


@dataclass(frozen=True)
class Drawn:
    """Rollouts of the scenario.

    Attributes:
        gap_m: ``[N, T]`` [m].
        detected: ``[N, T-1]``.
        log_weight: Log of the error model's over the proposal's likelihood, ``[N]``.
    """

    gap_m: torch.Tensor
    detected: torch.Tensor
    log_weight: torch.Tensor

    @property
    def robustness(self) -> torch.Tensor:
        """Of ``always (gap >= 2.0)``, ``[N]`` [m]."""
        return self.gap_m.amin(1) - LEAST_GAP_M


def paper_loop(config: ExperimentConfig, pem: NetworkPem, *, seed: int) -> tuple[float, int]:
    """One repetition: the estimate, and how many of the final rollouts violate.

    Args:
        config: Stages, rollouts, sigma, alpha, epochs, learning rate and scenario.
        pem: The error model.
        seed: Of all randomness.
    """
    generator, alpha = torch.Generator().manual_seed(seed), config.alpha or 0.1
    torch.manual_seed(seed)
    model, network = error_model(pem, config.scenario), proposal_network()
    steps, learned = config.scenario.states - 1, proposal_logit(network)
    for stage in range(config.stages + 1):
        uniforms = torch.rand(config.rollouts, steps, generator=generator, dtype=torch.float64)
        drawn = draw(config.scenario, model, model if stage == 0 else learned, uniforms)
        chosen = torch.ones(config.rollouts, dtype=torch.bool)
        weight = torch.ones(config.rollouts, dtype=torch.float64)
        if stage > 0:
            descending = drawn.robustness.sort(descending=True).values
            level = descending[math.floor(config.sigma * config.rollouts + 1e-9)].clamp(min=0.0)
            chosen = drawn.robustness <= level
            weight = torch.softmax(alpha * drawn.log_weight[chosen], 0)
        fit(network, drawn, chosen, weight / weight.sum(), config=config)
    uniforms = torch.rand(config.final_rollouts, steps, generator=generator, dtype=torch.float64)
    final = draw(config.scenario, model, learned, uniforms)
    violates = final.robustness < 0.0
    return float((final.log_weight.exp() * violates).mean()), int(violates.sum())


def error_model(pem: NetworkPem, scenario: ScenarioConfig) -> Logit:
    """The error model's network on the paper's 14 inputs, of which z alone follows the gap."""
    parts: list[torch.nn.Module] = []
    for layer in pem.layers:
        linear = torch.nn.Linear(layer.weight.shape[1], layer.weight.shape[0]).double()
        linear.weight.data = torch.as_tensor(layer.weight)
        linear.bias.data = torch.as_tensor(layer.bias)
        parts += [linear, torch.nn.ReLU()]
    network = torch.nn.Sequential(*parts[:-1])
    salient = lead_car_salient(scenario, {GAP: torch.zeros(1, dtype=torch.float64).numpy()})
    at_zero = torch.as_tensor(
        paper_inputs(salient, pose_mean=pem.pose_mean, pose_std=pem.pose_std)[:, 0]
    )
    per_metre = torch.zeros_like(at_zero)
    per_metre[PAPER_INPUTS.index("z_m")] = 1.0 / float(pem.pose_std[2])
    return lambda gap_m: network(at_zero + gap_m[:, None] * per_metre)[:, 0]


def proposal_network() -> torch.nn.Sequential:
    """The paper's: two hidden layers on the gap alone, log-softmax of 'missed', 'detected'."""
    return torch.nn.Sequential(
        torch.nn.Linear(1, HIDDEN_UNITS),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN_UNITS, 2),
        torch.nn.LogSoftmax(dim=1),
    )


def proposal_logit(network: torch.nn.Sequential) -> Logit:
    """What a proposal network says of 'detected'."""
    dtype = next(network.parameters()).dtype

    def logit(gap_m: torch.Tensor) -> torch.Tensor:
        outputs = network((gap_m[:, None] / GAP_SCALE_M).to(dtype))
        return (outputs[:, 1] - outputs[:, 0]).double()

    return logit


@torch.no_grad()
def draw(scenario: ScenarioConfig, model: Logit, proposal: Logit, uniforms: torch.Tensor) -> Drawn:
    """Rollouts with outcomes drawn from ``proposal`` by ``uniforms [N, T-1]``."""
    count, steps = uniforms.shape
    gap, ego, lead, integral, log_weight = torch.zeros(5, count, dtype=torch.float64)
    gap += scenario.initial_gap_m
    ego += scenario.initial_speed_mps
    lead += scenario.initial_speed_mps
    gaps, hits, sign = [gap], [], torch.nn.functional.logsigmoid
    for step in range(steps):
        p, q = model(gap), proposal(gap)
        hit = uniforms[:, step] >= torch.sigmoid(-q)
        side = 2.0 * hit - 1.0
        log_weight = log_weight + sign(side * p) - sign(side * q)
        error = scenario.initial_speed_mps - ego
        grown = integral + error * scenario.dt_s
        wanted = error * scenario.speed_gain_per_s + scenario.speed_integral_gain_per_s2 * grown
        wanted = wanted.clamp(
            -scenario.maximum_deceleration_mps2, scenario.maximum_acceleration_mps2
        )
        emergency = hit & (gap < scenario.emergency_gap_m)
        wanted = torch.where(emergency, -scenario.emergency_deceleration_mps2, wanted)
        integral = torch.where(emergency, integral, grown)
        gap = gap + (lead - ego) * scenario.dt_s
        ego = (ego + wanted * scenario.dt_s).clamp(min=0.0)
        braking = step * scenario.dt_s >= scenario.lead_brake_time_s
        lead = (lead - scenario.lead_deceleration_mps2 * braking * scenario.dt_s).clamp(min=0.0)
        gaps.append(gap)
        hits.append(hit)
    return Drawn(torch.stack(gaps, 1), torch.stack(hits, 1), log_weight)


def fit(
    network: torch.nn.Sequential,
    drawn: Drawn,
    chosen: torch.Tensor,
    weight: torch.Tensor,
    *,
    config: ExperimentConfig,
) -> float:
    """Minimise the weighted cross-entropy of the chosen rollouts' outcomes; its last value.

    Args:
        network: Trained in place.
        drawn: The rollouts.
        chosen: Which of them ``[N]``.
        weight: Of the chosen ``[n]``, summing to 1.
        config: Epochs and learning rate.
    """
    dtype = next(network.parameters()).dtype
    steps = drawn.detected.shape[1]
    inputs = (drawn.gap_m[chosen, :-1].reshape(-1, 1) / GAP_SCALE_M).to(dtype)
    outcome = drawn.detected[chosen].reshape(-1).long()
    each = (weight / steps).repeat_interleave(steps).to(dtype)
    adam = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    loss = torch.zeros(())
    for _ in range(config.epochs):
        adam.zero_grad()
        taken = network(inputs).gather(1, outcome[:, None])[:, 0]
        loss = -(each * taken).sum()
        loss.backward()  # pyright: ignore[reportUnknownMemberType]
        adam.step()
    return float(loss.detach())
