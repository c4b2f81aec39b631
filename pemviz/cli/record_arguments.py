"""Options of ``pemviz record``, and the configuration that they start from."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from pemviz.cli.help import HelpPage
from pemviz.cli.parsing import Processes, parse_arguments
from pemviz.config import LIMITS, WITHOUT_EFFECT, ExperimentConfig, StartChoice
from pemviz.config.ranges import Range, check_value
from pemviz.config.rule_words import Bound, GateLimits, read_limits, read_rules, read_starts
from pemviz.config.toml_files import load_config, load_preset, with_own_rules
from pemviz.config.topics import TOPICS
from pemviz.errors import ConfigError
from pemviz.sampling.registry import SHIPPED, ignored_note, ignored_settings

Port = Annotated[int, Range(low=1, high=65535)]

PAGE = HelpPage(
    text="""
usage: pemviz record [OPTIONS]   how likely is a violation? Keeps a run folder
Question
  --preset NAME       paper (default), town01, braking, cut-in, cut-out, merge,
                      free-traffic, paper-algorithm; or --config FILE.toml
  --spec FORMULA      what must hold; of several rules each: --rule NAME=FORMULA
  --scenario.initial-gap-m 13   and all else of the scenario: --help scenario
Detector
  --pem NAME|FILE     what it misses: ml-nn, rrc, a file of 'pemviz pem fit'
  --memory-s S        misses come in bursts, also --frailty F; --memory-curve
  --position-errors NAME|FILE   how far off it says a car is
Certainty
  --precision 10%     how sure the answer is to be; at most --max-minutes 5
  --method NAME       auto (default), mixture, splitting, ...: --help method
  --target P          what labels would show that the answer is below P
  --seed N            also --repetitions N, and --reference, an exact answer
Output
  --out DIR           where run folders go; --verbose, --json: what is printed
  --fail-above P      exit code 1 if the bound is above: --fail-on; --summary
  --resume RUN        go on with a run that was stopped, or with other limits
Examples
  pemviz record --preset cut-in --pem rrc
  pemviz record --memory-s 0.25 --frailty 0.7 --target 1e-4
  pemviz record --json --fail-above 1e-9
More: --help question, detector, certainty, method, output, scenario, encounter,
sumo, or an option such as --help spec; --help-all for everything""",
    topics=TOPICS,
    notes={
        "question": "What is simulated, and what must hold.",
        "detector": "What stands in for the detector.",
        "certainty": "How sure the answer is to be, and what else is to be known of it.",
        "output": "Exit codes: 0 done, 1 --fail-above tripped, 2 bad input, 3 failed or "
        "interrupted, 4 --fail-above cannot be decided.",
        "scenario": "The braking scenario: a lead car brakes, the ego brakes for it once detected.",
        "encounter": "Logical scenarios, which begin at random; --start has their distributions.",
        "method": "\n".join(f"- {method.name}: {method.summary}" for method in SHIPPED),
    },
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where the configuration starts from; every other option overrides it."""

    preset: str | None = None
    """Shipped configuration: paper, town01, or paper-algorithm, the paper's own method; or a
    logical scenario with random starts: braking, cut-in, cut-out; or merge, highway-env's own; or
    free-traffic, in SUMO. Without --config, paper."""
    config: Path | None = None
    """Configuration file (TOML), for instance the config.toml of an earlier run."""
    resume: Path | None = None
    """Run folder of a run that was killed, stopped or failed: goes on after its last finished
    stage, with its own configuration, and ends as if nothing had happened."""


@dataclass(frozen=True, kw_only=True)
class RecordArguments:
    """Options of ``pemviz record``."""

    source: Annotated[Source, tyro.conf.arg(name="")] = field(default_factory=Source)
    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")] = field(
        default_factory=ExperimentConfig
    )
    out: Path = Path("recordings")
    """Folder in which the run folder is made."""
    rule: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A rule as NAME=FORMULA, in place of --spec: each rule is answered, and any of them."""
    tracker: str | None = None
    """Tracker between perception and controller: M/N, confirmed by M hits of N, then options such
    as ,coast=0.5,filter=kalman; none: none. As --scenario.tracker, which explains it."""
    sumo_config: str | None = None
    """Traffic of SUMO's own, with simulator sumo: a .sumocfg file, or free-traffic. As
    --sumo.config; --sumo.ego says which of its vehicles is the ego."""
    start: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A start value of the encounters as NAME=VALUE, or NAME=DISTRIBUTION, such as
    gap="lognormal(30, 0.4) in [8, 100]"; others keep theirs."""
    fail_above: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Exit with code 1 if the upper 95 % bound is above this probability; above 0, at most 1.
    NAME=P for one of several rules."""
    fail_on: Bound = "sampling"
    """Which upper bound --fail-above, with which alone it goes, judges: sampling, of the 95 %
    interval, which takes the error model and its memory of misses as they are; or act-on, the upper
    end to act on, with all that leaves the answer open: code 4 where that is not known."""
    summary: Path | None = None
    """Add the result as markdown to the end of this file, for instance $GITHUB_STEP_SUMMARY."""
    junit: Path | None = None
    """Write the result as JUnit XML to this file: one test case, which fails if --fail-above
    tripped and is an error if that cannot be decided."""
    verbose: bool = False
    """Print every figure and every warning, not only the gravest."""
    json: bool = False
    """Print the result as one JSON object and nothing else."""
    no_recording: bool = False
    """Leave out run.rrd."""
    no_frames: bool = False
    """Leave highway-env's pictures of the least robust rollout out of run.rrd. Other simulators'
    rollouts, and those with position errors, have none."""
    allow_python: bool = False
    """Allow --pem module:attribute, a model of your own in Python, whose code then runs."""
    workers: Processes | None = None
    """Processes that simulate the rollouts of a slow back end, such as highway-env; 1 to 1024.
    The results do not depend on it."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose workers do that instead."""
    live: Port | None = None
    """Also serve the recording, while the run goes on, to live rerun viewers on this port of
    the loopback interface; 1 to 65535."""
    notes: tyro.conf.Suppress[tuple[str, ...]] = ()
    """Lines to tell before the run begins; no option."""

    @property
    def limits(self) -> GateLimits:
        """What ``fail_above`` and ``fail_on`` ask for.

        Raises:
            ConfigError: Something is no probability, or names no rule.
        """
        return read_limits(self.fail_above, rules=self.experiment.rules, bound=self.fail_on)


