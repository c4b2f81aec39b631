"""Carries a reproduction out: jobs first, then tables, figures and the page, all at once."""

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from pemviz._version import __version__
from pemviz.analysis.detection_curves import gap_grid, pem_curve
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem import Pem, load_table
from pemviz.reports.escape import markdown_code, markdown_table, markdown_text
from pemviz.reproduce import figures
from pemviz.reproduce.experiments import (
    METRICS,
    LeastSafeSearch,
    RepetitionOutcome,
    Settings,
    exact_reference,
    find_least_safe,
    metric_experiments,
    run_repetition,
    table_2_experiments,
)
from pemviz.reproduce.figures import Artefact, DetectionAxis
from pemviz.reproduce.published import AUTHORS_PEM_DIGEST
from pemviz.reproduce.tables import Table, score_model, table_1, table_2, table_3, trainable_models
from pemviz.reproduce.workers import Job, OnProgress, no_progress, run_jobs
from pemviz.runs.experiment import Experiment, build_experiment

VERSIONED = ("numpy", "scipy", "torch", "scikit-learn", "matplotlib")

INTRODUCTION = (
    "Innes & Ramamoorthy, *Testing Rare Downstream Safety Violations via Upstream Adaptive "
    "Sampling of Perception Error Models* (arXiv 2209.09674): our figures beside the published "
    "ones. 'not given here' marks a figure of the paper that is not known here."
)

MODEL, REPETITION, SEARCH, REFERENCE = "model", "repetition", "search", "reference"
Key = tuple[Any, ...]
Results = Mapping[Key, Any]


@dataclass(frozen=True)
class Reproduction:
    """What was computed.

    Attributes:
        artefacts: Tables and figures in the paper's order.
        page: All of them as one page of markdown.
        search: The least safe rollouts, if they were asked for.
    """

    artefacts: tuple[Artefact, ...]
    page: str
    search: LeastSafeSearch | None

    def files(self) -> dict[str, bytes]:
        """Contents by file name, the page last."""
        contents = {name: c for one in self.artefacts for name, c in one.files().items()}
        return {**contents, "reproduction.md": self.page.encode()}


def reproduce(
    settings: Settings,
    *,
    on_progress: OnProgress = no_progress,
    should_stop: Callable[[], bool] = lambda: False,
) -> Reproduction:
    """Compute what ``settings`` ask; nothing is written.

    Args:
        settings: What, and with what effort.
        on_progress: Called with (jobs done, jobs in all, the last one's label).
        should_stop: Called several times a second.

    Raises:
        InputError: A setting or the data is wrong.
        RunError: Stopped, or a process died.
    """
    _check(settings)
    began = time.perf_counter()
    experiment = build_experiment(settings.experiment)
    results = run_jobs(
        plan(settings), workers=settings.workers, on_progress=on_progress, should_stop=should_stop
    )
    made = tuple(_artefacts(settings, experiment, results))
    return Reproduction(
        artefacts=made,
        page=page_markdown(
            settings,
            pem=experiment.pem,
            sections=[one.markdown for one in made],
            wall_s=time.perf_counter() - began,
        ),
        search=results.get((SEARCH,)),
    )


def plan(settings: Settings) -> dict[Key, Job]:
    """All jobs, those that several tables share only once, long ones first."""
    jobs: dict[Key, Job] = {}
    if "table1" in settings.parts and settings.data is not None:
        for model in reversed(trainable_models()):
            arguments = (model, settings.data, settings.seed)
            jobs[MODEL, model] = Job(f"Table I, {model}", score_model, arguments)
    if {"table2", "table3"} & set(settings.parts):
        arguments = (settings.experiment, settings.reference_rollouts)
        jobs[(REFERENCE,)] = Job("exact reference", exact_reference, arguments)
    if "figures" in settings.parts:
        arguments = (settings.experiment, METRICS, settings.least_safe_rollouts)
        jobs[(SEARCH,)] = Job("least safe rollouts", find_least_safe, arguments)
    for name, config in _experiments(settings).items():
        for repetition in range(settings.repetitions):
            label = f"{name}, repetition {repetition + 1} of {settings.repetitions}"
            jobs.setdefault(
                (REPETITION, config, repetition), Job(label, run_repetition, (config, repetition))
            )
    return jobs


