"""The observer that writes a run's recording while the run goes on."""

import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid, pem_curve
from pemviz.arrays import FloatArray
from pemviz.config import ExperimentConfig
from pemviz.recording import learning, paths, text, worst
from pemviz.recording.blueprint import blueprint, views_with_data
from pemviz.recording.chart import log_intervals
from pemviz.recording.compact import compact
from pemviz.recording.estimates import Answer, drawn_answer, drawn_repetitions, log_estimates
from pemviz.recording.film import import_filming, log_film
from pemviz.recording.latents import noise_title
from pemviz.recording.rollouts import log_rollouts
from pemviz.recording.scene import log_scene
from pemviz.recording.scene_layout import MOST_ROADS
from pemviz.recording.scene_plan import log_scene_plan
from pemviz.recording.selection import ROLLOUT_LIMIT, Quota, choose, quota, unvaried
from pemviz.recording.stream import RecordingFile
from pemviz.recording.views import ContainerSpec, Subject, all_views, without_signals
from pemviz.reports.charts import uncertainty_chart
from pemviz.runs.drawn_rollout import slots_of
from pemviz.runs.events import (
    Event,
    RepetitionDone,
    RunDone,
    RunFailed,
    RunStarted,
    StageDone,
)
from pemviz.runs.result import RunResult
from pemviz.runs.specification import named_signals
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.slots import Slot
from pemviz.types import StageResult

RECORDED_REPETITION = 0
REDRAW_GROWTH = 1.1
CURVE_STEP_M = 0.25
"""Of the curves against gap; finer ones would show the noise of averages over few states."""


@dataclass(frozen=True)
class _Run:
    """What is known from the start.

    Attributes:
        started: The event.
        views: What the recording will show.
        quota: How many rollouts are kept.
        gap_m: Grid of the curves against gap; ``None`` if the scenario has no gap.
        slots: The scenario's slots; none where perception answers one thing a step.
    """

    started: RunStarted
    views: ContainerSpec
    quota: Quota
    gap_m: FloatArray | None
    slots: tuple[Slot, ...] = ()


