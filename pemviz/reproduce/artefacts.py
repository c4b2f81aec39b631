"""What a reproduction consists of: tables and figures, each with its files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.reproduce.experiments import RepetitionOutcome
from pemviz.reproduce.figures import learned_proposal_png, least_safe_png, stage_proposals_png
from pemviz.reproduce.least_safe import LeastSafeSearch
from pemviz.reproduce.tables import Table, csv_text

Outcomes = Mapping[str, Sequence[RepetitionOutcome]]


@dataclass(frozen=True)
class Artefact:
    """A table or a figure.

    Attributes:
        name: Of its files.
        markdown: Its part of the page.
        csv: Its figures.
        png: Its picture; ``None`` for a table.
    """

    name: str
    markdown: str
    csv: str
    png: bytes | None = None

    def files(self) -> dict[str, bytes]:
        """Contents by file name."""
        contents = {f"{self.name}.csv": self.csv.encode()}
        if self.png is None:
            contents[f"{self.name}.md"] = self.markdown.encode()
        else:
            contents[f"{self.name}.png"] = self.png
        return contents


@dataclass(frozen=True)
class DetectionAxis:
    """What both figures of proposals share: gaps and the error model's curve, ``[G]``."""

    gap_m: FloatArray
    pem: FloatArray


def table_artefact(table: Table) -> Artefact:
    """A table with its files."""
    return Artefact(table.name, table.markdown(), table.csv())


def learned_proposal(
    outcomes: Sequence[RepetitionOutcome], axis: DetectionAxis, scenario: ScenarioConfig
) -> Artefact:
    """What the last learning stage of each repetition left."""
    curves = [outcome.curves[max(outcome.curves)] for outcome in outcomes]
    mean = np.mean(np.stack(curves), axis=0)
    near = (axis.gap_m >= 3.0) & (axis.gap_m <= 10.0)
    lowest = int(np.argmin(np.where(near, mean, np.inf)))
    far = axis.gap_m > 12.0
    return Artefact(
        name="learned_proposal",
        markdown=_figure_markdown(
            "learned_proposal",
            "Figure: learned proposal",
            f"P(detected) against gap, {len(curves)} repetitions with the classical metric. As in "
            "the paper's figure, the proposal detects far away (at least "
            f"{mean[far].min():.0%} beyond 12 m) and misses far more often than the error model "
            f"close up ({mean[lowest]:.0%} against {axis.pem[lowest]:.0%} at "
            f"{axis.gap_m[lowest]:.1f} m).",
        ),
        csv=_curves_csv(
            axis, {f"proposal_repetition_{n}": curve for n, curve in enumerate(curves)}
        ),
        png=learned_proposal_png(
            gap_m=axis.gap_m,
            pem=axis.pem,
            proposals=curves,
            emergency_gap_m=scenario.emergency_gap_m,
        ),
    )


def stage_proposals(
    outcomes: Outcomes, axis: DetectionAxis, scenario: ScenarioConfig, *, stage: int
) -> Artefact:
    """What a stage left, by metric, averaged over the repetitions."""
    by_metric = {
        metric: [one.curves[min(stage, max(one.curves))] for one in ones]
        for metric, ones in outcomes.items()
    }
    return Artefact(
        name=f"proposals_stage_{stage}",
        markdown=_figure_markdown(
            f"proposals_stage_{stage}",
            f"Figure: proposals at stage {stage}",
            "P(detected) against gap after the same number of stages under each metric: where a "
            "metric's curve is lower, it has already learned to miss. "
            f"{_lowest_words(axis, by_metric)}",
        ),
        csv=_curves_csv(
            axis,
            {f"{metric}_mean": np.mean(np.stack(c), axis=0) for metric, c in by_metric.items()}
            | {f"{metric}_spread": np.std(np.stack(c), axis=0) for metric, c in by_metric.items()},
        ),
        png=stage_proposals_png(
            gap_m=axis.gap_m,
            pem=axis.pem,
            by_metric=by_metric,
            stage=stage,
            emergency_gap_m=scenario.emergency_gap_m,
        ),
    )


def least_safe(search: LeastSafeSearch, scenario: ScenarioConfig) -> Artefact:
    """The least safe rollouts that hold."""
    if not search.found:
        text = f"All of {search.rollouts} random rollouts violate: there is none to show."
        return Artefact("least_safe", f"## Figure: least safe rollouts\n\n{text}\n", "time_s\n")
    states = search.found[0].gap_m.size
    columns: dict[str, list[float | int | str]] = {
        "time_s": [step * search.dt_s for step in range(states)]
    }
    for one in search.found:
        columns[f"{one.metric}_gap_m"] = one.gap_m.tolist()
        columns[f"{one.metric}_detected"] = [*one.detected.astype(int).tolist(), ""]
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    described = "; ".join(
        f"{one.metric}: rollout {one.rollout}, closest {one.gap_m.min():.2f} m, below "
        f"{scenario.emergency_gap_m:g} m for "
        f"{np.sum(one.gap_m < scenario.emergency_gap_m) * search.dt_s:.2f} s, robustness "
        f"{one.robustness:.3g}"
        for one in search.found
    )
    return Artefact(
        name="least_safe",
        markdown=_figure_markdown(
            "least_safe",
            f"Figure: least safe of {search.rollouts} random rollouts",
            f"Drawn with P(detected) = 0.5; {search.violating} violate, and each metric ranks the "
            f"other {search.rollouts - search.violating}, as the authors did. {described}.",
        ),
        csv=csv_text(list(columns), rows),
        png=least_safe_png(search, scenario),
    )


def _figure_markdown(name: str, title: str, text: str) -> str:
    return f"## {title}\n\n![{title}]({name}.png)\n\n{text}\n"


def _curves_csv(axis: DetectionAxis, curves: Mapping[str, FloatArray]) -> str:
    table = np.column_stack([axis.gap_m, axis.pem, *curves.values()])
    return csv_text(["gap_m", "p_detected_pem", *curves], table.tolist())


def _lowest_words(axis: DetectionAxis, by_metric: Mapping[str, Sequence[FloatArray]]) -> str:
    words: list[str] = []
    for metric, curves in by_metric.items():
        mean = np.mean(np.stack(curves), axis=0)
        place = int(np.argmin(mean))
        words.append(f"{metric} is lowest at {axis.gap_m[place]:.1f} m ({mean[place]:.0%})")
    return "; ".join(words) + "."