def _experiments(settings: Settings) -> dict[str, ExperimentConfig]:
    wanted: dict[str, ExperimentConfig] = {}
    if {"table3", "figures"} & set(settings.parts):
        wanted |= metric_experiments(settings)
    if "table2" in settings.parts:
        wanted |= table_2_experiments(settings)
    return wanted


def _artefacts(settings: Settings, experiment: Experiment, results: Results) -> Sequence[Artefact]:
    made: list[Artefact] = []
    scores = {key[1]: results[key] for key in results if key[0] == MODEL}
    if scores:
        made.append(_table_artefact(table_1({m: scores[m] for m in trainable_models()})))
    reference = results.get((REFERENCE,))
    if "table2" in settings.parts:
        outcomes = _outcomes(settings, table_2_experiments(settings), results)
        made.append(_table_artefact(table_2(outcomes, reference)))
    if "table3" in settings.parts:
        outcomes = _outcomes(settings, metric_experiments(settings), results)
        made.append(_table_artefact(table_3(outcomes, reference)))
    if "figures" in settings.parts:
        made += _figures(settings, experiment, results)
    return made


def _table_artefact(table: Table) -> Artefact:
    return Artefact(table.name, table.markdown(), table.csv())


def _figures(settings: Settings, experiment: Experiment, results: Results) -> Sequence[Artefact]:
    problem = experiment.problem
    gap_m = gap_grid(problem.simulator)
    pem = pem_curve(simulator=problem.simulator, pem=problem.pem, gap_m=gap_m)
    axis = DetectionAxis(gap_m=gap_m, pem=pem)
    scenario = settings.experiment.scenario
    outcomes = _outcomes(settings, metric_experiments(settings), results)
    return [
        figures.learned_proposal(outcomes["classical"], axis, scenario),
        figures.stage_proposals(outcomes, axis, scenario, stage=settings.figure_stage),
        figures.least_safe(results[(SEARCH,)], scenario),
    ]


def _outcomes(
    settings: Settings, experiments: Mapping[str, ExperimentConfig], results: Results
) -> dict[str, list[RepetitionOutcome]]:
    return {
        name: [results[REPETITION, config, number] for number in range(settings.repetitions)]
        for name, config in experiments.items()
    }


def _check(settings: Settings) -> None:
    if settings.repetitions < 1:
        raise ConfigError(f"repetitions = {settings.repetitions}: must be at least 1")
    if settings.workers < 1:
        raise ConfigError(f"workers = {settings.workers}: must be at least 1")
    if settings.parts == ("table1",) and settings.data is None:
        raise ConfigError("table1 needs --data, the paper's training set (a folder or a .csv)")
    if "table1" in settings.parts and settings.data is not None:
        load_table(settings.data)


def page_markdown(settings: Settings, *, pem: Pem, sections: Sequence[str], wall_s: float) -> str:
    """Introduction, sections, provenance.

    Args:
        settings: What was requested.
        pem: The error model that Tables II and III and the figures rest on.
        sections: Markdown of each table and figure.
        wall_s: How long it took.
    """
    parts = ["# The paper reproduced", INTRODUCTION, *(section.strip() for section in sections)]
    if "table1" in settings.parts and settings.data is None:
        parts.append(
            "## Table I: perception error models\n\nLeft out: it needs the paper's training set, "
            "given with `--data`."
        )
    parts += ["## Provenance", _provenance(settings, pem, wall_s)]
    return "\n\n".join(parts) + "\n"


def _provenance(settings: Settings, pem: Pem, wall_s: float) -> str:
    whose = "the authors' own network" if pem.digest == AUTHORS_PEM_DIGEST else "ours"
    versions = [f"pemviz {__version__}", f"Python {platform.python_version()}"]
    versions += [f"{name} {metadata.version(name)}" for name in VERSIONED]
    rows = [
        ("experiment", "preset `paper`, vectorized back end"),
        ("repetitions", str(settings.repetitions)),
        ("seed", str(settings.seed)),
        ("perception error model", f"{markdown_code(pem.name)}, {whose}"),
        ("its data", markdown_text(pem.data)),
        ("its digest (SHA-256)", markdown_code(pem.digest)),
        ("versions", markdown_text(", ".join(versions))),
        ("wall time", f"{wall_s:.0f} s with {settings.workers} processes"),
    ]
    return markdown_table(("what", "value"), rows)