class Recorder:
    """Observer that writes ``run.rrd``.

    Text, curves and figures are flushed after each stage, so that a killed run's recording
    shows every finished stage. With several repetitions, rollouts, curves and stage figures
    are those of the first; estimates and the least robust rollouts are of all.

    Attributes:
        path: The recording.
    """

    def __init__(
        self,
        path: Path,
        *,
        frames: bool = False,
        live_port: int | None = None,
        rollout_limit: int = ROLLOUT_LIMIT,
        compacted: bool = False,
    ) -> None:
        """Prepare; nothing is written before the run starts.

        Args:
            path: Where to; overwritten if it exists.
            frames: Let highway-env draw the least robust rollout from above at the end; needs
                highway-env.
            live_port: Also serve the recording to live viewers on this port of the loopback
                interface.
            rollout_limit: Up to how many rollouts of a repetition are all recorded.
            compacted: Make the file smaller once the run is done.
        """
        self.path = path
        self._frames = frames
        self._live_port = live_port
        self._rollout_limit = rollout_limit
        self._compacted = compacted
        self._file: RecordingFile | None = None
        self._run: _Run | None = None
        self._figures: list[learning.StageFigures] = []
        self._tracks: tuple[worst.Track, ...] = ()
        self._drawn_repetitions = 0

    def notify(self, event: Event) -> None:
        """Write what ``event`` adds.

        Raises:
            RunError: The file cannot be opened.
        """
        if isinstance(event, RunStarted):
            self._start(event)
            return
        if self._file is None or self._run is None:
            return
        match event:
            case StageDone():
                self._add_stage(self._file, self._run, event)
            case RepetitionDone():
                self._add_repetition(self._file, event.result)
            case RunDone() | RunFailed():
                self._finish(self._file, self._run, event.result)
            case _:
                pass

    def _start(self, event: RunStarted) -> None:
        run = self._run = _prepare(
            event,
            rollout_limit=self._rollout_limit,
            frames=self._frames,
        )
        if self._frames:
            threading.Thread(
                target=_import_filming, args=(event.config,), name="pemviz-filming"
            ).start()
        config = event.config
        file = self._file = RecordingFile(
            self.path,
            name=event.result.run_id,
            layout=f"{config.method}_{event.stages}",
            live_port=self._live_port,
        )
        file.markdown(paths.CONFIG, text.config_document(event.result))
        file.markdown(
            paths.CONTENTS,
            text.contents_text(
                run.quota,
                repetitions=config.repetitions,
                slots=run.slots,
                has_scene=drawn_scene(event.simulator) is not None,
            ),
        )
        self._write_texts(file, event.result, running=True)
        if run.gap_m is not None:
            curve = pem_curve(simulator=event.simulator, pem=event.pem, gap_m=run.gap_m)
            learning.log_pem_curve(file, run.gap_m, curve)
        file.flush()

    def _add_stage(self, file: RecordingFile, run: _Run, event: StageDone) -> None:
        stage = event.stage
        before = self._tracks
        self._tracks = worst.update_tracks(
            before, stage, event.result, simulator=run.started.simulator
        )
        if stage.repetition != RECORDED_REPETITION:
            return
        if stage.stage == 0:  # only now is it known which signals nothing depends on
            run = self._run = _without_constants(run, stage)
            file.blueprint(blueprint(run.views))
        self._write_learning(file, run, stage)
        log_rollouts(
            file,
            stage,
            kept=choose(
                stage.scored.robustness,
                run.quota,
                even=None if stage.drawn is None else stage.drawn.even,
            ),
            signals=run.started.signals,
            slots=run.slots,
            dt_s=run.started.simulator.dt_s,
        )
        if self._tracks[:MOST_ROADS] != before[:MOST_ROADS]:
            self._write_scene(file, stage=stage.stage)
        self._write_texts(file, event.result, running=True)
        file.flush()

    def _write_learning(self, file: RecordingFile, run: _Run, stage: StageResult) -> None:
        config = run.started.config
        self._figures.append(learning.stage_figures(stage, method=config.method))
        unit = robustness_unit(config.metric)
        stages = run.started.stages
        learning.log_figures(file, self._figures, stages=stages, robustness_unit=unit)
        learning.log_robustness(file, stage, unit=unit)
        if learning.is_redrawn(stage.stage, stages=stages):
            self._write_stage_table(file, run)
            self._write_estimates(file, run, answer=None)
        if run.gap_m is None:
            return
        curves = detection_curves(
            simulator=run.started.simulator,
            pem=run.started.pem,
            proposal=stage.sampled_from,
            gap_m=run.gap_m,
            rollouts=stage.scored.rollouts,
        )
        learning.log_curves(file, curves, stage=stage.stage, stages=stages)

    def _write_estimates(self, file: RecordingFile, run: _Run, *, answer: Answer | None) -> None:
        """Estimates of all stages so far; no more than one needs no plot."""
        if run.started.stages > 1:
            drawn = [one for row in self._figures if (one := learning.drawn_stage(row))]
            log = partial(file.at_stage, stage=self._figures[-1].stage)
            log_estimates(log, paths.ESTIMATES, drawn, places=run.started.stages, answer=answer)

    def _write_stage_table(self, file: RecordingFile, run: _Run) -> None:
        unit = robustness_unit(run.started.config.metric)
        table = text.stage_table(self._figures, robustness_unit=unit)
        file.markdown(paths.STAGE_TABLE, table)

    def _add_repetition(self, file: RecordingFile, result: RunResult) -> None:
        # redrawn when a tenth has been added, so that the file grows with their number only
        count = len(result.repetitions)
        if count >= REDRAW_GROWTH * self._drawn_repetitions:
            self._write_repetitions(file, result)
            self._write_texts(file, result, running=True)
            file.flush()

    def _write_repetitions(self, file: RecordingFile, result: RunResult) -> None:
        self._drawn_repetitions = len(result.repetitions)
        if result.config.repetitions > 1:
            log_estimates(
                file.static,
                paths.REPETITIONS,
                drawn_repetitions(result.repetitions),
                places=len(result.repetitions),
                answer=drawn_answer(result.estimate),
            )

    def _write_texts(self, file: RecordingFile, result: RunResult, *, running: bool) -> None:
        file.markdown(paths.ANSWER, text.answer_text(result, running=running))
        chart = None if running else uncertainty_chart(result)
        if chart is not None:
            log_intervals(file.static, paths.UNCERTAINTY, chart)
        file.markdown(paths.WARNINGS, text.warnings_text(result))
        file.markdown(paths.PROVENANCE, text.provenance_text(result))
        if self._tracks:
            table = text.worst_table(self._tracks, result.least_robust_by_rule)
            file.markdown(paths.WORST_SUMMARY, table)

    def _finish(self, file: RecordingFile, run: _Run, result: RunResult) -> None:
        self._write_repetitions(file, result)
        self._write_texts(file, result, running=False)
        file.markdown(paths.RESULT, text.result_text(result))
        if self._figures:
            self._write_stage_table(file, run)
            self._write_estimates(file, run, answer=drawn_answer(result.estimate))
            self._write_worst(file, run)
        with_data = views_with_data(run.views, file.logged)
        if with_data != run.views or not self._figures:
            file.blueprint(blueprint(with_data))
        file.close()
        self._file = None
        if self._compacted:
            compact(self.path, blueprint=blueprint(with_data))

    def _write_worst(self, file: RecordingFile, run: _Run) -> None:
        dt_s = run.started.simulator.dt_s
        last = self._figures[-1].stage
        worst.log_worst_plots(
            file, self._tracks, signals=run.started.signals, stage=last, dt_s=dt_s
        )
        if run.started.config.repetitions > 1:
            self._write_scene(file, stage=last)
        if self._frames:
            config, simulator = run.started.config, run.started.simulator
            log_film(file, self._tracks[0], config=config, simulator=simulator, stage=last)

    def _write_scene(self, file: RecordingFile, *, stage: int) -> None:
        """The least robust rollouts on their road, as far as their scenario tells of one."""
        drawn = [track.drawn for track in self._tracks if track.drawn is not None]
        titles = [f"robustness {track.ranked.robustness:.3g}" for track in self._tracks]
        if drawn:
            log_scene(file, drawn, titles=titles, stage=stage)
            log_scene_plan(file, drawn, titles=titles, stage=stage)


