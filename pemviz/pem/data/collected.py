"""What all collectors count, and how they write the tables that models learn from."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.atomic import write_text
from pemviz.files.text_files import writing
from pemviz.pem.data.kitti_labels import TYPES, Obstacle, OnBadLine

CLASS_ID = {name: index for index, name in enumerate(TYPES)}


@dataclass
class CollectedCounts:
    """What happened on the way, of every format."""

    missed: int = 0
    """Obstacles that the detector missed."""
    dropped: int = 0
    """Labels left out: what the options say, else class Misc or unknown occlusion."""
    bad_lines: int = 0
    """Malformed lines passed over."""
    first_bad: str = ""
    """What was wrong with the first of them."""

    def on_bad_line(self, *, skip_bad: bool) -> OnBadLine:
        """What a reader does with a malformed line: it is counted, or raised."""

        def told(error: PemError) -> None:
            if not skip_bad:
                raise error
            self.bad_lines += 1
            self.first_bad = self.first_bad or str(error)

        return told


@dataclass
class TrackCounts(CollectedCounts):
    """What happened on the way, where obstacles are followed."""

    sequences: int = 0
    """Sequences read."""
    tracks: int = 0
    """Obstacles that were followed."""
    observations: int = 0
    """Rows written: an obstacle in a frame."""
    gaps: int = 0
    """How often a track goes on after frames without a row; its dropped labels are such."""
    ignored_detections: int = 0
    """Detections of a lower score than asked for."""
    other_types: int = 0
    """Labels left out since they are of another class than asked for."""

    def add_sequence(self, rows: Sequence[tuple[int, int]], *, missed: int) -> None:
        """Count a sequence's rows, each a track and a frame, ascending."""
        self.sequences += 1
        self.tracks += len({track for track, _ in rows})
        self.observations += len(rows)
        self.missed += missed
        self.gaps += sum(
            here[0] == after[0] and after[1] > here[1] + 1 for here, after in pairwise(rows)
        )


def salient_cells(obstacle: Obstacle) -> tuple[str, ...]:
    """An obstacle's type, and its cells in the order of ``SALIENT_COLUMNS``."""
    values = (
        CLASS_ID[obstacle.type],
        obstacle.truncation,
        obstacle.occlusion,
        obstacle.alpha_rad,
        *obstacle.dimensions_m,
        *obstacle.location_m,
        obstacle.rotation_y_rad,
    )
    return (obstacle.type, *(f"{value:.10g}" for value in values))


def write_table(out: Path, header: Iterable[str], lines: Iterable[str]) -> None:
    """A CSV that is complete, or not there.

    Raises:
        PemError: It cannot be written.
    """
    with writing(out):
        write_text(out, "\n".join([",".join(header), *lines]) + "\n")
