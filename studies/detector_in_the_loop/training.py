"""Training of the detector, and how good it is: precision and recall on scenes of its own."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from pemviz.arrays import BoolArray, FloatArray
from pemviz.matching import iou
from studies.detector_in_the_loop.camera import WIDTH_PX
from studies.detector_in_the_loop.detector import (
    COLUMNS,
    ROWS,
    Detections,
    Detector,
    Network,
    as_input,
    centres_px,
    decoded_boxes,
    ready,
)
from studies.detector_in_the_loop.drives import FRAMES, Labels, draw_drive
from studies.detector_in_the_loop.render import Images, render
from studies.detector_in_the_loop.scene import DOMAINS

LOG = logging.getLogger(__name__)
MIDDLE = 0.30
"""Cells within that share of a box from its middle, on either side, stand for the car."""
LEARNING_RATE = 2e-3
BATCH = 64
FEWEST_PX = 3.0
"""Narrower cars are not learned, and count neither as found nor as missed in the curve."""
PER_SEQUENCE = 4
IOU_ABOVE = 0.3


@dataclass(frozen=True)
class Pictures:
    """Labelled images ``[N, ...]``."""

    images: Images
    box_px: FloatArray
    visible: BoolArray


@dataclass(frozen=True)
class Quality:
    """How good a detector is over thresholds ``[S]``, descending.

    Attributes:
        threshold: On the score.
        precision: Detections that belong to a car.
        recall: Cars that are detected.
    """

    threshold: FloatArray
    precision: FloatArray
    recall: FloatArray

    @property
    def average_precision(self) -> float:
        """Area under the curve, precision being made monotone as in PASCAL VOC from 2010 on."""
        best = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float((np.diff(np.concatenate([[0.0], self.recall])) * best).sum())

    def best_f1(self) -> float:
        """The threshold at which 2 P R / (P + R) is greatest."""
        f1 = 2.0 * self.precision * self.recall / (self.precision + self.recall).clip(1e-9)
        return float(self.threshold[int(f1.argmax())])

    def at(self, threshold: float) -> tuple[float, float]:
        """Precision and recall at a threshold."""
        place = int(np.searchsorted(-self.threshold, -threshold, side="right")) - 1
        return float(self.precision[place]), float(self.recall[place])


def draw_pictures(*, count: int, seeds: np.random.SeedSequence) -> Pictures:
    """Images of all domains alike, :data:`PER_SEQUENCE` of each sequence."""
    each = -(-count // (PER_SEQUENCE * len(DOMAINS)))
    parts: list[tuple[Images, Labels]] = []
    for domain, own in zip(DOMAINS.values(), seeds.spawn(len(DOMAINS)), strict=True):
        drive = draw_drive(domain, count=each, seeds=own)
        sequence = np.repeat(np.arange(each), PER_SEQUENCE)
        step = np.tile(np.arange(PER_SEQUENCE) * (FRAMES // PER_SEQUENCE), each)
        parts.append((render(*drive.at(sequence, step)), drive.labels(sequence, step)))
    return Pictures(
        images=np.concatenate([images for images, _ in parts]),
        box_px=np.concatenate([labels.box_px for _, labels in parts]),
        visible=np.concatenate([labels.visible for _, labels in parts]),
    )


def targets(box_px: FloatArray, visible: BoolArray) -> tuple[Tensor, Tensor, Tensor]:
    """What the network should say: score and boxes of cells, and where nothing is asked of it.

    Args:
        box_px: ``[N, K, 4]``.
        visible: ``[N, K]``.

    Returns:
        Score ``[N, 16, 40]``, box ``[N, 16, 40, 4]``, and whether a cell counts ``[N, 16, 40]``.
    """
    u, v = (axis.numpy() for axis in centres_px())
    count = len(box_px)
    score, counts = np.zeros((count, ROWS, COLUMNS)), np.ones((count, ROWS, COLUMNS))
    boxes = np.zeros((count, ROWS, COLUMNS, 4))
    # the nearest car, which has the lowest bottom, is last and stays
    order = np.argsort(np.where(visible, box_px[..., 3], -1.0), axis=1)
    for place in order.T:
        rows = np.arange(count)
        box, seen = box_px[rows, place], visible[rows, place]
        wide, tall = box[:, 2] - box[:, 0], box[:, 3] - box[:, 1]
        middle_u, middle_v = box[:, 0] + wide / 2, box[:, 1] + tall / 2
        near_u = np.abs(u - middle_u[:, None]) <= np.maximum(MIDDLE * wide, 2.0)[:, None]
        near_v = np.abs(v - middle_v[:, None]) <= np.maximum(MIDDLE * tall, 2.0)[:, None]
        cells = near_v[:, :, None] & near_u[:, None, :] & seen[:, None, None]
        small = (wide < FEWEST_PX)[:, None, None]
        score[cells & ~small], counts[cells & ~small] = 1.0, 1.0
        boxes = np.where(cells[..., None], box[:, None, None, :], boxes)
        score[cells & small], counts[cells & small] = 0.0, 0.0
    tensors = (torch.from_numpy(each).float() for each in (score, boxes, counts))
    first, second, third = tensors
    return first, second, third


def loss_of(raw: Tensor, score: Tensor, boxes: Tensor, counts: Tensor) -> Tensor:
    """Focal loss (Lin et al. 2017) of scores, and 1 - IoU of boxes where a car is."""
    logit = raw[:, 0]
    p = logit.sigmoid()
    wrong = torch.where(score > 0.5, 1.0 - p, p)
    weight = torch.where(score > 0.5, 0.5, 0.5) * wrong**2
    bce = nn.functional.binary_cross_entropy_with_logits(logit, score, reduction="none")
    cars = score.sum().clamp(min=1.0)
    focal = (weight * bce * counts).sum() / cars
    found = decoded_boxes(raw[:, 1:])[score > 0.5]
    true = boxes[score > 0.5]
    low, high = torch.maximum(found[:, :2], true[:, :2]), torch.minimum(found[:, 2:], true[:, 2:])
    both = (high - low).clamp(min=0.0).prod(dim=1)
    areas = [(one[:, 2:] - one[:, :2]).prod(dim=1) for one in (found, true)]
    iou = both / (areas[0] + areas[1] - both).clamp(min=1e-6)
    return focal + (1.0 - iou).sum() / cars


def train(
    *,
    pictures: int,
    epochs: int,
    seeds: np.random.SeedSequence,
    on_epoch: Callable[[int, float], None] | None = None,
) -> Network:
    """A network trained on so many images, each flipped in half of the epochs."""
    image_seeds, order_seeds, torch_seeds = seeds.spawn(3)
    drawn = draw_pictures(count=pictures, seeds=image_seeds)
    random = np.random.default_rng(order_seeds)
    torch.manual_seed(int(torch_seeds.generate_state(1)[0]))
    network = Network()
    optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=1e-4)
    steps = epochs * (len(drawn.images) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE * 2, steps)
    for epoch in range(epochs):
        order, total = random.permutation(len(drawn.images)), 0.0
        for start in range(0, len(order) - BATCH + 1, BATCH):
            rows = order[start : start + BATCH]
            images, box_px = flipped(
                drawn.images[rows], drawn.box_px[rows], random.random(BATCH) < 0.5
            )
            asked = targets(box_px, drawn.visible[rows])
            loss = loss_of(network(as_input(images)), *asked)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item()
        if on_epoch is not None:
            on_epoch(epoch + 1, total / (len(order) // BATCH))
    return network.eval()


def flipped(images: Images, box_px: FloatArray, which: BoolArray) -> tuple[Images, FloatArray]:
    """Some images ``[N]`` and their boxes with left and right exchanged."""
    images, box_px = images.copy(), box_px.copy()
    images[which] = images[which][:, :, ::-1]
    box_px[which] = np.stack(
        [
            WIDTH_PX - box_px[which][..., 2],
            box_px[which][..., 1],
            WIDTH_PX - box_px[which][..., 0],
            box_px[which][..., 3],
        ],
        axis=-1,
    )
    return images, box_px


def quality_of(network: Network, drawn: Pictures) -> Quality:
    """Precision and recall; the better of several detections of a car counts, the others do not.

    Detections of cars narrower than :data:`FEWEST_PX` count neither way.
    """
    found = Detector(ready(network), 0.0).detect(drawn.images)
    return curve(found, drawn.box_px, drawn.visible)


def curve(found: Detections, box_px: FloatArray, visible: BoolArray) -> Quality:
    """Precision and recall over all thresholds."""
    overlaps = iou(found.box_px, box_px) * visible[:, None, :]
    wide = (box_px[..., 2] - box_px[..., 0] >= FEWEST_PX) & visible
    taken = np.zeros(visible.shape, dtype=np.bool_)
    scores: list[FloatArray] = []
    right: list[BoolArray] = []
    rows = np.arange(len(box_px))
    for place in range(found.score.shape[1]):  # the best first, as they come
        own = np.where(taken, 0.0, overlaps[:, place])
        car, hit = own.argmax(axis=1), own.max(axis=1) > IOU_ABOVE
        hit &= found.score[:, place] > 0.0
        taken[rows[hit], car[hit]] = True
        counts = (found.score[:, place] > 0.0) & (~hit | wide[rows, car])
        scores.append(found.score[counts, place])
        right.append(hit[counts])
    score, hits = np.concatenate(scores), np.concatenate(right)
    order = np.argsort(-score, kind="stable")
    true = np.cumsum(hits[order])
    return Quality(
        threshold=score[order],
        precision=true / np.arange(1, score.size + 1),
        recall=true / max(int(wide.sum()), 1),
    )
