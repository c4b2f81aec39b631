"""The observer that writes a run's recording while the run goes on."""

import contextlib
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid, pem_curve
from pemviz.config import ExperimentConfig
from pemviz.errors import RunError
from pemviz.recording import learning, paths, text, worst
from pemviz.recording.film import film_title, import_filming, log_film
from pemviz.recording.plot import log_intervals
from pemviz.recording.rollouts import ROLLOUT_LIMIT, choose, log_rollouts, quota, unvaried
from pemviz.recording.scene import MOST_ROADS, OnRoad, log_scene, on_roads, roads_shown
from pemviz.recording.scene_plan import log_scene_plan
from pemviz.recording.stream import RecordingFile, compact
from pemviz.recording.views import (
    FROM_ABOVE,
    Subject,
    all_views,
    blueprint,
    views_with_data,
    without_signals,
)
from pemviz.reports.charts import uncertainty_chart
from pemviz.runs.drawn_rollout import WHOLE, slots_of
from pemviz.runs.events import Event, RepetitionDone, RunDone, RunFailed, RunStarted, StageDone
from pemviz.runs.result import RunResult
from pemviz.runs.specification import named_signals, robustness_unit
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.types import StageResult

RECORDED_REPETITION = 0
REDRAW_GROWTH = 1.1
CURVE_STEP_M = 0.25
"""Of the curves against gap; finer ones would show the noise of averages over few states."""


class Recorder:
    """Observer that writes ``run.rrd``.

    Text, curves and figures are flushed after each stage, so that a killed run's recording
    shows every finished stage. With several repetitions, rollouts, curves and stage figures
    are those of the first; estimates and the least robust rollouts are of all.
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
            frames: At the end have highway-env draw the least robust rollout from above, or the
                user's own system if it can (:class:`pemviz.simulators.scene.FilmsRollouts`).
            live_port: Also serve it to live viewers on this port of the loopback interface.
            rollout_limit: Up to how many rollouts of a repetition are all recorded.
            compacted: Make the file smaller once the run is done.
        """
        self.path = path
        self._frames = frames
        self._live_port = live_port
        self._rollout_limit = rollout_limit
        self._compacted = compacted
        self._writing: _Writing | None = None

    def notify(self, event: Event) -> None:
        """Write what ``event`` adds.

        Raises:
            RunError: The file cannot be opened.
        """
        if isinstance(event, RunStarted):
            file = RecordingFile(
                self.path,
                name=event.result.run_id,
                layout=f"{event.config.method}_{event.stages}",
                live_port=self._live_port,
            )
            try:
                self._writing = _Writing(file, event, self._rollout_limit, frames=self._frames)
            except BaseException:
                with contextlib.suppress(RunError):
                    file.close()
                raise
            return
        if self._writing is None:
            return
        match event:
            case StageDone():
                self._writing.add_stage(event)
            case RepetitionDone():
                self._writing.add_repetition(event.result)
            case RunDone() | RunFailed():
                self._writing.finish(event.result)
                views, self._writing = self._writing.views, None
                if self._compacted:
                    compact(self.path, blueprint=blueprint(views))
            case _:
                pass