def _prepare(event: RunStarted, *, rollout_limit: int, frames: bool) -> _Run:
    config = event.config
    names = {signal.name for signal in event.signals}
    slots, told = slots_of(event.simulator), drawn_scene(event.simulator)
    return _Run(
        started=event,
        views=all_views(
            Subject(
                method=config.method,
                stages=event.stages,
                repetitions=config.repetitions,
                signals=event.signals,
                robustness_unit=robustness_unit(config.metric),
                frames=frames,
                road=None if told is None else told.road,
                asked=named_signals(config, event.signals)[0],
                noise=noise_title(event.simulator),
            )
        ),
        quota=quota(
            rollouts=event.planned_rollouts // config.repetitions,
            stages=event.stages,
            limit=rollout_limit,
        ),
        gap_m=gap_grid(event.simulator, step_m=CURVE_STEP_M)
        if GAP in names and not slots
        else None,
        slots=slots,
    )


def _without_constants(run: _Run, stage: StageResult) -> _Run:
    """The run, its views without those of signals that are the same in every rollout."""
    same = unvaried(stage.scored.rollouts)
    keys = {signal.key for signal in run.started.signals if signal.name in same}
    return replace(run, views=without_signals(run.views, keys))


def _import_filming(config: ExperimentConfig) -> None:
    """Import what films the least robust rollout while the run goes on; it takes a second."""
    with suppress(ImportError):  # told when it is needed
        import_filming(config)


def robustness_unit(metric: str) -> str:
    """Unit of a metric's scores: metres, but agm is normalised."""
    return "" if metric == "agm" else "m"
