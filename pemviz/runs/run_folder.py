"""A run that is kept in a folder, readable after a kill at any moment, and resumed from there."""

import contextlib
import itertools
import logging
import math
import shutil
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from safetensors.numpy import save as save_tensors

from pemviz.arrays import AnyArray
from pemviz.config import LIMITS, WITHOUT_EFFECT, ExperimentConfig, KeepName
from pemviz.config.toml_files import config_text, load_config
from pemviz.errors import InputError
from pemviz.files.atomic import held, write_bytes, write_text
from pemviz.runs import events, rollout_files
from pemviz.runs.engine import run, versions
from pemviz.runs.events import Event, Observer
from pemviz.runs.experiment import Experiment
from pemviz.runs.own_code import own_system
from pemviz.runs.ranking import kept_rows
from pemviz.runs.reading import CONFIG, result_left, run_differs
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import RESULT_FILE, has_result, write_result
from pemviz.runs.rollout_files import PART_FOLDER, ROLLOUTS_FILE
from pemviz.sampling.problem import FinishedStage, rule_scores
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.losing import marked
from pemviz.types import LOST, Signal, StageResult

LOG = logging.getLogger(__name__)
LOCK, RECORDING, PROPOSALS = ".lock", "run.rrd", "proposals.safetensors"
KEPT_PARTS, FORMER = ".stages", "former.json"
"""Where the stages of a run lie that is done, and less precise than it was to be."""
ALWAYS_WRITTEN = 100
"""Stages after which ``result.json``, which lists each, is written whatever it takes."""
OTHER_CODE = "the simulator's source was changed while the run was interrupted"
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
    raise InputError(f"out = {parent}: a thousand runs named {stem} are there already")


class Archive:
    """Reads the stages' files that an interrupted run left in its folder, each when it is wanted.

    A damaged file counts as none: its stage is carried out again, to the same rollouts.

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
        path = rollout_files.part_path(self._folder, repetition=repetition, stage=stage)
        if not path.exists():
            return None
        try:
            finished = rollout_files.finished_stage(path, self._signals)
        except InputError as error:
            LOG.warning("%s; it is computed again", error)
            return None
        if finished is None:  # its other rollouts were not to be kept
            return None
        self.restored.add(key)
        self._last = key, finished
        return finished


class RunStore:
    """Observer that keeps a run folder up to date.

    After every stage, of very many now and then, ``result.json`` is rewritten, and the stage's
    rollouts, those that the configuration keeps, are in a file of their own; the end of the run
    joins these into ``rollouts.npz``. The stages' files of a run that was stopped or failed stay,
    so that it can be resumed, and those of one that is less precise than it was to be, so that it
    can go on with other limits. ``result.json`` has digests of the files that are whole.

    Attributes:
        folder: The run folder; it exists already.
    """

    def __init__(
        self,
        folder: Path,
        *,
        archive: Archive | None = None,
        others: Sequence[str] = (),
        keeps_stages: bool = False,
    ) -> None:
        """Nothing is written before the run starts.

        Args:
            folder: The run folder; it exists already.
            archive: What an earlier process left in it, which is not written again.
            others: Names of files of observers that are notified of the end before this one is;
                their digests are kept too.
            keeps_stages: Whether the stages' files stay once the run is done, be it short or not.
        """
        self.folder = folder
        self._archive = archive
        self._signals: tuple[Signal, ...] = ()
        self._keep: KeepName = "all"
        self._parts: list[Path] = []
        self._sampled: list[int] = []  # by each stage of the repetition at hand
        self._columns: list[Mapping[str, AnyArray]] = []
        self._others, self._keeps_stages = others, keeps_stages
        self._proposals: dict[str, AnyArray] = {}
        self._written, self._writing_s = -math.inf, 0.0

    def notify(self, event: Event) -> None:
        """Write what ``event`` adds."""
        match event:
            case events.RunStarted():
                self._signals, self._keep = event.signals, event.config.keep
                if not (self.folder / CONFIG).exists():  # of one that goes on, as it was begun
                    write_text(self.folder / CONFIG, config_text(event.config))
                if result_left(self.folder) is None:
                    write_result(self.folder, event.result, files=(CONFIG,))
            case events.StageDone():
                self._keep_stage(event.stage, event.result)
            case events.RepetitionDone():
                self._keep_columns(event.columns)
                if not self._is_behind():
                    write_result(self.folder, event.result, files=(CONFIG,))
            case events.RunDone() | events.RunFailed():
                self._end(event.result)
            case _:
                pass

    def _is_behind(self) -> bool:
        """Whether the folder holds finished stages that this process has not come to yet."""
        stages = () if self._archive is None else rollout_files.stage_files(self.folder)
        return len(stages) > len(self._parts)

    def _end(self, result: RunResult) -> None:
        if result.status != "done":
            if self._is_behind():  # what the folder says goes further
                return
            write_result(self.folder, result, files=(CONFIG,))
            with contextlib.suppress(OSError):  # a full disk: the stages' files have it all
                self._join()
            return
        self._join()
        write_result(self.folder, result, files=(CONFIG, ROLLOUTS_FILE, PROPOSALS, *self._others))
        (self.folder / FORMER).unlink(missing_ok=True)
        parts = self.folder / PART_FOLDER
        if parts.exists() and (self._keeps_stages or is_short(result)):
            parts.rename(self.folder / KEPT_PARTS)
        elif parts.exists():
            removed = parts.rename(self.folder / f".{PART_FOLDER}.removed")
            shutil.rmtree(removed, ignore_errors=True)

    def _keep_stage(self, stage: StageResult, result: RunResult) -> None:
        part = rollout_files.part_path(self.folder, repetition=stage.repetition, stage=stage.stage)
        self._parts.append(part)
        self._sampled.append(stage.count)
        if stage.learned is not None:
            prefix = f"repetition.{stage.repetition}.stage.{stage.stage}"
            for name, array in stage.learned.arrays().items():
                self._proposals[f"{prefix}.{name}"] = np.ascontiguousarray(array)
        if self._archive is not None and (stage.repetition, stage.stage) in self._archive.restored:
            return
        rows = kept_rows(stage, self._keep)
        arrays = rollout_files.part_arrays(stage, self._signals, rows=rows)
        rollout_files.write_part(part, arrays)
        if stage.learned is not None:
            self._write_proposals(durable=False)
        began = time.perf_counter()
        if stage.stage < ALWAYS_WRITTEN or began - self._written >= PAUSES * self._writing_s:
            write_result(self.folder, result, files=(CONFIG,))
            self._written = time.perf_counter()
            self._writing_s = self._written - began

    def _keep_columns(self, columns: Mapping[str, AnyArray]) -> None:
        """What the method keeps of a repetition's rollouts, stage by stage."""
        edges = np.cumsum([0, *self._sampled])
        for begin, end in itertools.pairwise(edges.tolist()):
            self._columns.append({name: each[begin:end] for name, each in columns.items()})
        self._sampled = []

    def _write_proposals(self, *, durable: bool) -> None:
        if self._proposals:
            content = save_tensors(self._proposals)
            write_bytes(self.folder / PROPOSALS, content, durable=durable)

    def _join(self) -> None:
        self._write_proposals(durable=True)
        if self._parts:
            whole = len(self._columns) == len(self._parts)
            columns = self._columns if whole else ()
            rollout_files.join_parts(self._parts, self.folder / ROLLOUTS_FILE, columns=columns)
            self._parts = []


