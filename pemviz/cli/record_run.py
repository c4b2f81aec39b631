"""What ``pemviz record`` does once its arguments are read."""

import json
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.record_arguments import RecordArguments
from pemviz.config import LIMITS
from pemviz.config.rule_words import GateLimits
from pemviz.errors import EXIT_DONE, EXIT_FAILED, ConfigError, RunError
from pemviz.processes import ending_told
from pemviz.reports.gate import decide_limits
from pemviz.reports.pipeline import ReportWriter
from pemviz.reports.terminal import print_summary
from pemviz.runs.events import Event, Observer, RunDone, RunFailed
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.progress import progress_observer
from pemviz.runs.reading import CONFIG, result_left
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import result_document
from pemviz.runs.run_folder import FORMER, create_run_folder, is_short, may_go_on
from pemviz.runs.run_folder import record as record_in
from pemviz.runs.workers import check_workers, no_use, own_process
from pemviz.sampling.registry import by_name


def record(arguments: RecordArguments) -> int:
    """Run what the arguments ask for and return the exit code.

    Raises:
        InputError: What they name does not fit together; nothing was simulated or written.
        RunError: The run failed.
    """
    reports = ReportWriter(
        summary=arguments.summary, junit=arguments.junit, limits=arguments.limits
    )
    left = None if arguments.source.resume is None else result_left(arguments.source.resume)
    if left is not None and left.status == "done" and not _goes_on(arguments, left):
        return _report_done(arguments, left, reports=reports)
    with ending_told("pemviz: ended by what was to be simulated, or killed, before the run began"):
        experiment = build_experiment(arguments.experiment, allow_python=arguments.allow_python)
    check_workers(experiment, workers=arguments.workers, scheduler=arguments.scheduler)
    for note in (*arguments.notes, *_own_process_notes(arguments, experiment)):
        print(f"pemviz: {note}", file=sys.stderr)
    folder = arguments.source.resume or create_run_folder(
        arguments.out, label=arguments.experiment.method
    )
    ending = _Ending()
    try:
        result = _carry_out(arguments, experiment, folder, observers=[reports, ending])
    except ConfigError:
        if arguments.source.resume is None and not (folder / CONFIG).exists():
            shutil.rmtree(folder, ignore_errors=True)  # nothing was begun
        raise
    except RunError as error:
        if ending.result is None:
            raise
        if arguments.json:
            _print_json(ending.result, limits=arguments.limits)
        message = f"{error}; {_how_to_repeat(error, arguments, folder)}"
        message += _how_to_go_on(arguments, folder)
        raise RunError(
            message, traceback_text=error.traceback_text, rollout=error.rollout
        ) from error
    if arguments.json:
        _print_json(result, limits=arguments.limits)
    else:
        print_summary(result, folder, verbose=arguments.verbose)
    if result.status != "done":
        on = _resuming(arguments, folder)
        print(
            f"pemviz: stopped; what was finished is in {_place(folder)}; go on with: {on}",
            file=sys.stderr,
        )
        return EXIT_FAILED
    if is_short(result):
        more = _resuming(arguments, folder, *_more(result))
        print(f"pemviz: less precise than was asked; to go on: {more}", file=sys.stderr)
    return gate_exit_code(result, limits=arguments.limits)


def _goes_on(arguments: RecordArguments, result: RunResult) -> bool:
    """Whether a run that is done is to go on with other limits.

    Raises:
        ConfigError: It is, and cannot.
    """
    begun, wanted, folder = result.config, arguments.experiment, arguments.source.resume
    names = [name for name in LIMITS if getattr(begun, name) != getattr(wanted, name)]
    if not names or folder is None:
        return False
    if may_go_on(folder):
        return True
    given = ", ".join(f"{name} = {getattr(wanted, name)}" for name in names)
    why = (
        f"{folder} is done, as precise as it was to be, or after a last stage that came in parts, "
    )
    why += "and its stages were not kept"
    if by_name(begun.method).most is None:
        why = f"{folder} is done, and its method {begun.method} has no limits"
    raise ConfigError(f"{given}: {why}; start a new run")


def _own_process_notes(arguments: RecordArguments, experiment: Experiment) -> Sequence[str]:
    """What cannot be lost without the run, where this process simulates alone."""
    lost, elsewhere = experiment.config.lost, arguments.workers or arguments.scheduler
    if lost == "end" or elsewhere or no_use(experiment) or own_process(experiment):
        return ()
    words = "what the simulator raises is survived; where it may abort or stall, add --workers 1"
    return (f"lost = {lost}: {words}",)


