"""Rollouts as double-precision tensors on a torch device: `sampling.rollout` once more.

Error models and proposals without a twin (see `tensor_twins`) are asked through numpy at every
step: as right, but slow on a GPU, which then waits for copies.
"""

from collections.abc import Mapping
from typing import cast

import numpy as np
import torch
from torch import Tensor

from pemviz.arrays import AnyArray, FloatArray
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.gap_network_fit import one_thread
from pemviz.sampling.rollouts.tensor_twins import (
    PemTwin,
    ProposalTwin,
    SimulatorTwin,
    TensorStates,
    as_tensor,
    twin,
)
from pemviz.types import Proposal, RolloutBatch, Simulator


def simulate(
    *,
    simulator: Simulator,
    pem: Pem,
    proposal: Proposal,
    uniforms: FloatArray,
    device: str,
) -> RolloutBatch | None:
    """Roll out the scenario once for each row of ``uniforms`` ``[N, T-1]``.

    Args:
        simulator: The scenario.
        pem: The perception error model.
        proposal: What outcomes are drawn from.
        uniforms: Independent draws from [0, 1).
        device: As torch calls it.

    Returns:
        N rollouts; ``None`` for a simulator without a twin.
    """
    scenario = cast(SimulatorTwin | None, twin(simulator, device))
    if scenario is None:
        return None
    with torch.inference_mode(), one_thread():
        return _rolled_out(
            scenario,
            error_model=twin(pem, device) or _pem_through_numpy(pem, device),
            sampled_from=twin(proposal, device) or _proposal_through_numpy(proposal, device),
            draws=as_tensor(uniforms.T, device),
        )


def _rolled_out(
    scenario: SimulatorTwin, *, error_model: PemTwin, sampled_from: ProposalTwin, draws: Tensor
) -> RolloutBatch:
    """Rollouts for draws ``[T-1, N]``; time comes first, so that a step writes one row."""
    steps, count = draws.shape
    detected = torch.empty_like(draws, dtype=torch.bool)
    under_pem, under_proposal = torch.empty_like(draws), torch.empty_like(draws)
    states = scenario.initial(count=count)
    signals, memory = _track(states.signals, steps + 1), _track(states.memory, steps + 1)
    for step in range(steps):
        under_pem[step] = error_model(scenario.salient(states))
        under_proposal[step] = sampled_from(states, under_pem[step])
        detected[step] = draws[step] >= torch.special.expit(-under_proposal[step])
        states = scenario.step(states, detected[step])
        _record(signals, states.signals, step + 1)
        _record(memory, states.memory, step + 1)
    return RolloutBatch(
        signals={name: _by_rollout(values) for name, values in signals.items()},
        memory={name: _by_rollout(values) for name, values in memory.items()},
        detected=_by_rollout(detected),
        pem_logit=_by_rollout(under_pem),
        proposal_logit=_by_rollout(under_proposal),
    )


def _pem_through_numpy(pem: Pem, device: str) -> PemTwin:
    return lambda salient: as_tensor(
        pem.logit(np.ascontiguousarray(salient.cpu().numpy().T)), device
    )


def _proposal_through_numpy(proposal: Proposal, device: str) -> ProposalTwin:
    def logit(states: TensorStates, pem_logit: Tensor) -> Tensor:
        return as_tensor(proposal.logit(states.to_numpy(), pem_logit.cpu().numpy()), device)

    return logit


def _track(first: Mapping[str, Tensor], states: int) -> dict[str, Tensor]:
    """Room for ``states`` rows of each value, with the first filled in."""
    tracks = {name: values.new_empty((states, *values.shape)) for name, values in first.items()}
    _record(tracks, first, 0)
    return tracks


def _record(tracks: Mapping[str, Tensor], values: Mapping[str, Tensor], row: int) -> None:
    for name, track in tracks.items():
        track[row] = values[name]


def _by_rollout(values: Tensor) -> AnyArray:
    return values.cpu().numpy().T
