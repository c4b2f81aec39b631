"""``python -m benchmarks trust``: is an answer that nothing warns of right? Methods, cases, seeds.

Every run's outcome is a line of ``runs.jsonl`` as soon as it is there; a study that was
interrupted goes on where it stopped when it is asked for again.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from benchmarks.accuracy import CLOSE, Accuracy, Outcome, run_once, summarise
from benchmarks.trust_cases import TrustCase, trust_cases
from pemviz.config import ExperimentConfig, MethodName
from pemviz.config.ranges import Range, check_value
from pemviz.errors import ConfigError, InputError
from pemviz.processes import map_in_processes
from pemviz.runs.experiment import build_method
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.reference import reference_of_few_states

RUNS = "runs.jsonl"
MOST_MISLEADING = 0.01
COVERAGE = (0.93, 0.98)
MOST_WARNED = 0.1
"""What a method must keep to over all cases: runs that mislead, coverage unwarned, and runs within
10 % of the truth that warn."""

Seeds = Annotated[int, Range(low=1, high=100_000)]
FirstSeed = Annotated[int, Range(low=0, high=1_000_000)]
Processes = Annotated[int, Range(low=1, high=256)]


@dataclass(frozen=True, kw_only=True)
class TrustStudy:
    """Is an answer that nothing warns of right? Runs on cases with known probabilities."""

    cases: tuple[str, ...] = ()
    """Cases by name or by the beginning of it; none: all."""
    methods: tuple[MethodName, ...] = ("zero-variance", "mixture", "splitting")
    """Methods; one that a case's specification is out of reach of is left out there."""
    seeds: Seeds = 50
    """Runs of each method on each case; 1 to 100000."""
    first_seed: FirstSeed = 0
    """Seed of the first of them; what a method is set by should be judged by others; 0 to 10^6."""
    rollouts: int = 1200
    """Budget of one run: rollouts, all stages; at least 24 for methods that learn."""
    particles: int = 2000
    """Budget of one run of splitting or subset: particles of all its runs; at least 20."""
    processes: Processes = 2
    """Processes; the figures do not depend on it; 1 to 256."""
    out: Path = Path("trust")
    """Folder for runs.jsonl, which a later call goes on from, and trust.json."""
    list: bool = False
    """List the cases with their truths, and run nothing."""


@dataclass(frozen=True)
class Verdict:
    """Whether a method keeps to a bar.

    Attributes:
        method: The method.
        bar: What is asked, in words.
        figure: What was found, in words.
        met: Whether that is enough.
    """

    method: str
    bar: str
    figure: str
    met: bool


@dataclass(frozen=True)
class TrustReport:
    """A study's figures.

    Attributes:
        rows: One for each case and method, then one for each method over all cases.
        verdicts: Three for each method.
        refused: Case and method to why that method cannot be had there.
    """

    rows: Sequence[Accuracy]
    verdicts: Sequence[Verdict]
    refused: Mapping[tuple[str, str], str]


def run_trust(study: TrustStudy, *, among: Sequence[TrustCase] | None = None) -> TrustReport:
    """Carry out what is not there yet, and judge all of it.

    Args:
        study: What is asked.
        among: The cases to choose from; ``None``: the study's.

    Raises:
        InputError: A value is out of range, or a case is unknown.
        RunError: A process died.
        OSError: The folder cannot be written.
    """
    check_value(name="seeds", value=study.seeds, annotation=Seeds)
    check_value(name="first-seed", value=study.first_seed, annotation=FirstSeed)
    check_value(name="processes", value=study.processes, annotation=Processes)
    cases = chosen(study.cases, trust_cases() if among is None else among)
    configs, refused = _configs(study, cases)
    study.out.mkdir(parents=True, exist_ok=True)
    path = study.out / RUNS
    finished = _read(path)
    jobs = [
        job
        for case, config in configs
        for job in _jobs(case, config, study, finished=finished, path=path)
    ]
    jobs.sort(key=lambda job: job.seeds)
    map_in_processes(_run_job, jobs, workers=study.processes)
    finished = _read(path)
    outcomes = {
        (case, config.method): [finished[_key(case, config, s)] for s in _seeds(study)]
        for case, config in configs
    }
    report = TrustReport(_rows(outcomes), _verdicts(outcomes), refused)
    _write(report, study.out / "trust.json")
    return report


def chosen(names: Sequence[str], cases: Sequence[TrustCase]) -> Sequence[TrustCase]:
    """The cases whose names begin with one of ``names``; all without any.

    Raises:
        InputError: No case's name begins so.
    """
    for name in names:
        if not any(case.name.startswith(name) for case in cases):
            message = f"cases = {name!r}: must begin one of {'; '.join(c.name for c in cases)}"
            raise ConfigError(message)
    return [case for case in cases if not names or case.name.startswith(tuple(names))]


@dataclass(frozen=True)
class _Job:
    """Some seeds of one method on one case, and the file that outcomes are added to."""

    case: TrustCase
    config: ExperimentConfig
    seeds: tuple[int, ...]
    path: Path


