"""A study of logical scenarios: cells by both methods, kept in files, then page, table, picture."""

import hashlib
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from pemviz._version import __version__
from pemviz.config import ExperimentConfig
from pemviz.config.ranges import AtLeastZero
from pemviz.config.records import read_record
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.files.atomic import document_digest, write_json
from pemviz.files.json_text import parse_json
from pemviz.pem import load_pem
from pemviz.reproduce.workers import Job, OnProgress, no_progress, run_jobs
from pemviz.runs.coherence import disorders
from pemviz.runs.engine import estimates_by_rule
from pemviz.runs.experiment import build_experiment
from pemviz.types import Estimate
from studies.logical_scenarios.page import all_answers, csv_of, page_markdown
from studies.logical_scenarios.picture import picture_png
from studies.logical_scenarios.settings import (
    ANY,
    METHODS,
    PLAIN,
    WEIGHTED,
    Cell,
    ScenarioStudySettings,
)

HASH_DIGITS = 16
WHOLE = "whole"
"""The entry with the digest of all others."""
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class RuleEstimate:
    """How likely a rule is broken.

    Attributes:
        rule: Its name; :data:`ANY` for all together.
        estimate: By the cell's method.
    """

    rule: str
    estimate: Estimate


@dataclass(frozen=True)
class CellEstimates:
    """What one method says of one cell.

    Attributes:
        digest: Of what was asked: configuration, error model, version.
        cpu_s: What it took [s].
        rules: All rules' estimates.
    """

    digest: str
    cpu_s: AtLeastZero
    rules: tuple[RuleEstimate, ...]

    @property
    def by_rule(self) -> Mapping[str, Estimate]:
        """Estimates by the rule's name."""
        return {one.rule: one.estimate for one in self.rules}


def cell_digest(config: ExperimentConfig, pem_digest: str) -> str:
    """Tells a cell's question from any other that could give other figures."""
    asked = "\n".join([config_text(config), pem_digest, __version__])
    return hashlib.sha256(asked.encode()).hexdigest()


def cell_path(folder: Path, config: ExperimentConfig, digest: str) -> Path:
    """Where a cell's estimates are kept."""
    tracker = "".join(one if one.isalnum() else "-" for one in config.scenario.tracker)[:40]
    readable = f"{config.encounter.logical_scenario}_memory-{config.memory_s:g}_tracker-{tracker}"
    return folder / f"{readable}_{config.method}_{digest[:HASH_DIGITS]}.json"


def kept_estimates(path: Path, *, digest: str) -> CellEstimates | None:
    """What an earlier call found; ``None`` if there is nothing that can be read or is meant.

    What was changed since is told of, and counts as nothing.
    """
    try:
        document = dict(parse_json(path.read_text(encoding="utf-8")))
        told = document.pop(WHOLE, None)  # older versions wrote none
        found = read_record(CellEstimates, document)
        is_changed = told is not None and told != document_digest(document)
    except (OSError, TypeError, ValueError, InputError):
        return None
    wrong = next(disorders(found), "it was changed after it was written" if is_changed else None)
    if wrong is not None:
        LOG.warning("estimates %s: %s; they are computed again", path, wrong)
        return None
    return found if found.digest == digest else None


def cell_estimates(config: ExperimentConfig, path: Path, digest: str) -> CellEstimates:
    """The cell's estimates: those that are kept, or computed and then kept.

    Args:
        config: What is asked.
        path: The file that keeps them; its folder exists.
        digest: Of what is asked, :func:`cell_digest`.

    Raises:
        InputError: What is asked cannot be.
        OSError: The file cannot be written.
    """
    kept = kept_estimates(path, digest=digest)
    if kept is not None:
        return kept
    began = time.process_time()
    experiment = build_experiment(config)
    method, problem = experiment.method, experiment.problem
    # the last digit would depend on the number of threads
    with threadpool_limits(limits=1, user_api="blas"):
        state = method.init(problem, repetition=0)
        while not method.is_done(state):
            state, _ = method.step(problem, state)
        by_rule = {ANY: method.estimate(state), **estimates_by_rule(method, state, config.rules)}
    rules = [{"rule": rule, "estimate": _finite(asdict(one))} for rule, one in by_rule.items()]
    document = {"digest": digest, "cpu_s": time.process_time() - began, "rules": rules}
    write_json(path, {**document, WHOLE: document_digest(document)})
    return read_record(CellEstimates, document)


def _finite(table: Mapping[str, Any]) -> dict[str, Any]:
    """The table with null for numbers that JSON has no words for."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in table.items()
    }


KEPT = "what is done is kept, the same command goes on from there"


@dataclass(frozen=True)
class ScenarioStudy:
    """What was computed.

    Attributes:
        estimates: By cell and method.
        page: Markdown.
        csv: Every answer with every digit.
        png: The answers as a picture.
    """

    estimates: Mapping[tuple[Cell, str], CellEstimates]
    page: str
    csv: str
    png: bytes

    def files(self) -> dict[str, bytes]:
        """Contents by file name, the page last."""
        return {
            "scenarios.csv": self.csv.encode(),
            "scenarios.png": self.png,
            "scenarios.md": self.page.encode(),
        }


def study_scenarios(
    settings: ScenarioStudySettings,
    folder: Path,
    *,
    on_progress: OnProgress = no_progress,
    should_stop: Callable[[], bool] = lambda: False,
) -> ScenarioStudy:
    """Compute what ``settings`` ask.

    Args:
        settings: Which cells, and with what effort.
        folder: Exists, and keeps a file for each cell and method as soon as that is done; what is
            there from an earlier call with the same settings is not computed again.
        on_progress: Told (jobs done, jobs in all, the last one's label).
        should_stop: Asked between jobs, with several processes several times a second.

    Raises:
        InputError: A setting is wrong.
        RunError: Stopped, or a process died.
    """
    settings.validate()
    pem = load_pem(settings.pem)
    jobs: dict[tuple[Cell, str], Job] = {}
    for cell in settings.cells:
        for method in METHODS:
            config = settings.config(cell, method)
            digest = cell_digest(config, pem.digest)
            arguments = (config, cell_path(folder, config, digest), digest)
            jobs[cell, method] = Job(f"{cell.label}, {method}", cell_estimates, arguments)
    estimates = run_jobs(
        jobs,
        workers=settings.workers,
        on_progress=on_progress,
        should_stop=should_stop,
        when_stopped=KEPT,
    )
    answers = all_answers(
        {
            cell: (estimates[cell, WEIGHTED].by_rule, estimates[cell, PLAIN].by_rule)
            for cell in settings.cells
        }
    )
    cpu_s = {m: sum(estimates[cell, m].cpu_s for cell in settings.cells) for m in METHODS}
    page = page_markdown(settings, answers, pem=pem, cpu_s=cpu_s)
    return ScenarioStudy(estimates, page, csv_of(answers), picture_png(settings, answers))
