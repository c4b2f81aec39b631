"""Where rollouts are computed: names of devices, and rollouts on one of them."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pemviz.arrays import FloatArray, moved
from pemviz.errors import ConfigError
from pemviz.latents import StandardNormals
from pemviz.pem.models.protocol import Pem
from pemviz.sampling.rollouts.batches import BatchRunner, BatchTask, Simulated, by_numpy
from pemviz.sampling.rollouts.compiled import CompiledRunner
from pemviz.sampling.rollouts.draw import simulate
from pemviz.types import Proposal, RolloutBatch, Simulator

NUMPY = "cpu"
TORCH_CPU = "torch-cpu"


@dataclass(frozen=True)
class DeviceRunner:
    """Simulates batches one after the other on a device; a :class:`BatchRunner`."""

    device: str

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in order."""
        for task in tasks:
            yield simulate_on_device(
                simulator=simulator,
                pem=pem,
                proposal=task.proposal,
                uniforms=task.uniforms,
                device=self.device,
                normals=task.normals,
            )


def batch_runner(device: str, simulated: Simulated = by_numpy) -> BatchRunner:
    """Who simulates batches on ``device``; here ``simulated`` what plain rollouts are not."""
    return CompiledRunner(simulated=simulated) if device == NUMPY else DeviceRunner(device)


def is_gpu(device: str) -> bool:
    """Whether a device wants larger batches than numpy, so that it is not kept waiting."""
    return device.startswith("cuda")


def simulate_on_device(
    *,
    simulator: Simulator,
    pem: Pem,
    proposal: Proposal,
    uniforms: FloatArray,
    device: str,
    normals: StandardNormals | None = None,
) -> RolloutBatch:
    """What :func:`pemviz.sampling.rollouts.draw.simulate` gives, computed on ``device``.

    The outcomes come from the same uniforms, so that rollouts are the same; logits differ by
    rounding. A simulator that is not :class:`pemviz.arrays.Movable`, or that takes latents, is
    stepped by numpy whatever the device.

    Args:
        simulator: The scenario.
        pem: The perception error model.
        proposal: What outcomes are drawn from.
        uniforms: ``[N, T-1]`` independent draws from [0, 1).
        device: ``cpu`` (numpy), ``torch-cpu``, ``cuda`` or ``cuda:N``.
        normals: Of a scenario with latents.

    Returns:
        N rollouts.
    """
    if device != NUMPY and normals is None:
        from pemviz.sampling.rollouts import tensor_draw  # noqa: PLC0415  torch is slow to import

        rollouts = tensor_draw.simulate(
            simulator=simulator,
            pem=pem,
            proposal=proposal,
            uniforms=uniforms,
            device=torch_name(device),
        )
        if rollouts is not None:
            return rollouts
    return simulate(
        simulator=simulator, pem=pem, proposal=proposal, uniforms=uniforms, normals=normals
    )


def has_tensors(part: object) -> bool:
    """Whether a simulator, error model or proposal computes with tensors on a torch device."""
    return moved(part, lambda array: array) is not None


def torch_name(device: str) -> str:
    """How torch calls a device of ours."""
    return "cpu" if device == TORCH_CPU else device


def check_device(device: str) -> None:
    """Refuse a GPU that this machine, or its build of torch, does not have.

    Raises:
        ConfigError: One line that says what there is.
    """
    match = re.fullmatch(r"cuda(?::(\d+))?", device)
    if match is None:
        return
    missing = missing_cuda(int(match[1] or 0))
    if missing:
        message = f"device = {device!r}: {missing}; use cpu"
        raise ConfigError(message)


def missing_cuda(index: int = 0) -> str:
    """Why CUDA device ``index`` cannot be used, in words; empty if it can."""
    import torch  # noqa: PLC0415  slow to import

    if not torch.backends.cuda.is_built():
        return f"torch {torch.__version__} is built without CUDA"
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        return "torch finds no CUDA device"
    return "" if index < count else f"torch finds {count} CUDA device(s), numbered from 0"
