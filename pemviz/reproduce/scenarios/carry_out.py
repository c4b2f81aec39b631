"""A study of logical scenarios: a job for each cell and method, then page, table and picture."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pemviz.pem import load_pem
from pemviz.reproduce.scenarios.cells import CellEstimates, cell_digest, cell_estimates, cell_path
from pemviz.reproduce.scenarios.page import page_markdown
from pemviz.reproduce.scenarios.picture import picture_png
from pemviz.reproduce.scenarios.settings import (
    METHODS,
    PLAIN,
    WEIGHTED,
    Cell,
    ScenarioStudySettings,
)
from pemviz.reproduce.scenarios.table import all_answers, csv_of
from pemviz.reproduce.workers import Job, OnProgress, no_progress, run_jobs

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
