"""``pemviz record``: run an experiment, keep it in a run folder, set an exit code by it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from pemviz.commands.gate import gate_exit_code
from pemviz.commands.interrupt import stop_on_signals
from pemviz.commands.parsing import parse_arguments
from pemviz.commands.progress import progress_observer
from pemviz.commands.summary import print_summary
from pemviz.config import ExperimentConfig
from pemviz.config_files import load_config, load_preset
from pemviz.engine import run as run_engine
from pemviz.errors import ConfigError
from pemviz.events import Observer
from pemviz.exit_codes import EXIT_DONE, EXIT_FAILED
from pemviz.experiment import build_experiment, device_notes
from pemviz.ranges import Range, check_value
from pemviz.reports.writer import ReportWriter
from pemviz.results import result_document
from pemviz.store import RunStore, create_run_folder

FailAbove = Annotated[float, Range(low=0.0, low_open=True, high=1.0)]
Port = Annotated[int, Range(low=1, high=65535)]

DESCRIPTION = (
    "Estimate the probability that the scenario violates the specification. "
    "Writes a run folder with config.toml, result.json, rollouts.npz, proposals.safetensors "
    "and run.rrd. Exit codes: 0 done, 1 --fail-above tripped, 2 bad input, 3 failed or "
    "interrupted, 4 --fail-above cannot be decided."
)


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where the configuration starts from; every other option overrides it."""

    preset: str | None = None
    """Shipped configuration: paper or town01. Without --config, paper."""
    config: Path | None = None
    """Configuration file (TOML), for instance the config.toml of an earlier run."""


@dataclass(frozen=True, kw_only=True)
class RecordArguments:
    """Options of ``pemviz record``."""

    source: Annotated[Source, tyro.conf.arg(name="")] = field(default_factory=Source)
    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")] = field(
        default_factory=ExperimentConfig
    )
    out: Path = Path("recordings")
    """Folder in which the run folder is made."""
    fail_above: FailAbove | None = None
    """Exit with code 1 if the upper 95 % bound is above this probability; above 0, at most 1."""
    summary: Path | None = None
    """Add the result as markdown to the end of this file, for instance $GITHUB_STEP_SUMMARY."""
    junit: Path | None = None
    """Write the result as JUnit XML to this file: one test case, which fails if --fail-above
    tripped and is an error if that cannot be decided."""
    json: bool = False
    """Print the result as one JSON object and nothing else."""
    no_recording: bool = False
    """Leave out run.rrd."""
    no_frames: bool = False
    """Leave highway-env's pictures of the least robust rollout out of run.rrd."""
    live: Port | None = None
    """Also serve the recording, while the run goes on, to live rerun viewers on this port of
    the loopback interface; 1 to 65535."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The arguments are wrong; nothing was simulated or written.
        RunError: The run failed.
    """
    arguments = parse(words)
    experiment = build_experiment(arguments.experiment)
    for note in device_notes(experiment):
        print(f"pemviz: {note}", file=sys.stderr)
    reports = ReportWriter(
        summary=arguments.summary, junit=arguments.junit, fail_above=arguments.fail_above
    )
    folder = create_run_folder(arguments.out, label=arguments.experiment.method)
    with stop_on_signals() as should_stop, progress_observer(quiet=arguments.json) as progress:
        observers: list[Observer] = [RunStore(folder), progress, reports]
        if not arguments.no_recording:
            from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

            recorder = Recorder(
                folder / "run.rrd",
                pem_logit=experiment.pem.logit,
                frames=not arguments.no_frames,
                live_port=arguments.live,
            )
            observers.insert(1, recorder)
        result = run_engine(
            experiment, run_id=folder.name, observers=observers, should_stop=should_stop
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


def parse(words: Sequence[str]) -> RecordArguments:
    """The command's arguments: preset or file first, then what the words override.

    Raises:
        InputError: An option is unknown, or a value is not allowed.
    """
    source = _source(words)
    start = RecordArguments(source=source, experiment=_start(source))
    arguments = parse_arguments(
        RecordArguments, words, command="record", default=start, description=DESCRIPTION
    )
    for name, value, annotation in (
        ("fail-above", arguments.fail_above, FailAbove),
        ("live", arguments.live, Port),
    ):
        if value is not None:
            check_value(name=name, value=value, annotation=annotation)
    return arguments


def _source(words: Sequence[str]) -> Source:
    known = [
        part
        for index, word in enumerate(words)
        for part in words[index : index + (1 if "=" in word else 2)]
        if word.split("=", 1)[0] in ("--preset", "--config")
    ]
    return parse_arguments(Source, known, command="record", default=Source())


def _start(source: Source) -> ExperimentConfig:
    if source.preset is not None and source.config is not None:
        message = f"preset = {source.preset!r} and config = {source.config}: give only one of them"
        raise ConfigError(message)
    if source.config is not None:
        return load_config(source.config)
    return load_preset("paper" if source.preset is None else source.preset)
