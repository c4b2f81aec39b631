"""The run folder: what a run leaves on disk, readable after a kill at any moment."""

import contextlib
import itertools
import math
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors.numpy import save as save_tensors

from pemviz.arrays import AnyArray
from pemviz.config import KeepName
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.files.atomic import write_bytes, write_text
from pemviz.runs.events import Event, RepetitionDone, RunDone, RunFailed, RunStarted, StageDone
from pemviz.runs.finished_stages import Archive
from pemviz.runs.kept_rollouts import kept_rows
from pemviz.runs.reading import result_left
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import write_result
from pemviz.runs.rollout_files import (
    PART_FOLDER,
    join_parts,
    part_arrays,
    part_path,
    stage_files,
    write_part,
)
from pemviz.types import Signal, StageResult

CONFIG, ROLLOUTS, PROPOSALS = "config.toml", "rollouts.npz", "proposals.safetensors"
ALWAYS_WRITTEN = 100
"""Stages after which ``result.json``, which tells of each, is written whatever it takes."""
PAUSES = 20
"""Later on it is written once this many times as long has passed as writing it took."""


def create_run_folder(parent: Path, *, label: str) -> Path:
    """A new folder ``<parent>/<time>-<label>``, numbered if that is taken.

    Raises:
        InputError: It cannot be created.
    """
    stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{label}"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for attempt in range(1, 1000):
            folder = parent / (stem if attempt == 1 else f"{stem}-{attempt}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        message = f"out = {parent}: no run folder can be made there ({error.strerror or error})"
        raise InputError(message) from error
    message = f"out = {parent}: a thousand runs named {stem} are there already"
    raise InputError(message)


class RunStore:
    """Observer that keeps a run folder up to date.

    After every stage, of very many now and then, ``result.json`` is rewritten, and the stage's
    rollouts, those that the configuration keeps, are in a file of their own; the end of the run
    joins these into ``rollouts.npz``. The stages' files of a run that was stopped or failed stay,
    so that it can be resumed. ``result.json`` has digests of the files that are whole.

    Attributes:
        folder: The run folder; it exists already.
    """

    def __init__(
        self, folder: Path, *, archive: Archive | None = None, others: Sequence[str] = ()
    ) -> None:
        """Prepare; nothing is written before the run starts.

        Args:
            folder: The run folder; it exists already.
            archive: What an earlier process left in it, which is not written again.
            others: Names of files that other observers write, which are told that the run is done
                before this one is; their digests are kept too.
        """
        self.folder = folder
        self._archive = archive
        self._signals: tuple[Signal, ...] = ()
        self._keep: KeepName = "all"
        self._parts: list[Path] = []
        self._drawn: list[int] = []  # by each stage of the repetition at hand
        self._columns: list[Mapping[str, AnyArray]] = []
        self._others = others
        self._proposals: dict[str, AnyArray] = {}
        self._written, self._writing_s = -math.inf, 0.0

    def notify(self, event: Event) -> None:
        """Write what ``event`` adds.

        Raises:
            OSError: The disk is full or the folder is gone.
        """
        match event:
            case RunStarted():
                self._signals, self._keep = event.signals, event.config.keep
                write_text(self.folder / CONFIG, config_text(event.config))
                if result_left(self.folder) is None:
                    write_result(self.folder, event.result, files=(CONFIG,))
            case StageDone():
                self._keep_stage(event.stage, event.result)
            case RepetitionDone():
                self._keep_columns(event.columns)
                if not self._is_behind():
                    write_result(self.folder, event.result, files=(CONFIG,))
            case RunDone() | RunFailed():
                self._end(event.result)
            case _:
                pass

    def _is_behind(self) -> bool:
        """Whether the folder holds finished stages that this process has not come to yet."""
        if self._archive is None:
            return False
        return len(stage_files(self.folder)) > len(self._parts)

    def _end(self, result: RunResult) -> None:
        if result.status != "done":
            if self._is_behind():  # what the folder says goes further
                return
            write_result(self.folder, result, files=(CONFIG,))
            with contextlib.suppress(OSError):  # a full disk: the stages' files have it all
                self._join()
            return
        self._join()
        write_result(self.folder, result, files=(CONFIG, ROLLOUTS, PROPOSALS, *self._others))
        parts = self.folder / PART_FOLDER
        if parts.exists():
            removed = parts.rename(self.folder / f".{PART_FOLDER}.removed")
            shutil.rmtree(removed, ignore_errors=True)

    def _keep_stage(self, stage: StageResult, result: RunResult) -> None:
        part = part_path(self.folder, repetition=stage.repetition, stage=stage.stage)
        self._parts.append(part)
        self._drawn.append(stage.count)
        if stage.learned is not None:
            prefix = f"repetition.{stage.repetition}.stage.{stage.stage}"
            for name, array in stage.learned.arrays().items():
                self._proposals[f"{prefix}.{name}"] = np.ascontiguousarray(array)
        if self._archive is not None and (stage.repetition, stage.stage) in self._archive.restored:
            return
        write_part(part, part_arrays(stage, self._signals, rows=kept_rows(stage, self._keep)))
        if stage.learned is not None:
            self._write_proposals(durable=False)
        began = time.perf_counter()
        if stage.stage < ALWAYS_WRITTEN or began - self._written >= PAUSES * self._writing_s:
            write_result(self.folder, result, files=(CONFIG,))
            self._written = time.perf_counter()
            self._writing_s = self._written - began

    def _keep_columns(self, columns: Mapping[str, AnyArray]) -> None:
        """What the method keeps of a repetition's rollouts, stage by stage."""
        edges = np.cumsum([0, *self._drawn])
        for begin, end in itertools.pairwise(edges.tolist()):
            self._columns.append({name: each[begin:end] for name, each in columns.items()})
        self._drawn = []

    def _write_proposals(self, *, durable: bool) -> None:
        if self._proposals:
            content = save_tensors(self._proposals)
            write_bytes(self.folder / PROPOSALS, content, durable=durable)

    def _join(self) -> None:
        self._write_proposals(durable=True)
        if self._parts:
            whole = len(self._columns) == len(self._parts)
            columns = self._columns if whole else ()
            join_parts(self._parts, self.folder / ROLLOUTS, columns=columns)
            self._parts = []
