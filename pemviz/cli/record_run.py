"""What ``pemviz record`` does once its arguments are read."""

import json
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pemviz.cli.gate import gate_exit_code
from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.progress import progress_observer
from pemviz.cli.record_arguments import RecordArguments
from pemviz.cli.summary import print_summary
from pemviz.cli.workers import check_workers, with_workers
from pemviz.errors import EXIT_DONE, EXIT_FAILED
from pemviz.reports.writer import ReportWriter
from pemviz.runs.events import Observer
from pemviz.runs.experiment import Experiment, build_experiment, device_notes
from pemviz.runs.result import estimate_from_document, result_document
from pemviz.runs.resume import carry_out, read_result
from pemviz.runs.store import create_run_folder


def record(arguments: RecordArguments) -> int:
    """Run what the arguments ask for and return the exit code.

    Raises:
        InputError: What they name does not fit together; nothing was simulated or written.
        RunError: The run failed.
    """
    if arguments.source.resume is not None:
        done = _finished(arguments, arguments.source.resume)
        if done is not None:
            return done
    experiment = build_experiment(arguments.experiment, allow_python=arguments.allow_python)
    for note in device_notes(experiment):
        print(f"pemviz: {note}", file=sys.stderr)
    check_workers(experiment, workers=arguments.workers, scheduler=arguments.scheduler)
    reports = ReportWriter(
        summary=arguments.summary, junit=arguments.junit, fail_above=arguments.fail_above
    )
    folder = arguments.source.resume or create_run_folder(
        arguments.out, label=arguments.experiment.method
    )
    with (
        stop_on_signals() as should_stop,
        progress_observer(quiet=arguments.json) as progress,
        _recorder(arguments, experiment, folder) as recorders,
        with_workers(
            experiment, workers=arguments.workers, scheduler=arguments.scheduler
        ) as worked,
    ):
        result = carry_out(
            worked, folder, observers=[*recorders, progress, reports], should_stop=should_stop
        )
    if arguments.json:
        print(json.dumps(result_document(result), allow_nan=False))
    else:
        print_summary(result, folder)
    if result.status != "done":
        print(f"pemviz: stopped; what was finished is in {folder}", file=sys.stderr)
        return EXIT_FAILED
    if arguments.fail_above is None or result.estimate is None:
        return EXIT_DONE
    return gate_exit_code(result.estimate, fail_above=arguments.fail_above)


@contextmanager
def _recorder(
    arguments: RecordArguments, experiment: Experiment, folder: Path
) -> Generator[Sequence[Observer], None, None]:
    """The observer that writes ``run.rrd``, if one is asked for.

    A resumed run's recording replaces the old one only when it is whole.
    """
    if arguments.no_recording:
        yield ()
        return
    from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

    path = folder / "run.rrd"
    written = path.with_name(".run.rrd.partial") if path.exists() else path
    yield (
        Recorder(
            written,
            frames=not arguments.no_frames and not experiment.is_own_system,
            live_port=arguments.live,
        ),
    )
    if written != path:
        written.replace(path)


def _finished(arguments: RecordArguments, folder: Path) -> int | None:
    """Report a run that is done already and return its exit code; ``None`` if it is not."""
    document = read_result(folder)
    if document is None or document.get("status") != "done":
        return None
    print(f"pemviz: {folder} is done already; nothing was computed", file=sys.stderr)
    if arguments.json:
        print(json.dumps(document, allow_nan=False))
    if arguments.fail_above is None:
        return EXIT_DONE
    estimate = estimate_from_document(document["estimate"])
    return gate_exit_code(estimate, fail_above=arguments.fail_above)
