"""Do detections belong to the frames whose labels they are matched with, or some frames off?

A detector whose output is one frame late still overlaps most labels: its misses look like those of
obstacles that move across the image. How well each frame's labels are overlapped by detections of
the frames around it tells.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.pem.data.kitti_labels import Box
from pemviz.pem.data.matching import iou

FARTHEST = 2
"""Frames by which detections are shifted either way."""
FEWEST_FRAMES = 30
BETTER = 1.02
"""Ratio of overlaps from which a shift is told of."""
STANDARD_ERRORS = 5.0
"""And by how many the overlap of a frame is larger: once in millions of data sets by chance."""


@dataclass
class ShiftTally:
    """Overlaps of labels with detections of frames around theirs.

    Attributes:
        overlaps: Of each frame the mean over its labels of the best overlap, by shift.
    """

    overlaps: list[FloatArray] = field(default_factory=list[FloatArray])

    def add(self, labels: Mapping[int, Sequence[Box]], found: Mapping[int, Sequence[Box]]) -> None:
        """Count a sequence: labels and detections by frame, frames counted alike.

        Frames at its ends, where a shift finds nothing, are left out.
        """
        if not labels:
            return
        boxes = {frame: np.asarray(each, dtype=np.float64) for frame, each in found.items()}
        first, last = min(labels) + FARTHEST, max(labels) - FARTHEST
        for frame, present in labels.items():
            if not first <= frame <= last or not present:
                continue
            truth = np.asarray(present, dtype=np.float64)
            around = [boxes.get(frame + by) for by in range(-FARTHEST, FARTHEST + 1)]
            self.overlaps.append(np.array([_mean_overlap(truth, near) for near in around]))

    def words(self) -> str:
        """What is to be known of it; empty if detections match their own frames best."""
        if len(self.overlaps) < FEWEST_FRAMES:
            return ""
        by_frame = np.stack(self.overlaps)
        mean = by_frame.mean(axis=0)
        best = int(mean.argmax())
        gain = by_frame[:, best] - by_frame[:, FARTHEST]
        error = float(gain.std(ddof=1)) / np.sqrt(len(gain))
        if mean[best] <= BETTER * mean[FARTHEST] or gain.mean() <= STANDARD_ERRORS * error:
            return ""
        by = best - FARTHEST
        frames = f"{abs(by)} frame{'s' * (abs(by) > 1)}"
        return (
            f"labels overlap the detections of {frames} {'later' if by > 0 else 'earlier'} better "
            f"({mean[best]:.3f} on average, {mean[FARTHEST]:.3f} as they stand): detections seem "
            f"{frames} {'late' if by > 0 else 'early'}; is a frame counted from 0 in one and from "
            "1 in the other, or is the detector slow?"
        )


def _mean_overlap(truth: FloatArray, near: FloatArray | None) -> float:
    """The mean over boxes ``[n, 4]`` of the best overlap with others ``[m, 4]``."""
    if near is None or not near.size:
        return 0.0
    return float(iou(truth, near).max(axis=1).mean())
