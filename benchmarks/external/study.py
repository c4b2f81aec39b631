"""``python -m benchmarks external``: methods of pemviz, and of others, on problems of others.

Every run is a line of ``runs.jsonl`` as soon as it is there; a study that was interrupted goes on
where it stopped when it is asked for again.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rich.console import Console

import pemviz
from benchmarks.external import others
from benchmarks.external.catalogue import REQUIREMENTS, Problem
from benchmarks.external.problems import AnyProblem, chosen, experiment_of
from benchmarks.external.record import DONE, RUNS, Run, add_run, read_runs
from benchmarks.external.table import Row, document, nearer, rows_of, table_lines, totals_of
from pemviz.cli.parsing import parse_arguments
from pemviz.config import ExperimentConfig, MethodName
from pemviz.config.ranges import Range, check_value
from pemviz.errors import ConfigError, InputError, RunError
from pemviz.processes import map_in_processes
from pemviz.runs.uncertainty import run_interval_caveats
from pemviz.sampling.mixture.build import CHAINS
from pemviz.sampling.mixture.rejuvenated import SHARE
from pemviz.sampling.mixture.resampled import MOST
from pemviz.sampling.registry import by_name

OTHERS = "others.jsonl"
MOST_PRECISE = 0.001
"""As can be asked for."""
CHAINS_SHARE, CHAINS_LEVELS, LEAST_CHAINS = 0.2, 15, 20
"""Of a budget in counts, for chains; levels of all of their runs, about: 8 to 20 for 1e-3 to 1e-9;
rollouts a level from which on they are worth it."""
Seeds = Annotated[int, Range(low=1, high=100_000)]
FirstSeed = Annotated[int, Range(low=0, high=1_000_000)]
Processes = Annotated[int, Range(low=1, high=256)]


@dataclass(frozen=True, kw_only=True)
class ExternalStudy:
    """Methods on published problems that nobody here designed, beside others' programs."""

    problems: tuple[str, ...] = ()
    """Problems by name or by the beginning of it; none: all."""
    method: tuple[MethodName, ...] = ("mixture",)
    """Methods of pemviz, shipped or registered."""
    budget: tuple[str, ...] = (DONE,)
    """Simulated rollouts of a run, what chains simulate included (of splitting: particles); done:
    until the method says it is done, with its own settings."""
    settings: tuple[str, ...] = ()
    """Of all methods, as name=value, each a field of a configuration: stages=20."""
    seeds: Seeds = 5
    """Runs of each method at each budget on each problem; 1 to 100000."""
    first_seed: FirstSeed = 0
    """Seed of the first of them; 0 to 10^6."""
    processes: Processes = 2
    """Processes; the figures do not depend on it; 1 to 256."""
    out: Path = Path("external")
    """Folder for runs.jsonl, which a later call goes on from, external.md and external.json."""
    others: tuple[Path, ...] = ()
    """Files that benchmarks/external/others.py wrote, to be shown beside."""
    others_python: Path | None = None
    """Interpreter of an environment with OpenTURNS and rareeventestimation: their methods are run
    too, into others.jsonl of the folder, at as many calls as each method took until it was done."""
    others_seeds: Seeds = 10
    """Runs of each of their methods on each problem; 1 to 100000."""
    truths: bool = False
    """Find the problems' probabilities again, print both, and run nothing."""
    list: bool = False
    """List the problems, and run nothing."""


@dataclass(frozen=True)
class Job:
    """Some seeds of one method at one budget on one problem.

    Attributes:
        problem: Its name.
        label: What the method is called in tables.
        budget: What was asked for.
        config: What is run; seeds vary.
        seeds: Which.
        path: The file that runs are added to.
    """

    problem: str
    label: str
    budget: str
    config: ExperimentConfig
    seeds: tuple[int, ...]
    path: Path


