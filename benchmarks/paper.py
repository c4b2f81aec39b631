"""How long one repetition of the paper's experiment takes, and where the time goes."""

import statistics
from collections.abc import Sequence

from benchmarks.figures import Figure
from pemviz.config.toml_files import load_preset
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result import RunResult


def paper_figures(*, repeats: int = 3) -> Sequence[Figure]:
    """Time one repetition of the preset ``paper-algorithm``: 1,200 rollouts, 11 fits.

    Args:
        repeats: Runs, after one that is not counted; the medians are reported.
    """
    experiment = build_experiment(load_preset("paper-algorithm"))
    run(experiment)
    results = [run(experiment) for _ in range(repeats)]
    total_s = _median(results, "total")
    return (
        Figure("paper repetition, wall", total_s, "s", "at most 8, aim for 2"),
        Figure("paper repetition, simulation", _median(results, "simulation"), "s", "at most 0.5"),
        Figure("paper repetition, robustness", _median(results, "robustness"), "s"),
        Figure("paper repetition, fits", _median(results, "fit"), "s"),
        Figure("paper repetition, rollouts", 1_200 / total_s, "rollouts/s"),
    )


def _median(results: Sequence[RunResult], part: str) -> float:
    return statistics.median(result.timings_s[part] for result in results)
