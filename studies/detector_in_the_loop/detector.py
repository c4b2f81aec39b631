"""The detector: a small convolutional network that finds cars in an image, without memory.

Of an image it makes, for each of 16 x 40 cells of 4 x 4 pixels, a score that a car's middle is
there and the distances from the cell's centre to the car's four sides (as FCOS, Tian et al. 2019,
on one scale). Detections are cells whose score is the greatest of their 3 x 3 neighbours, without
those that overlap a better one by more than :data:`MOST_OVERLAP` (non-maximum suppression).

Images are looked at :data:`AT_A_TIME` at a time, the last ones filled up: a convolution's last
digit depends on how many images it is given, and a rollout must not depend on those beside it.
"""

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from pemviz.arrays import FloatArray
from pemviz.matching import iou
from studies.detector_in_the_loop.camera import HEIGHT_PX, WIDTH_PX
from studies.detector_in_the_loop.render import Images

STRIDE_PX = 4
ROWS, COLUMNS = HEIGHT_PX // STRIDE_PX, WIDTH_PX // STRIDE_PX
AT_A_TIME = 64
MOST = 12
"""Detections of an image."""
MOST_OVERLAP = 0.4
LOWEST_SCORE = 0.02


@dataclass(frozen=True)
class Detections:
    """Up to :data:`MOST` detections in each of N images, the best first.

    Attributes:
        box_px: Left, top, right, bottom ``[N, D, 4]``.
        score: ``[N, D]``, 0 where there is no detection.
    """

    box_px: FloatArray
    score: FloatArray


def _convolution(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Module:
    layer = nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU())


class Network(nn.Module):
    """Images ``[N, 3, 64, 160]`` from -1 to 1 to ``[N, 5, 16, 40]``: score logit, log distances."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            _convolution(3, 12, stride=2), _convolution(12, 24, stride=2), _convolution(24, 24)
        )
        self.down = _convolution(24, 40, stride=2)
        self.around = nn.Sequential(_convolution(40, 40), _convolution(40, 40, dilation=2))
        self.up = _convolution(40, 24)
        self.joined = _convolution(24, 24)
        self.out = nn.Conv2d(24, 5, 1)
        assert isinstance(self.out.bias, Tensor)  # noqa: S101  it has one
        nn.init.constant_(self.out.bias[:1], -4.0)  # cars are rare

    def forward(self, images: Tensor) -> Tensor:
        """As the class says."""
        fine = self.stem(images)
        coarse = self.up(self.around(self.down(fine)))
        coarse = nn.functional.interpolate(coarse, scale_factor=2.0, mode="nearest")
        return self.out(self.joined(fine + coarse))


def as_input(images: Images) -> Tensor:
    """Images ``[N, 64, 160, 3]`` as the network takes them."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float().div_(127.5).sub_(1.0)


def centres_px() -> tuple[Tensor, Tensor]:
    """Columns ``[40]`` and rows ``[16]`` of the cells' centres."""
    u = (torch.arange(COLUMNS) + 0.5) * STRIDE_PX
    return u, (torch.arange(ROWS) + 0.5) * STRIDE_PX


def decoded_boxes(raw: Tensor) -> Tensor:
    """Boxes ``[N, 16, 40, 4]`` of log distances ``[N, 4, 16, 40]``."""
    u, v = centres_px()
    left, top, right, bottom = (STRIDE_PX * raw.clamp(-4.0, 4.0).exp()).unbind(1)
    row = v[:, None]
    return torch.stack([u - left, row - top, u + right, row + bottom], dim=-1)


@dataclass(frozen=True)
class Detector:
    """A trained network, and from which score on its detections count.

    Attributes:
        network: In evaluation mode.
        threshold: On the score.
    """

    network: Network
    threshold: float

    def detect(self, images: Images) -> Detections:
        """What it finds in N images, of whatever score above :data:`LOWEST_SCORE`."""
        found = [
            self._detect(images[start : start + AT_A_TIME])
            for start in range(0, len(images), AT_A_TIME)
        ]
        if not found:
            return Detections(np.zeros((0, MOST, 4)), np.zeros((0, MOST)))
        return Detections(
            box_px=np.concatenate([one.box_px for one in found]),
            score=np.concatenate([one.score for one in found]),
        )

    def _detect(self, images: Images) -> Detections:
        given = len(images)
        if given < AT_A_TIME:
            rest = np.zeros((AT_A_TIME - given, *images.shape[1:]), dtype=np.uint8)
            images = np.concatenate([images, rest])
        with torch.inference_mode():
            raw = self.network(as_input(images))
            score = raw[:, 0].sigmoid()
            peak = nn.functional.max_pool2d(score[:, None], 3, 1, 1)[:, 0]
            score = torch.where(score == peak, score, torch.zeros(()))
            best, place = score.flatten(1).topk(MOST, dim=1)
            boxes = decoded_boxes(raw[:, 1:]).flatten(1, 2)
            boxes = boxes.gather(1, place[..., None].expand(-1, -1, 4))
        box_px = boxes.numpy()[:given].astype(np.float64)
        box_px = box_px.clip(0.0, [WIDTH_PX, HEIGHT_PX, WIDTH_PX, HEIGHT_PX])
        best_score = best.numpy()[:given].astype(np.float64)
        best_score[best_score < LOWEST_SCORE] = 0.0
        return Detections(box_px, suppressed(box_px, best_score))


def suppressed(box_px: FloatArray, score: FloatArray) -> FloatArray:
    """Scores ``[N, D]`` that descend, 0 where a better box ``[N, D, 4]`` overlaps too much."""
    kept = score.copy()
    overlaps = iou(box_px, box_px)
    for place in range(1, score.shape[1]):
        worse = (overlaps[:, place, :place] > MOST_OVERLAP) & (kept[:, :place] > 0.0)
        kept[worse.any(axis=1), place] = 0.0
    return kept


def save_network(network: Network, path: Path, *, threshold: float) -> None:
    """Write weights and threshold of a network as it was trained.

    Raises:
        OSError: It cannot be written.
    """
    tensors = {name: one.contiguous() for name, one in network.state_dict().items()}
    save_file(tensors, path, metadata={"threshold": repr(threshold)})


def load_detector(path: Path) -> Detector:
    """A detector whose network :func:`save_network` wrote.

    Raises:
        OSError: There is none.
    """
    network = Network()
    network.load_state_dict(load_file(path))
    with safe_open(path, framework="pt") as opened:
        told: Any = opened.metadata()
    return Detector(ready(network), float(told["threshold"]))


def ready(network: Network) -> Network:
    """A network as it is fastest to ask: normalisations are folded into what is before them."""
    folded = deepcopy(network).eval()
    for layer in list(folded.modules()):
        if isinstance(layer, nn.Sequential) and isinstance(layer[0], nn.Conv2d):
            layer[0] = fuse_conv_bn_eval(layer[0], layer[1])  # pyright: ignore[reportArgumentType]
            layer[1] = nn.Identity()
    return folded.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
