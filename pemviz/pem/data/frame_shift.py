"""Do detections belong to the frames whose labels they are matched with, or some frames off?

A detector whose output is one frame late still overlaps most labels: its misses look like those of
obstacles that move across the image. How well each frame's labels are overlapped by detections of
the frames around it tells.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.matching import iou
from pemviz.pem.data.kitti_labels import Box

Rows = Sequence[Box] | FloatArray
"""Boxes in an image, or places."""
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
        overlap: Of rows ``[n, D]`` with others ``[m, D]``, from 0 to 1, ``[n, m]``.
        overlaps: Of each frame the best overlaps of its labels, by shift ``[labels, shifts]``.
    """

    overlap: Callable[[FloatArray, FloatArray], FloatArray] = iou
    overlaps: list[FloatArray] = field(default_factory=list[FloatArray])

    def add(self, labels: Mapping[int, Rows], found: Mapping[int, Rows]) -> None:
        """Count a sequence: labels and detections by frame, frames counted alike.

        Frames at its ends, where a shift finds nothing, are left out.
        """
        if not labels:
            return
        boxes = {frame: np.asarray(each, dtype=np.float64) for frame, each in found.items()}
        first, last = min(labels) + FARTHEST, max(labels) - FARTHEST
        for frame, present in labels.items():
            if not first <= frame <= last or not len(present):
                continue
            truth = np.asarray(present, dtype=np.float64)
            around = [boxes.get(frame + by) for by in range(-FARTHEST, FARTHEST + 1)]
            self.overlaps.append(np.stack([self._best(truth, near) for near in around], axis=1))

    def _best(self, truth: FloatArray, near: FloatArray | None) -> FloatArray:
        if near is None or not near.size:
            return np.zeros(len(truth))
        return self.overlap(truth, near).max(axis=1)

    def words(self) -> str:
        """What is to be known of it; empty if detections match their own frames best.

        Compared are labels that are overlapped both ways, so that misses do not count; frames are
        what is independent.
        """
        if len(self.overlaps) < FEWEST_FRAMES:
            return ""
        best = int(np.concatenate(self.overlaps).mean(axis=0).argmax())
        pairs = (each[:, [best, FARTHEST]] for each in self.overlaps)
        both = [pair[pair.all(axis=1)] for pair in pairs]
        means = np.array([pair.mean(axis=0) for pair in both if len(pair)])
        if best == FARTHEST or len(means) < FEWEST_FRAMES:
            return ""
        shifted, own = means.mean(axis=0)
        gain = means[:, 0] - means[:, 1]
        error = float(gain.std(ddof=1)) / np.sqrt(len(gain))
        if shifted <= BETTER * own or gain.mean() <= STANDARD_ERRORS * error:
            return ""
        by = best - FARTHEST
        frames = f"{abs(by)} frame{'s' * (abs(by) > 1)}"
        return (
            f"labels overlap the detections of {frames} {'later' if by > 0 else 'earlier'} better "
            f"({shifted:.3f} on average, {own:.3f} as they stand): detections seem "
            f"{frames} {'late' if by > 0 else 'early'}; is a frame counted from 0 in one and from "
            "1 in the other, or is the detector slow?"
        )