class _Writing:
    """The recording of one run, and the views that it shows."""

    def __init__(
        self, file: RecordingFile, started: RunStarted, rollout_limit: int, *, frames: bool
    ) -> None:
        config, simulator = started.config, started.simulator
        self._file, self._started = file, started
        self._is_own = started.result.simulator is not None
        title = film_title(config, simulator, is_own=self._is_own) if frames else None
        self._is_filmed = title is not None
        self._figures: list[learning.StageFigures] = []
        self._tracks: tuple[worst.Track, ...] = ()
        self._drawn_repetitions = 0
        named = named_signals(config, started.signals)
        self._robustness_unit = robustness_unit(config, started.signals)
        self._slots, scene = slots_of(simulator), drawn_scene(simulator)
        self._per_stage = quota(
            rollouts=started.planned_rollouts // config.repetitions,
            stages=started.stages,
            limit=rollout_limit,
        )
        self.views = all_views(
            Subject(
                stages=started.stages,
                repetitions=config.repetitions,
                signals=started.signals,
                robustness_unit=self._robustness_unit,
                film=title or "",
                road=None if scene is None else scene.road,
                signal=named[0],
                noise=worst.noise_title(simulator),
                rows=self._row_names(),
            )
        )
        if self._is_filmed and not self._is_own:
            imported = threading.Thread(target=_import, args=(config,), name="pemviz-filming")
            imported.start()
        file.markdown(paths.CONFIG, text.config_document(started.result))
        contents = text.contents_text(
            self._per_stage,
            repetitions=config.repetitions,
            slots=self._slots,
            has_scene=scene is not None,
        )
        file.markdown(paths.CONTENTS, contents)
        self._write_texts(started.result, running=True)
        # first of all, so that a viewer that still reads shows no layout of its own
        file.blueprint(blueprint(views_with_data(self.views, file.logged)))
        self._gap_m = None
        if GAP in {signal.name for signal in started.signals} and not self._slots:
            self._gap_m = gap_grid(simulator, step_m=CURVE_STEP_M)
            curve = pem_curve(simulator=simulator, pem=started.pem, gap_m=self._gap_m)
            learning.log_pem_curve(file, self._gap_m, curve)
        file.flush()

    def _row_names(self) -> tuple[str, ...]:
        several = len(self._slots) > 1
        return tuple(
            worst.row_name(1, slot.name if several else "") for slot in self._slots or [WHOLE]
        )

    def add_stage(self, event: StageDone) -> None:
        """All of a stage of the first repetition; of others, who is among the least robust."""
        stage, before, started = event.stage, self._tracks, self._started
        self._tracks = worst.update_tracks(before, stage, event.result, simulator=started.simulator)
        if stage.repetition != RECORDED_REPETITION:
            return
        if stage.stage == 0:  # only now is it known which signals nothing depends on
            same = unvaried(stage.scored.rollouts)
            keys = {signal.key for signal in started.signals if signal.name in same}
            self.views = without_signals(self.views, keys)
            self._file.blueprint(blueprint(self.views))
        self._write_learning(stage)
        even = None if stage.sampled is None else stage.sampled.even
        log_rollouts(
            self._file,
            stage,
            kept=choose(stage.scored.robustness, self._per_stage, even=even),
            signals=started.signals,
            slots=self._slots,
            dt_s=started.simulator.dt_s,
        )
        if self._tracks[:MOST_ROADS] != before[:MOST_ROADS]:
            self._write_scene(stage=stage.stage)
        self._write_texts(event.result, running=True)
        self._file.flush()

    def add_repetition(self, result: RunResult) -> None:
        """Redrawn when a tenth has been added, so that the file grows with their number only."""
        if len(result.repetitions) >= REDRAW_GROWTH * self._drawn_repetitions:
            self._write_repetitions(result)
            self._write_texts(result, running=True)
            self._file.flush()

    def finish(self, result: RunResult) -> None:
        """What is known at the end, and only the views that have something to show."""
        self._write_repetitions(result)
        self._write_texts(result, running=False)
        self._file.markdown(paths.RESULT, text.result_text(result))
        if self._figures:
            self._write_stages(answer=learning.drawn_estimate(result.estimate))
            self._write_worst()
        with_data = views_with_data(self.views, self._file.logged)
        if with_data != self.views or not self._figures:
            self._file.blueprint(blueprint(with_data))
        self.views = with_data
        self._file.close()

    def _write_learning(self, stage: StageResult) -> None:
        started, unit = self._started, self._robustness_unit
        self._figures.append(learning.stage_figures(stage, method=started.config.method))
        stages = started.stages
        learning.log_figures(self._file, self._figures, stages=stages, robustness_unit=unit)
        learning.log_robustness(self._file, stage, unit=unit)
        if learning.is_redrawn(stage.stage, stages=stages):
            self._write_stages(answer=None)
        if self._gap_m is not None:
            curves = detection_curves(
                simulator=started.simulator,
                pem=started.pem,
                proposal=stage.sampled_from,
                gap_m=self._gap_m,
                rollouts=stage.scored.rollouts,
            )
            learning.log_curves(self._file, curves, stage=stage.stage, stages=stages)

    def _write_stages(self, *, answer: learning.Drawn | None) -> None:
        """Table and estimates of all stages so far; no more than one needs no plot."""
        table = text.stage_table(self._figures, robustness_unit=self._robustness_unit)
        self._file.markdown(paths.STAGE_TABLE, table)
        if self._started.stages > 1:
            log = partial(self._file.at_stage, stage=self._figures[-1].stage)
            drawn, places = learning.drawn_stages(self._figures), self._started.stages
            learning.log_estimates(log, paths.ESTIMATES, drawn, places=places, answer=answer)

    def _write_repetitions(self, result: RunResult) -> None:
        self._drawn_repetitions = len(result.repetitions)
        if result.config.repetitions > 1:
            drawn = map(learning.drawn_estimate, result.repetitions)
            learning.log_estimates(
                self._file.static,
                paths.REPETITIONS,
                {place: one for place, one in enumerate(drawn) if one is not None},
                places=len(result.repetitions),
                answer=learning.drawn_estimate(result.estimate),
            )

    def _write_texts(self, result: RunResult, *, running: bool) -> None:
        file = self._file
        file.markdown(paths.STRIP, text.strip_text(result, running=running))
        file.markdown(paths.ANSWER, text.answer_text(result, running=running))
        chart = None if running else uncertainty_chart(result)
        if chart is not None:
            log_intervals(file.static, paths.UNCERTAINTY, chart)
        file.markdown(paths.WARNINGS, text.warnings_text(result))
        file.markdown(paths.PROVENANCE, text.provenance_text(result))
        if self._tracks:
            by_rule, unit = result.least_robust_by_rule, self._robustness_unit
            table = text.worst_table(self._tracks, by_rule, robustness_unit=unit)
            file.markdown(paths.WORST_SUMMARY, table)

    def _write_worst(self) -> None:
        started, last = self._started, self._figures[-1].stage
        config, simulator = started.config, started.simulator
        worst.log_worst_plots(
            self._file, self._tracks, signals=started.signals, stage=last, dt_s=simulator.dt_s
        )
        if config.repetitions > 1:
            self._write_scene(stage=last)
        for one in self._on_roads(last)[
            1:FROM_ABOVE
        ]:  # now that the ranking does not change any more
            log_scene_plan(one)
        if self._is_filmed:
            log_film(
                self._file,
                self._tracks[0],
                config=config,
                simulator=simulator,
                stage=last,
                is_own=self._is_own,
            )

    def _write_scene(self, *, stage: int) -> None:
        """The least robust rollouts on their roads, and the first of them from above."""
        ranked = self._on_roads(stage)
        if ranked:
            log_scene(self._file, ranked[: roads_shown(ranked[0].drawn.road)])
            log_scene_plan(ranked[0])

    def _on_roads(self, stage: int) -> list[OnRoad]:
        """The least robust rollouts, as far as their scenario tells where cars are."""
        unit = f" {self._robustness_unit}" if self._robustness_unit else ""
        drawn = [
            (track.drawn, f"robustness {track.ranked.robustness:.3g}{unit}")
            for track in self._tracks
            if track.drawn is not None
        ]
        return on_roads(self._file, drawn, stage=stage)


def _import(config: ExperimentConfig) -> None:
    """What films the least robust rollout, while the run goes on; it takes a second."""
    with suppress(ImportError):  # told when it is needed
        import_filming(config)