def _configs(
    study: TrustStudy, cases: Sequence[TrustCase]
) -> tuple[list[tuple[TrustCase, ExperimentConfig]], dict[tuple[str, str], str]]:
    """What is run on each case, and what cannot be."""
    found: list[tuple[TrustCase, ExperimentConfig]] = []
    refused: dict[tuple[str, str], str] = {}
    for method in study.methods:
        description = by_name(method)
        budget = study.particles if description.interval_basis == "runs" else study.rollouts
        for case in cases:
            config = description.with_budget(replace(case.config, method=method), budget)
            try:
                case.experiment(config)
            except InputError as error:
                refused[case.name, method] = str(error)
            else:
                found.append((case, config))
    return found, refused


def _jobs(
    case: TrustCase,
    config: ExperimentConfig,
    study: TrustStudy,
    *,
    finished: Mapping[str, Outcome],
    path: Path,
) -> Sequence[_Job]:
    """The seeds that are not finished, one job for each process: what they share is built once."""
    # automata are made of closures, which no other process can be sent
    sent = replace(case, automaton=None)
    missing = [seed for seed in _seeds(study) if _key(case, config, seed) not in finished]
    parts = [tuple(missing[first :: study.processes]) for first in range(study.processes)]
    return [_Job(sent, config, seeds, path) for seeds in parts if seeds]


def _seeds(study: TrustStudy) -> range:
    return range(study.first_seed, study.first_seed + study.seeds)


def _run_job(job: _Job) -> None:
    """Run, and add a line for each outcome as soon as it is there."""
    experiment = job.case.experiment(job.config)
    problem = experiment.problem
    samplers = [
        build_method(replace(experiment.config, seed=seed), back_end=experiment.back_end)
        for seed in job.seeds
    ]
    samplers[0].init(problem, repetition=0)
    twin = experiment.twin
    beside = None if twin is None else reference_of_few_states(problem, twin=twin)
    for seed, sampler in zip(job.seeds, samplers, strict=True):
        outcome = run_once(sampler, problem, job.case.truth, beside=beside)
        line = json.dumps({"key": _key(job.case, job.config, seed), **asdict(outcome)})
        with job.path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")


def _key(case: TrustCase, config: ExperimentConfig, seed: int) -> str:
    """What tells a run from others; a case whose truth was corrected is run again."""
    budget = by_name(config.method).budget(config).rollouts
    return f"{case.name} | {case.truth!r} | {config.method} | {budget} | {seed}"


def _read(path: Path) -> dict[str, Outcome]:
    """Outcomes by key; a line that was not finished counts as none."""
    outcomes: dict[str, Outcome] = {}
    if not path.exists():
        return outcomes
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            fields: dict[str, Any] = json.loads(line)
            key = fields.pop("key")
            outcomes[key] = Outcome(**fields)
        except (ValueError, KeyError, TypeError):
            continue
    return outcomes


Outcomes = Mapping[tuple[TrustCase, str], Sequence[Outcome]]


def _rows(outcomes: Outcomes) -> Sequence[Accuracy]:
    rows = [
        summarise(found, scenario=case.name, method=method, truth=case.truth)
        for (case, method), found in outcomes.items()
    ]
    pooled = [
        summarise(every, scenario="all", method=method, truth=None)
        for method, every in _by_method(outcomes).items()
    ]
    return (*rows, *pooled)


def _by_method(outcomes: Outcomes) -> Mapping[str, Sequence[Outcome]]:
    every: dict[str, list[Outcome]] = {}
    for (_, method), found in outcomes.items():
        every.setdefault(method, []).extend(found)
    return every


def _verdicts(outcomes: Outcomes) -> Sequence[Verdict]:
    verdicts: list[Verdict] = []
    for method, every in _by_method(outcomes).items():
        row = summarise(every, scenario="all", method=method, truth=None)
        misleading = [outcome for outcome in every if outcome.misleads]
        rough = sum("wide-interval" in outcome.diagnostics for outcome in misleading)
        verdicts.append(
            Verdict(
                method,
                f"off by more than a factor of 2 unwarned in at most {MOST_MISLEADING:.0%}",
                f"{len(misleading)} of {len(every)} runs ({row.misleading:.2%})"
                + (f"; {rough} of them say that their interval is wider" if rough else ""),
                row.misleading <= MOST_MISLEADING,
            )
        )
        low, high = COVERAGE
        share = row.unwarned_coverage
        verdicts.append(
            Verdict(
                method,
                f"unwarned intervals contain the truth in {low:.0%} to {high:.0%}",
                "no run is unwarned"
                if share is None
                else f"{share:.1%} (exact 95 %: {row.unwarned_coverage_low:.1%} to "
                f"{row.unwarned_coverage_high:.1%}){_width(row)}; {row.warned:.0%} of runs warn",
                share is not None and low <= share <= high,
            )
        )
        close = [outcome.warned for outcome in every if outcome.is_close]
        verdicts.append(
            Verdict(
                method,
                f"of the runs within {CLOSE:.0%} of the truth at most {MOST_WARNED:.0%} warn",
                f"{sum(close)} of {len(close)} runs",
                sum(close) <= MOST_WARNED * len(close),
            )
        )
    return verdicts


def _width(row: Accuracy) -> str:
    width = row.unwarned_width
    return "" if width is None else f"; {width:.2f} times as wide they would in 95 %"


def _write(report: TrustReport, path: Path) -> None:
    document = {
        "schema": 1,
        "rows": [asdict(row) for row in report.rows],
        "verdicts": [asdict(verdict) for verdict in report.verdicts],
        "refused": [[*key, why] for key, why in report.refused.items()],
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
