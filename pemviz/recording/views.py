"""The views of a recording as plain data: what is shown where, and under which title."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pemviz.recording import paths
from pemviz.recording.plot import LARGE, NORMAL, ROWS, WITHOUT_LEGEND, Shape
from pemviz.recording.scene_plan import Bounds, plan_bounds
from pemviz.simulators.scene import Road
from pemviz.types import Signal

ViewKind = Literal["text", "plot", "series", "tensor", "scene", "plan", "image"]
ContainerKind = Literal["tabs", "horizontal", "vertical", "grid"]

MOST_STAGE_TABS = 14
GRID_COLUMNS = 3
MOST_SIGNALS_IN_ROW = 4
PROBABILITY_AXIS = (-0.02, 1.03)


@dataclass(frozen=True)
class ViewSpec:
    """One view.

    Attributes:
        kind: What it draws.
        title: Names the quantities and their units.
        paths: The entities it shows; the last is its subject, without which it is left out.
        axis: Fixed range of the vertical axis.
        shape: Of a drawn plot.
        bounds: What a plan shows at first, from left to right and from top to bottom.
    """

    kind: ViewKind
    title: str
    paths: tuple[str, ...]
    axis: tuple[float, float] | None = None
    shape: Shape = NORMAL
    bounds: Bounds | None = None


@dataclass(frozen=True)
class ContainerSpec:
    """Views and containers side by side.

    Attributes:
        kind: How they are arranged.
        title: Shown on a tab.
        parts: What is inside.
        shares: Relative sizes along the arrangement.
        active: Index of the tab that is open at first.
        columns: Columns of a grid.
    """

    kind: ContainerKind
    title: str
    parts: tuple["ViewSpec | ContainerSpec", ...]
    shares: tuple[float, ...] | None = None
    active: int = 0
    columns: int = GRID_COLUMNS


@dataclass(frozen=True)
class Subject:
    """What a run is about, as far as its views depend on it.

    Attributes:
        method: Its name.
        stages: Stages of a repetition.
        repetitions: How many.
        signals: The scenario's signals.
        robustness_unit: Unit of the ranking metric; empty if it has none.
        frames: Whether highway-env's pictures are recorded.
        road: Of a scenario that tells where its cars are.
        asked: The signal that is drawn of the least robust rollouts; by default the first.
        noise: Names what was random at steps; empty: nothing was.
    """

    method: str
    stages: int
    repetitions: int
    signals: tuple[Signal, ...]
    robustness_unit: str
    frames: bool = False
    road: Road | None = None
    asked: Signal | None = None
    noise: str = ""


def all_views(subject: Subject) -> ContainerSpec:
    """The tabs, in reading order."""
    return ContainerSpec(
        kind="tabs",
        title="pemviz",
        parts=(
            _answer(subject),
            _learning(subject),
            _rollouts(subject),
            _worst(subject),
            _config(),
        ),
    )


def views_of(spec: ViewSpec | ContainerSpec) -> list[ViewSpec]:
    """All views, in order."""
    if isinstance(spec, ViewSpec):
        return [spec]
    return [view for part in spec.parts for view in views_of(part)]


def keep_views(spec: ContainerSpec, wanted: Callable[[ViewSpec], bool]) -> ContainerSpec | None:
    """The container without unwanted views and without what is then empty."""
    parts: list[ViewSpec | ContainerSpec] = []
    shares: list[float] = []
    active = 0
    for index, part in enumerate(spec.parts):
        if isinstance(part, ViewSpec):
            kept = part if wanted(part) else None
        else:
            kept = keep_views(part, wanted)
        if kept is None:
            continue
        if index <= spec.active:
            active = len(parts)
        parts.append(kept)
        shares.append(spec.shares[index] if spec.shares else 1.0)
    if not parts:
        return None
    return replace(
        spec,
        parts=tuple(parts),
        shares=tuple(shares) if spec.shares else None,
        active=active,
    )


def without_signals(spec: ContainerSpec, keys: Collection[str]) -> ContainerSpec:
    """The container without views of these signals, by their keys."""
    kept = keep_views(spec, lambda view: view.paths[0].rpartition("/")[2] not in keys)
    return spec if kept is None else kept


def shown_stages(stages: int, limit: int = MOST_STAGE_TABS) -> list[int]:
    """Stages that get a tab: all, or evenly spread ones with the first and the last."""
    if stages <= limit:
        return list(range(stages))
    return sorted({round(float(s)) for s in np.linspace(0, stages - 1, limit)})


def _bracketed(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _title(signal: Signal) -> str:
    return f"{signal.name.replace('_', ' ').capitalize()}{_bracketed(signal.unit)} against step"


def _plot(title: str, path: str, *, shape: Shape = NORMAL) -> ViewSpec:
    return ViewSpec("plot", title, (path + paths.SUBTREE,), shape=shape)


def _figure(title: str, name: str) -> ViewSpec:
    return _plot(f"{title} against stage", paths.by_stage(name), shape=WITHOUT_LEGEND)


def _estimate_view() -> ViewSpec:
    return _plot("Estimate against stage", paths.ESTIMATES)


def _robustness_view(subject: Subject) -> ViewSpec:
    title = f"Rollouts against robustness{_bracketed(subject.robustness_unit)}, newest stage"
    return _plot(title, paths.ROBUSTNESS, shape=WITHOUT_LEGEND)


def _answer(subject: Subject) -> ContainerSpec:
    plots = [_plot("How far the answer is open (line: the answer)", paths.UNCERTAINTY, shape=ROWS)]
    if subject.repetitions > 1:
        plots.append(_plot("Estimate against repetition", paths.REPETITIONS))
    plots.append(_estimate_view() if subject.stages > 1 else _robustness_view(subject))
    texts = ContainerSpec(
        "vertical",
        "Texts",
        (
            ViewSpec("text", "Answer", (paths.ANSWER,)),
            ViewSpec("text", "Warnings", (paths.WARNINGS,)),
        ),
        shares=(4.0, 1.0),
    )
    return ContainerSpec(
        "horizontal",
        "Answer",
        (texts, ContainerSpec("vertical", "Plots", tuple(plots))),
        shares=(1.0, 1.0),
    )


def _learning(subject: Subject) -> ContainerSpec:
    unit = _bracketed(subject.robustness_unit)
    proposals = _plot("P(detected) against gap, by proposal", paths.PROPOSALS, shape=LARGE)
    table = ViewSpec("text", "Stages", (paths.STAGE_TABLE,))
    robustness = _robustness_view(subject)
    if subject.stages == 1:
        curves = ContainerSpec("vertical", "Now", (proposals, table))
        return ContainerSpec("horizontal", "Learning", (curves, robustness), shares=(1.2, 1.0))
    overview = ContainerSpec(
        "horizontal",
        "Proposals and estimates",
        (proposals, ContainerSpec("vertical", "Results", (_estimate_view(), robustness))),
        shares=(1.2, 1.0),
    )
    plots = ContainerSpec(
        "grid",
        "Plots",
        (
            _figure(f"Threshold{unit}", "threshold"),
            _figure("Violations", "failures"),
            _figure("Effective sample size", "ess"),
            _figure("Loss [nats a step]", "loss"),
        ),
        columns=2,
    )
    figures = ContainerSpec("vertical", "Figures of every stage", (plots, table), shares=(1.3, 1.0))
    return ContainerSpec("tabs", "Learning", (overview, figures))


def _rollouts(subject: Subject) -> ContainerSpec:
    shown = shown_stages(subject.stages)
    tabs = tuple(_stage_rollouts(subject, stage) for stage in shown)
    return ContainerSpec("tabs", "Rollouts", tabs, active=len(tabs) - 1)


def _stage_rollouts(subject: Subject, stage: int) -> ContainerSpec:
    def path(part: str) -> str:
        return paths.rollouts(stage, part)

    signals = [
        ViewSpec("series", _title(signal), (path(signal.key),)) for signal in subject.signals
    ]
    outcomes = [
        ViewSpec(
            "series",
            "P(detected) against step",
            (path(paths.PEM_SERIES), path(paths.PROPOSAL_SERIES)),
            axis=PROBABILITY_AXIS,
        ),
        ViewSpec(
            "series",
            "Share missed against step",
            (path(paths.MISSED_SHARE),),
            axis=PROBABILITY_AXIS,
        ),
        ViewSpec(
            "tensor",
            "Missed (orange), by rollout and step",
            (path(paths.DETECTED),),
        ),
    ]
    many = len(signals) > MOST_SIGNALS_IN_ROW
    rows = (
        ContainerSpec(
            "grid" if many else "horizontal", "Signals", tuple(signals), columns=MOST_SIGNALS_IN_ROW
        ),
        ContainerSpec("horizontal", "Perception", tuple(outcomes)),
    )
    shares = (2.0, 1.0) if many else None
    return ContainerSpec("vertical", f"Stage {stage}", rows, shares=shares)


def _worst(subject: Subject) -> ContainerSpec:
    gap = subject.asked or subject.signals[0]
    scenes = _scenes(subject)
    frames = [ViewSpec("image", "Rank 1 in highway-env, from above", (paths.FRAMES,))]
    plots = ContainerSpec(
        "vertical",
        "Plots",
        (
            *(frames if subject.frames else []),
            ViewSpec(
                "series",
                f"Least robust: {_title(gap).lower()}",
                (paths.worst_series(gap.key),),
            ),
            ViewSpec(
                "series",
                "P(detected) against step, grey: model",
                (paths.WORST_DETECTION,),
                axis=PROBABILITY_AXIS,
            ),
            *([ViewSpec("series", subject.noise, (paths.WORST_NOISE,))] if subject.noise else []),
        ),
    )
    lower = ContainerSpec(
        "horizontal",
        "Outcomes",
        (
            _plot("Misses against time, by rank", paths.OUTCOMES),
            ViewSpec("text", "Ranking", (paths.WORST_SUMMARY,)),
        ),
        shares=(1.6, 1.0),
    )
    if scenes is None:
        return ContainerSpec("vertical", "Worst case", (plots, lower), shares=(1.25, 1.0))
    upper = ContainerSpec("horizontal", "Scene", (scenes, plots), shares=(1.6, 1.0))
    return ContainerSpec("vertical", "Worst case", (upper, lower), shares=(1.9, 1.0))


def _scenes(subject: Subject) -> ContainerSpec | None:
    """The least robust rollouts in 3D and from above, where the scenario tells where cars are."""
    if subject.road is None:
        return None
    title, path = "Least robust rollouts, seen from the ego car", paths.SCENE + paths.SUBTREE
    above = "Least robust rollouts from above; white: where the controller tracks a car"
    bounds = plan_bounds(subject.road)
    plan = ViewSpec("plan", above, (paths.PLAN + paths.SUBTREE,), bounds=bounds)
    return ContainerSpec(
        "vertical", "Scenes", (ViewSpec("scene", title, (path,)), plan), shares=(1.0, 1.0)
    )


def _config() -> ContainerSpec:
    left = ContainerSpec(
        "vertical",
        "About",
        (
            ViewSpec("text", "About this recording", (paths.CONTENTS,)),
            ViewSpec("text", "Provenance", (paths.PROVENANCE,)),
        ),
        shares=(1.0, 2.0),
    )
    return ContainerSpec(
        "horizontal",
        "Config",
        (
            left,
            ViewSpec("text", "Configuration", (paths.CONFIG,)),
            ViewSpec("text", "Result", (paths.RESULT,)),
        ),
    )