def run_study(study: ExternalStudy) -> Sequence[str]:
    """Carry out what is not there yet, and write and return the table.

    Raises:
        InputError: A value is out of range, or a problem, a method or a setting is unknown.
        RunError: A process died.
        OSError: The folder cannot be written.
    """
    check_value(name="seeds", value=study.seeds, annotation=Seeds)
    check_value(name="first-seed", value=study.first_seed, annotation=FirstSeed)
    check_value(name="others-seeds", value=study.others_seeds, annotation=Seeds)
    check_value(name="processes", value=study.processes, annotation=Processes)
    if study.others_python is not None and not study.others_python.is_file():
        message = f"others-python = {str(study.others_python)!r}: must be an interpreter"
        raise ConfigError(message)
    problems, left_out = _at_hand(chosen(study.problems))
    study.out.mkdir(parents=True, exist_ok=True)
    path = study.out / RUNS
    jobs, refused = _jobs(study, problems, path)
    console = Console(stderr=True)
    began = time.monotonic()

    def progress(index: int) -> None:
        job = jobs[index]
        console.print(
            f"{time.monotonic() - began:6.0f} s  {job.problem}, {job.label}, {job.budget}: "
            f"{len(job.seeds)} runs",
            soft_wrap=True,
            highlight=False,
        )

    map_in_processes(run_job, jobs, workers=study.processes, on_done=progress)
    if study.others_python is not None:
        _run_others(study, study.others_python, problems, path)
    return _report(study, problems, path, (*refused, *left_out))


def _at_hand(problems: Sequence[AnyProblem]) -> tuple[Sequence[AnyProblem], Sequence[str]]:
    """Problems whose simulators are installed; and in words, those whose are not."""
    left_out = [
        f"{one.name} is left out: needs {', '.join(one.missing)}, not installed here "
        f"(pip install -r {REQUIREMENTS})"
        for one in problems
        if one.missing
    ]
    return [one for one in problems if not one.missing], left_out


def _run_others(
    study: ExternalStudy, interpreter: Path, problems: Sequence[AnyProblem], path: Path
) -> None:
    """Others' programs, by their own interpreter, after each method of ours.

    Raises:
        RunError: They fail.
    """
    names = [problem.name for problem in problems if isinstance(problem, Problem)]
    for label in sorted(_labels(study)):
        words = ["-m", others.__name__, "--out", str((study.out / OTHERS).absolute())]
        words += ["--like", str(path.absolute()), "--like-method", label]
        words += ["--seeds", str(study.others_seeds), "--problems", *names]
        ended = subprocess.run(  # noqa: S603  the interpreter that the user names
            [str(interpreter.absolute()), *words],
            cwd=Path(__file__).parents[2],
            check=False,
            stdout=sys.stderr,
        )
        if ended.returncode:
            message = f"{interpreter} -m {others.__name__}: exit code {ended.returncode}"
            raise RunError(message)


def _labels(study: ExternalStudy) -> AbstractSet[str]:
    return {" ".join((method, *study.settings)) for method in study.method}


def _jobs(
    study: ExternalStudy, problems: Sequence[AnyProblem], path: Path
) -> tuple[Sequence[Job], Sequence[str]]:
    """What is to be run, and what cannot be had, in words."""
    finished = read_runs(path)
    jobs: list[Job] = []
    refused: list[str] = []
    for problem in problems:
        for method in study.method:
            for budget in study.budget:
                label = " ".join((method, *study.settings))
                keys = [(problem.name, label, budget, seed) for seed in _seeds(study)]
                missing = [key[-1] for key in keys if key not in finished]
                if not missing:
                    continue
                config = configured(problem, method, budget, study.settings)
                try:
                    experiment_of(problem, config)
                except InputError as error:
                    refused.append(f"{label} cannot be had for {problem.name}: {error}")
                    continue
                parts = [tuple(missing[i :: study.processes]) for i in range(study.processes)]
                jobs += [
                    Job(problem.name, label, budget, config, seeds, path)
                    for seeds in parts
                    if seeds
                ]
    return jobs, refused


def _seeds(study: ExternalStudy) -> range:
    return range(study.first_seed, study.first_seed + study.seeds)


