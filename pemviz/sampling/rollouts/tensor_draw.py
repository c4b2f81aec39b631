"""Rollouts as double-precision tensors on a torch device.

The simulator, error model and proposal are those that compute with numpy, moved to the device
(:class:`pemviz.arrays.Movable`). An error model or proposal that cannot go there is asked
through numpy at every step: as right, but slow on a GPU, which then waits for copies.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pemviz.arrays import AnyArray, FloatArray, Move, moved, to_numpy
from pemviz.pem.models.own_detector import DetectorModel
from pemviz.sampling.rollouts.draw import roll_out
from pemviz.types import Proposal, RolloutBatch, Simulator, StateBatch


def simulate(
    *,
    simulator: Simulator,
    pem: DetectorModel,
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
        N rollouts; ``None`` for a simulator that cannot go there.
    """

    def move(array: AnyArray) -> Any:
        return torch.tensor(np.ascontiguousarray(array), device=device)

    scenario: Simulator | None = moved(simulator, move)
    if scenario is None:
        return None
    start = simulator.initial(count=uniforms.shape[0])
    with torch.inference_mode(), one_thread():
        rollouts = roll_out(
            replace(start.map(move), step=start.step),  # one number, the same for all: stays here
            simulator=scenario,
            pem=moved(pem, move) or _PemHere(pem, move),
            proposal=moved(proposal, move) or _ProposalHere(proposal, move),
            draws=move(uniforms.T),
        )
        return rollouts.map(to_numpy)


@dataclass(frozen=True)
class _PemHere:
    pem: DetectorModel
    move: Move

    def logit(self, salient: FloatArray) -> Any:
        return self.move(self.pem.logit(np.ascontiguousarray(to_numpy(salient))))


@dataclass(frozen=True)
class _ProposalHere:
    proposal: Proposal
    move: Move

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> Any:
        return self.move(self.proposal.logit(states.map(to_numpy), to_numpy(pem_logit)))

    def arrays(self) -> Any:
        return self.proposal.arrays()


class one_thread:  # noqa: N801  reads as a statement
    """Small layers on the CPU: a second thread of torch's costs more than it brings."""

    def __enter__(self) -> None:
        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        torch.set_num_threads(self._threads)