def _carry_out(
    arguments: RecordArguments,
    experiment: Experiment,
    folder: Path,
    *,
    observers: Sequence[Observer],
) -> RunResult:
    """Run it with progress, until a signal asks to stop, by workers if there are any."""
    ended = f"pemviz: ended by what is simulated, or killed; {_left(arguments, folder)}"
    workers = arguments.workers
    if workers is None and arguments.scheduler is None:
        workers = own_process(experiment)
    with (
        ending_told(ended),
        stop_on_signals() as should_stop,
        progress_observer(quiet=arguments.json) as progress,
    ):
        return record_in(
            experiment,
            folder,
            recorders=_recorders(arguments, folder),
            observers=[progress, *observers],
            should_stop=should_stop,
            workers=workers,
            scheduler=arguments.scheduler,
        )


@dataclass
class _Ending:
    """Keeps what a run that failed leaves."""

    result: RunResult | None = None

    def notify(self, event: Event) -> None:
        if isinstance(event, RunFailed):
            self.result = event.result


def _how_to_repeat(error: RunError, arguments: RecordArguments, folder: Path) -> str:
    """The command that repeats the rollout at which a run failed; empty where it is not known."""
    if error.rollout is None or not (folder / CONFIG).exists():
        return ""
    repetition, stage, rollout = error.rollout
    words = ["pemviz", "replay", str(folder), "--stage", f"{stage}", "--rollout", f"{rollout}"]
    words += ["--repetition", f"{repetition}"] if repetition else []
    words += ["--allow-python"] * arguments.allow_python
    return f"see that rollout alone with: {shlex.join(words)}; "


def _how_to_go_on(arguments: RecordArguments, folder: Path) -> str:
    """Where a run that failed is, and the command that goes on with it."""
    return _left(arguments, folder) if (folder / CONFIG).exists() else f"nothing is in {folder}"


def _place(folder: Path) -> str:
    """Where a run is, and its answer under the limits that it had before, if it had one."""
    return f"{folder}, its answer before in {FORMER}" if (folder / FORMER).exists() else str(folder)


def _left(arguments: RecordArguments, folder: Path) -> str:
    return (
        f"what was finished is in {_place(folder)}; once the cause is removed, go on with: "
        f"{_resuming(arguments, folder)}"
    )


def _resuming(arguments: RecordArguments, folder: Path, *options: str) -> str:
    """The command that goes on with a run."""
    words = ["pemviz", "record", "--resume", str(folder), *options]
    return shlex.join([*words, *["--allow-python"] * arguments.allow_python])


def _more(result: RunResult) -> Sequence[str]:
    """The options that give a run twice what may have stopped it."""
    config, simulated = result.config, sum(stage.rollouts for stage in result.stages)
    if result.estimate is not None:
        simulated = result.estimate.rollouts_simulated
    most, minutes = by_name(config.method).most, config.max_minutes
    words: list[str] = []
    if most is not None:
        words = ["--max-rollouts", f"{2 * max(config.repetitions * most(config), simulated)}"]
    return words if minutes is None else [*words, "--max-minutes", f"{2.0 * minutes:g}"]


def _recorders(arguments: RecordArguments, folder: Path) -> Sequence[Observer]:
    """The observer that writes ``run.rrd``, if one is asked for.

    A resumed run's recording replaces the old one only when it is whole.
    """
    if arguments.no_recording:
        return ()
    from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

    path = folder / "run.rrd"
    written = path.with_name(".run.rrd.partial") if path.exists() else path
    recorder = Recorder(
        written,
        frames=not arguments.no_frames,
        live_port=arguments.live,
    )
    return (recorder if written == path else _Replacing(recorder, written, path),)


@dataclass(frozen=True)
class _Replacing:
    """A recorder whose file takes the place of another one as soon as it is whole."""

    recorder: Observer
    written: Path
    path: Path

    def notify(self, event: Event) -> None:
        self.recorder.notify(event)
        if isinstance(event, RunDone):
            self.written.replace(self.path)


def _report_done(arguments: RecordArguments, result: RunResult, *, reports: ReportWriter) -> int:
    """Report a run that is done already and return its exit code; nothing is computed."""
    print(
        f"pemviz: {arguments.source.resume} is done already; nothing was computed", file=sys.stderr
    )
    reports.write(result)
    if arguments.json:
        _print_json(result, limits=arguments.limits)
    return gate_exit_code(result, limits=arguments.limits)


def _print_json(result: RunResult, *, limits: GateLimits) -> None:
    """The result as one object, with what the gate says if there is one."""
    gate = decide_limits(result, limits=limits)
    judged = {} if gate is None else {"gate": asdict(gate)}
    print(json.dumps({**result_document(result), **judged}, allow_nan=False))


def gate_exit_code(result: RunResult, *, limits: GateLimits) -> int:
    """1 if an upper bound is above its limit, 4 if the run cannot tell, else 0."""
    decision = decide_limits(result, limits=limits)
    if decision is None:
        return EXIT_DONE
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return decision.exit_code