def configured(
    problem: AnyProblem, method: str, budget: str, settings: Sequence[str]
) -> ExperimentConfig:
    """What is run.

    Raises:
        InputError: The method, the budget or a setting is wrong.
    """
    config = ExperimentConfig(method=method, spec=problem.spec)
    words: list[str] = []
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            message = f"settings = {setting!r}: must be name=value"
            raise ConfigError(message)
        words += [f"--{name.replace('_', '-')}", value]
    if words:
        config = parse_arguments(
            ExperimentConfig, words, command="external --settings", default=config
        )
    if budget == DONE:
        return config
    if not budget.isdecimal():
        message = f"budget = {budget!r}: must be a number of rollouts, or {DONE}"
        raise ConfigError(message)
    return _within(problem, config, int(budget))


def _within(problem: AnyProblem, config: ExperimentConfig, calls: int) -> ExperimentConfig:
    """A budget that what chains and moves simulate is part of; of chains, if nothing says how."""
    method = by_name(config.method)
    if method.most is not None:  # all of it is spent, whatever is precise enough before
        if config.precision == ExperimentConfig.precision:
            config = replace(config, precision=MOST_PRECISE)
        return method.with_budget(config, calls)
    if "chains" not in method.settings:
        return method.with_budget(config, calls)
    if config.chains is not None or not problem.latents:
        return method.with_budget(config, int(calls / (1.0 + SHARE)))
    each = min(int(CHAINS_SHARE * calls / CHAINS_LEVELS), CHAINS)
    chains = each if each >= LEAST_CHAINS else 0
    searching = CHAINS_LEVELS * chains + (MOST * config.stages if chains else 0)
    calls = int((calls - searching) / (1.0 + SHARE))
    return method.with_budget(replace(config, chains=chains), calls)


def run_job(job: Job) -> None:
    """Run, and add a line for each run as soon as it is there."""
    (problem,) = chosen([job.problem])
    for seed in job.seeds:
        began = time.process_time()
        run = _run(problem, job, seed)
        add_run(job.path, replace(run, seconds=time.process_time() - began))


def _run(problem: AnyProblem, job: Job, seed: int) -> Run:
    run = Run(problem=job.problem, method=job.label, budget=job.budget, seed=seed, estimate=None)
    try:
        result = pemviz.run(experiment_of(problem, replace(job.config, seed=seed)))
    except RunError as error:
        return replace(run, warned=(f"failed: {error}",))
    estimate = result.estimate
    if estimate is None:
        return replace(run, warned=("no estimate",))
    return replace(
        run,
        estimate=estimate.probability,
        low=estimate.ci_low,
        high=estimate.ci_high,
        warned=run_interval_caveats(result),
        calls=estimate.rollouts_simulated,
    )


def _report(
    study: ExternalStudy, problems: Sequence[AnyProblem], path: Path, said: Sequence[str]
) -> Sequence[str]:
    """Of what this study asks for, all that is there."""
    truths = {problem.name: problem.truth for problem in problems}
    labels = _labels(study)
    ours = [
        run
        for run in read_runs(path).values()
        if run.problem in truths
        and run.method in labels
        and run.budget in study.budget
        and run.seed in _seeds(study)
    ]
    files = (*study.others, *([study.out / OTHERS] if study.others_python else []))
    theirs = [run for file in files for run in read_runs(file).values() if run.problem in truths]
    rows: Sequence[Row] = rows_of([*ours, *theirs], truths)
    totals = [*totals_of(ours, truths), *totals_of(theirs, truths)]
    own = [row for row in rows if row.method in labels]
    found = nearer(own, [row for row in rows if row.method not in labels])
    lines = [*table_lines(rows, totals, found, truths, sorted(labels)), *said]
    (study.out / "external.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    written = json.dumps(document(rows, totals, found, truths), indent=1, allow_nan=False)
    (study.out / "external.json").write_text(written + "\n", encoding="utf-8")
    return lines
