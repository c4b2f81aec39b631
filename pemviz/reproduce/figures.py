"""The paper's figures drawn with matplotlib, without a display."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, BLUE, GREEN, GREY, VERMILLION
from pemviz.config import ScenarioConfig
from pemviz.reproduce.experiments import LeastSafeSearch, RepetitionOutcome
from pemviz.reproduce.tables import csv_text

DOTS_PER_INCH = 150
WIDTH_IN, HEIGHT_IN = 7.0, 4.2
# colour, line, width: curves that coincide stay visible, the widest drawn first
METRIC_STYLES = {
    "classical": (BLUE, "-", 3.4),
    "agm": (VERMILLION, "--", 2.2),
    "smooth-cumulative": (GREEN, "-.", 1.8),
}
LIMIT_M = 2.0


def learned_proposal_png(
    *, gap_m: FloatArray, pem: FloatArray, proposals: Sequence[FloatArray], emergency_gap_m: float
) -> bytes:
    """P(detected) against gap: the error model and the finally learned proposals.

    Args:
        gap_m: ``[G]``.
        pem: ``[G]``.
        proposals: One curve ``[G]`` for each repetition.
        emergency_gap_m: Marked by a line.
    """
    figure, axes = _figure()
    _gap_axes(axes, gap_m, emergency_gap_m)
    for number, curve in enumerate(proposals):
        label = "learned proposal, each repetition" if number == 0 else None
        axes.plot(gap_m, curve, color=BLUE, linewidth=0.8, alpha=0.35, label=label)
    mean = np.mean(np.stack(proposals), axis=0)
    axes.plot(gap_m, mean, color=BLUE, linewidth=2.4, label="learned proposal, mean")
    axes.plot(gap_m, pem, color=BLACK, linewidth=1.8, linestyle="--", label="error model (PEM)")
    axes.set_title("The learned proposal misses where missing is dangerous", loc="left")
    axes.legend(loc="lower right", frameon=False)
    return _png(figure)


def stage_proposals_png(
    *,
    gap_m: FloatArray,
    pem: FloatArray,
    by_metric: Mapping[str, Sequence[FloatArray]],
    stage: int,
    emergency_gap_m: float,
) -> bytes:
    """P(detected) against gap after a stage, by metric: mean and spread over repetitions."""
    figure, axes = _figure()
    _gap_axes(axes, gap_m, emergency_gap_m)
    axes.plot(gap_m, pem, color=BLACK, linewidth=1.4, linestyle=":", label="error model (PEM)")
    for metric, curves in by_metric.items():
        color, line, width = METRIC_STYLES[metric]
        values = np.stack(curves)
        mean, spread = values.mean(axis=0), values.std(axis=0)
        low, high = np.clip(mean - spread, 0.0, 1.0), np.clip(mean + spread, 0.0, 1.0)
        axes.fill_between(gap_m, low, high, color=color, alpha=0.15, linewidth=0.0)
        axes.plot(gap_m, mean, color=color, linestyle=line, linewidth=width, label=metric)
    repetitions = max(len(curves) for curves in by_metric.values())
    axes.set_title(
        f"Proposals at stage {stage} by metric: mean of {repetitions}, band of one standard "
        "deviation",
        loc="left",
        fontsize="medium",
    )
    axes.legend(loc="lower right", frameon=False)
    return _png(figure)


def least_safe_png(search: LeastSafeSearch, scenario: ScenarioConfig) -> bytes:
    """Gap against time of the least safe rollout of each metric, and what each step detected."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN * 1.25), dpi=DOTS_PER_INCH, layout="constrained")
    upper, lower = figure.subplots(
        2, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, max(len(search.found), 1) * 0.35]}
    )
    for one in search.found:
        color, line, width = METRIC_STYLES[one.metric]
        time_s = np.arange(one.gap_m.size) * search.dt_s
        label = f"{one.metric} (closest: {one.gap_m.min():.2f} m)"
        upper.plot(time_s, one.gap_m, color=color, linestyle=line, linewidth=width, label=label)
    _horizontal(upper, LIMIT_M, "specified: not below 2 m", at=0.0, align="left")
    _horizontal(
        upper, scenario.emergency_gap_m, "emergency braking on a detection", at=1.0, align="right"
    )
    upper.set_ylabel("gap [m]")
    upper.set_ylim(bottom=0.0)
    upper.legend(loc="upper right", frameon=False)
    upper.set_title(
        f"Least safe of {search.rollouts - search.violating} random rollouts that hold "
        f"(of {search.rollouts} drawn)",
        loc="left",
    )
    _outcomes(lower, search)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def _outcomes(axes: Any, search: LeastSafeSearch) -> None:
    for row, one in enumerate(search.found):
        color, _, _ = METRIC_STYLES[one.metric]
        time_s = np.arange(one.detected.size) * search.dt_s
        axes.plot(time_s[one.detected], np.full(int(one.detected.sum()), row), "|",
                  color=color, markersize=8)  # fmt: skip
        missed = ~one.detected
        axes.plot(time_s[missed], np.full(int(missed.sum()), row), ".", color=GREY, markersize=3)
    axes.set_yticks(range(len(search.found)), [one.metric for one in search.found])
    axes.set_ylim(len(search.found) - 0.5, -0.5)
    axes.set_xlabel("time [s];  bar: detected, dot: missed")


def _figure() -> tuple[Any, Any]:
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _gap_axes(axes: Any, gap_m: FloatArray, emergency_gap_m: float) -> None:
    axes.set_xlim(float(gap_m[0]), float(gap_m[-1]))
    axes.set_ylim(-0.02, 1.05)
    axes.set_xlabel("gap [m]")
    axes.set_ylabel("P(detected) [-]")
    for value, text in ((LIMIT_M, "2 m"), (emergency_gap_m, f"{emergency_gap_m:g} m")):
        axes.axvline(value, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)))
        axes.annotate(text, (value, 0.0), xytext=(3, 2), textcoords="offset points",
                      color="#555555", fontsize="small")  # fmt: skip


def _horizontal(axes: Any, value: float, text: str, *, at: float, align: str) -> None:
    axes.axhline(value, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)))
    axes.annotate(text, (at, value), xycoords=("axes fraction", "data"), xytext=(0, 3),
                  textcoords="offset points", ha=align, color="#555555",
                  fontsize="small")  # fmt: skip


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    # no software version inside: the same figures give the same bytes
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


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