def parse(words: Sequence[str]) -> RecordArguments:
    """The command's arguments: preset or file first, then what the words override.

    Raises:
        InputError: An option is unknown, or a value is not allowed.
    """
    source = _source(words)
    start = RecordArguments(source=source, experiment=_start(source))
    arguments = parse_arguments(RecordArguments, words, command="record", default=start, page=PAGE)
    for name, value, annotation in (
        ("live", arguments.live, Port),
        ("workers", arguments.workers, Processes),
    ):
        if value is not None:
            check_value(name=name, value=value, annotation=annotation)
    arguments = _with_shorthands(_with_rules(arguments, start.experiment))
    free = (*WITHOUT_EFFECT, *LIMITS, *(["lost"] if start.experiment.lost == "end" else []))
    begun = {name: getattr(start.experiment, name) for name in free}
    asked = replace(arguments.experiment, **begun)
    if source.resume and asked != start.experiment:
        every = [field.name for field in fields(asked)]
        differ = [n for n in every if getattr(asked, n) != getattr(start.experiment, n)]
        message = (
            f"resume = {source.resume}: the run goes on with its own configuration; leave out "
            f"{', '.join(differ)}"
        )
        raise ConfigError(message)
    arguments = replace(arguments, experiment=with_own_rules(arguments.experiment))
    arguments.experiment.validate()  # before anything slow is imported
    _ = arguments.limits
    return replace(arguments, notes=ignored_notes(arguments.experiment, start=start.experiment))


def ignored_notes(config: ExperimentConfig, *, start: ExperimentConfig) -> tuple[str, ...]:
    """A line for each setting that differs from ``start`` though the method does not look at it."""
    return tuple(
        f"{name} = {getattr(config, name)}: {ignored_note(config.method)}"
        for name in sorted(ignored_settings(config.method))
        if getattr(config, name) != getattr(start, name)
    )


def _with_shorthands(arguments: RecordArguments) -> RecordArguments:
    """With the options that stand for a setting of a table: of the scenario, of SUMO, of starts."""
    config = arguments.experiment
    if arguments.tracker is not None:
        config = replace(config, scenario=replace(config.scenario, tracker=arguments.tracker))
    if arguments.sumo_config is not None:
        config = replace(config, sumo=replace(config.sumo, config=arguments.sumo_config))
    given = read_starts(arguments.start)
    kept = [choice for choice in config.start if choice.name not in given]
    start = (*kept, *(StartChoice(*choice) for choice in given.items()))
    return replace(arguments, experiment=replace(config, start=start))


def _with_rules(arguments: RecordArguments, start: ExperimentConfig) -> RecordArguments:
    """With the rules that were given instead of the specification.

    Raises:
        ConfigError: One is not NAME=FORMULA, stands twice, or there is a specification too.
    """
    config = arguments.experiment
    if not arguments.rule:
        if config.rules and config.spec != start.spec:  # --spec in place of the file's rules
            return replace(arguments, experiment=replace(config, rules=()))
        return arguments
    rules = read_rules(arguments.rule)
    if config.spec != start.spec:
        message = f"spec = {config.spec!r}: must be left out where there are rules"
        raise ConfigError(message)
    return replace(arguments, experiment=config.with_rules(rules))


def _source(words: Sequence[str]) -> Source:
    known = [
        part
        for index, word in enumerate(words)
        for part in words[index : index + (1 if "=" in word else 2)]
        if word.split("=", 1)[0] in ("--preset", "--config", "--resume")
    ]
    return parse_arguments(Source, known, command="record", default=Source())


def _start(source: Source) -> ExperimentConfig:
    given = {
        name: value
        for name in ("preset", "config", "resume")
        if (value := getattr(source, name)) is not None
    }
    if len(given) > 1:
        named = " and ".join(f"{name} = {str(value)!r}" for name, value in given.items())
        message = f"{named}: give only one of them"
        raise ConfigError(message)
    if source.resume is not None:
        if not (source.resume / "config.toml").is_file():
            lacks = "has no config.toml" if source.resume.is_dir() else "there is no such folder"
            message = f"resume = {source.resume}: must be a run folder, {lacks}"
            raise ConfigError(message)
        return load_config(source.resume / "config.toml")
    if source.config is not None:
        return load_config(source.config)
    return load_preset("paper" if source.preset is None else source.preset)