@dataclass(frozen=True)
class _DoneLast:
    """Tells the folder first, but that the run is done last: a kill may come in between."""

    store: Observer
    recorders: Sequence[Observer]

    def notify(self, event: Event) -> None:
        done = isinstance(event, events.RunDone) and event.result.status == "done"
        events.notify_all(
            [*self.recorders, self.store] if done else [self.store, *self.recorders], event
        )


def record(
    experiment: Experiment,
    folder: Path | str,
    *,
    recorders: Sequence[Observer] = (),
    observers: Sequence[Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: bool = False,
) -> RunResult:
    """Run an experiment and keep it in ``folder``, or go on with what is there.

    Stages that an earlier process finished there are read back, not computed again; the end
    is the same, to the last bit but for timings.

    Args:
        experiment: What to run; for a folder with stages in it, the same again, which may have
            other limits.
        folder: The run folder, made where it is not there; its name is the run's.
        recorders: Write further files of the run; notified after the folder has each event, but
            for the end: a folder says that a run is done once they are whole.
        observers: Notified of everything that happens, after the folder has it.
        should_stop: Called several times a second; ends the run at its next step.
        workers: Who simulates; see :func:`pemviz.run`.
        scheduler: Likewise.
        progress: Likewise.

    Raises:
        ConfigError: Workers are of no use, or the cluster cannot be used; nothing was simulated.
        InputError: The folder cannot be made, another process is at work in it, or it was begun
            with other settings or another error model.
        RunError: The run failed; what was finished is in the folder.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"run {folder}: cannot be made ({error.strerror or error})") from error
    with run_lock(folder):
        left = check_resumable(experiment, folder)
        before_s = 0.0 if left is None else left.timings_s.get("total", 0.0)
        if left is not None:
            others = _of_other_code(experiment, left)
            experiment = replace(experiment, warnings=(*experiment.warnings, *others))
        goes_on = _let_go_on(folder, experiment.config)
        archive = Archive(folder, experiment.declared.signals)
        store = RunStore(folder, archive=archive, others=(RECORDING,), keeps_stages=goes_on)
        return run(
            going_on(experiment, archive),
            run_id=folder.resolve().name,
            observers=[_DoneLast(store, recorders), *observers],
            should_stop=should_stop,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
            before_s=before_s,
        )


def _of_other_code(experiment: Experiment, left: RunResult) -> Sequence[str]:
    """That stages which are read back were simulated by another source of the user's simulator."""
    told = [warning for warning in left.warnings if warning.startswith(OTHER_CODE)]
    before, now = left.simulator, own_system(experiment)
    if before is None or now is None or before.source_digest == now.source_digest:
        return told
    stages = "1 stage is" if len(left.stages) == 1 else f"{len(left.stages)} stages are"
    return [*told, f"{OTHER_CODE}: {stages} from before"] if left.stages else told


def going_on(experiment: Experiment, archive: Archive) -> Experiment:
    """The experiment with the stages that an archive has."""
    folding, problem = experiment.folding, experiment.problem
    finished = archive if folding is None else folding.finished(archive)

    def judged(repetition: int, stage: int) -> FinishedStage | None:
        """A finished stage with each rule's verdict, which follows from its rollouts."""
        found = finished(repetition, stage)
        if found is not None and problem.lost != "end" and LOST not in found.scored.rollouts.memory:
            scored = replace(found.scored, rollouts=marked(found.scored.rollouts))
            found = replace(found, scored=scored)
        if found is None or not problem.rules:
            return found
        by_rule = rule_scores(problem, found.scored.rollouts)
        return replace(found, scored=replace(found.scored, **by_rule))

    return replace(experiment, problem=replace(problem, finished=judged))


def is_short(result: RunResult) -> bool:
    """Whether an answer is less precise than it was to be, by a method that goes on until it is.

    Unless proposals' last stage came in parts, which are not learned from.
    """
    if by_name(result.config.method).most is None or result.estimate is None:
        return False
    last = sum(stage.kind == "final" for stage in result.stages)
    counts = by_name(result.estimate.method).interval_basis == "counts"
    if not counts and last > len(result.repetitions):
        return False
    answers = [result.estimate, *(rule.estimate for rule in result.rules if rule.estimate.failures)]
    return any(not each.relative_half_width <= result.config.precision for each in answers)


def may_go_on(folder: Path) -> bool:
    """Whether a run that is done has its stages still, and can go on with other limits."""
    return (folder / KEPT_PARTS).is_dir() or bool(rollout_files.stage_files(folder))


def _let_go_on(folder: Path, wanted: ExperimentConfig) -> bool:
    """Take over settings that a run may go on with others of: what loses it, and its limits.

    A kill in between leaves stages without a result, from which it goes on too.

    Returns:
        Whether the run was done.
    """
    path, kept, parts = folder / CONFIG, folder / KEPT_PARTS, folder / PART_FOLDER
    if kept.is_dir() and parts.exists():  # which are newer
        shutil.rmtree(kept)
    elif kept.is_dir():
        kept.rename(parts)
    if not path.exists():
        return False
    begun = load_config(path)
    chosen = {name: getattr(wanted, name) for name in LIMITS}
    if begun.lost == "end":
        chosen["lost"] = wanted.lost
    config = replace(begun, **chosen)
    if config == begun:
        return False
    result = result_left(folder)
    if result is not None and result.status == "done":
        (folder / RESULT_FILE).replace(folder / FORMER)
    for name in (RESULT_FILE, ROLLOUTS_FILE):
        (folder / name).unlink(missing_ok=True)
    write_text(path, config_text(config))
    if result is not None and result.status != "done":
        write_result(folder, replace(result, config=config), files=(CONFIG,))
        return False
    return result is not None


@contextlib.contextmanager
def run_lock(folder: Path) -> Generator[None, None, None]:
    """Hold the run folder; a process that dies gives it back.

    Raises:
        InputError: Another process holds it, or there is no such folder to write to.
    """
    with held(
        folder / LOCK,
        busy=f"run {folder}: another process is at work in it",
        unusable=f"run {folder}: cannot be written to",
    ):
        yield


def check_resumable(experiment: Experiment, folder: Path) -> RunResult | None:
    """Refuse to go on with other settings or another error model; warn of other versions.

    Returns:
        What the folder's run has come to; ``None``: nothing, or it cannot be read.

    Raises:
        InputError: The folder's run was begun with these.
    """
    result = result_left(folder)
    if result is None:
        if has_result(folder):
            LOG.warning(
                "run %s: result.json cannot be read; the run goes on from its stages, "
                "with the error model as it is now",
                folder,
            )
        return None
    config, errors = experiment.config, experiment.back_end.position_errors
    if result.status != "done" and result.config.lost == "end":  # none can be among the rollouts
        config = replace(config, lost="end")
    goes_on = result.status != "done" or may_go_on(folder)
    difference = run_differs(
        result,
        config=config,
        pem_digest=experiment.pem.digest,
        position_digest=None if errors is None else errors.digest,
        free=(*WITHOUT_EFFECT, *LIMITS) if goes_on else WITHOUT_EFFECT,
    )
    if difference is not None:
        raise InputError(f"run {folder}: was begun with {difference}; start a new run")
    if result.versions != versions():
        LOG.warning("run %s: was begun with other versions; last digits may differ", folder)
    return result
