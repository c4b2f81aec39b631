"""What an interrupted run left of its finished stages, for the run that goes on from there."""

import logging
from collections.abc import Sequence
from pathlib import Path

from pemviz.errors import InputError
from pemviz.runs.rollout_files import finished_stage, part_path
from pemviz.sampling.problem import FinishedStage
from pemviz.types import Signal

LOG = logging.getLogger(__name__)


class Archive:
    """Reads the stages' files of a run folder, each when it is asked for.

    A damaged file counts as none: its stage is carried out again, which gives the same
    rollouts, and the log says so.

    Attributes:
        restored: Repetition and stage of all that were found whole so far.
    """

    def __init__(self, folder: Path, signals: Sequence[Signal]) -> None:
        self._folder = folder
        self._signals = signals
        self._last: tuple[tuple[int, int], FinishedStage] | None = None
        self.restored: set[tuple[int, int]] = set()

    def __call__(self, repetition: int, stage: int) -> FinishedStage | None:
        """The stage as it was left, or ``None``."""
        key = repetition, stage
        if self._last is not None and self._last[0] == key:  # rollouts first, then what is kept
            return self._last[1]
        path = part_path(self._folder, repetition=repetition, stage=stage)
        if not path.exists():
            return None
        try:
            finished = finished_stage(path, self._signals)
        except InputError as error:
            LOG.warning("%s; it is computed again", error)
            return None
        if finished is None:  # its other rollouts were not to be kept
            return None
        self.restored.add(key)
        self._last = key, finished
        return finished
