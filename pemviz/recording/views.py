"""The views of a recording: what is shown where, as plain data, and as a rerun blueprint."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import rerun.blueprint as rrb

from pemviz.charts.chart import with_unit
from pemviz.recording import paths
from pemviz.recording.plot import LARGE, NORMAL, ROWS, WITHOUT_LEGEND, Shape, named_rows
from pemviz.recording.scene_plan import Bounds, plan_bounds
from pemviz.recording.stream import blueprint_of
from pemviz.simulators.scene import Road
from pemviz.types import Signal

ViewKind = Literal["text", "plot", "series", "tensor", "scene", "plan", "image"]
ContainerKind = Literal["tabs", "horizontal", "vertical", "grid"]

MOST_STAGE_TABS = 14
MOST_SIGNALS_IN_ROW = 4
PROBABILITY_AXIS = (-0.02, 1.03)
EYE_M = (-8.0, -13.0, 11.0)
LOOK_AT_M = (8.5, 5.0, 0.0)
FROM_ABOVE = 3
"""Of the least robust rollouts, seen from above in a tab each; more tabs than fit a small window
show no more of what goes wrong, and each takes 30 kB."""
STRIP_SHARE = 0.25
"""Of the height that the scene has below the answer in short."""
LEGEND_CORNERS = {paths.MISSED_SHARE: rrb.Corner2D.RightTop}
"""Of plots with few curves: where these hardly ever run."""


@dataclass(frozen=True)
class ViewSpec:
    """One view; its title names the quantities and their units.

    Attributes:
        paths: The entities it shows; the last is its subject, without which it is left out.
        axis: Fixed range of the vertical axis.
        shape: Of a drawn plot.
        bounds: What a plan shows at first, from left to right and from top to bottom.
        is_strip: Whether its title is left out, as it says what it is.
    """

    kind: ViewKind
    title: str
    paths: tuple[str, ...]
    axis: tuple[float, float] | None = None
    shape: Shape = NORMAL
    bounds: Bounds | None = None
    is_strip: bool = False


@dataclass(frozen=True)
class ContainerSpec:
    """Views and containers side by side, in ``shares`` of its size; tab ``active`` is open."""

    kind: ContainerKind
    title: str
    parts: tuple["ViewSpec | ContainerSpec", ...]
    shares: tuple[float, ...] | None = None
    active: int = 0
    columns: int = 0


@dataclass(frozen=True)
class Subject:
    """What a run is about, as far as its views depend on it.

    Attributes:
        robustness_unit: Unit of the ranking metric; empty if it has none.
        film: Title of the least robust rollout's film; empty: there is none.
        road: Of a scenario that tells where its cars are.
        signal: The one that is drawn of the least robust rollouts; by default the first.
        noise: Names what was random at steps; empty: nothing was.
        rows: Names of the rows that tell when a rollout's outcomes were wrong.
    """

    stages: int
    repetitions: int
    signals: tuple[Signal, ...]
    robustness_unit: str
    film: str = ""
    road: Road | None = None
    signal: Signal | None = None
    noise: str = ""
    rows: tuple[str, ...] = ("rank 1",)


def all_views(subject: Subject) -> ContainerSpec:
    """The tabs: first what happens, with the answer as a strip above, then curves, then text."""
    curves = (_learning(subject), _rollouts(subject))
    tabs = (*_worst(subject), *curves, _answer(subject), _config())
    return ContainerSpec("tabs", "pemviz", tabs)


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
    new_shares = tuple(shares) if spec.shares else None
    return replace(spec, parts=tuple(parts), shares=new_shares, active=active)


def without_signals(spec: ContainerSpec, keys: Collection[str]) -> ContainerSpec:
    """The container without views of these signals, by their keys."""
    kept = keep_views(spec, lambda view: view.paths[0].rpartition("/")[2] not in keys)
    return spec if kept is None else kept


def views_with_data(views: ContainerSpec, logged: Collection[str]) -> ContainerSpec:
    """The views without those that would be empty."""
    with_data = keep_views(views, lambda view: shown(view.paths[-1], logged))
    return views if with_data is None else with_data


def shown(path: str, logged: Collection[str]) -> bool:
    """Whether something was logged that a view's path, or its subtree ``path/**``, shows."""
    if path.endswith(paths.SUBTREE):
        root = path.removesuffix(paths.SUBTREE)
        return any(entity == root or entity.startswith(f"{root}/") for entity in logged)
    return path in logged


def shown_stages(stages: int, limit: int = MOST_STAGE_TABS) -> list[int]:
    """Stages that get a tab: all, or evenly spread ones with the first and the last."""
    if stages <= limit:
        return list(range(stages))
    return sorted({round(float(s)) for s in np.linspace(0, stages - 1, limit)})


def _title(signal: Signal) -> str:
    name = signal.name.replace("_", " ").capitalize()
    return f"{with_unit(name, signal.unit)} against step"


def _text(title: str, path: str) -> ViewSpec:
    return ViewSpec("text", title, (path,))


def _plot(title: str, path: str, *, shape: Shape = NORMAL) -> ViewSpec:
    return ViewSpec("plot", title, (path + paths.SUBTREE,), shape=shape)


def _beside(
    title: str, *parts: ViewSpec | ContainerSpec, shares: tuple[float, ...] | None = None
) -> ContainerSpec:
    return ContainerSpec("horizontal", title, parts, shares=shares)


def _below(
    title: str, *parts: ViewSpec | ContainerSpec, shares: tuple[float, ...] | None = None
) -> ContainerSpec:
    return ContainerSpec("vertical", title, parts, shares=shares)


def _estimate_view() -> ViewSpec:
    return _plot("Estimate against stage", paths.ESTIMATES)


def _robustness_view(subject: Subject) -> ViewSpec:
    axis = with_unit("robustness", subject.robustness_unit)
    title = f"Rollouts against {axis}, newest stage"
    return _plot(title, paths.ROBUSTNESS, shape=WITHOUT_LEGEND)


def _answer(subject: Subject) -> ContainerSpec:
    plots = [_plot("How far the answer is open (line: the answer)", paths.UNCERTAINTY, shape=ROWS)]
    if subject.repetitions > 1:
        plots.append(_plot("Estimate against repetition", paths.REPETITIONS))
    plots.append(_estimate_view() if subject.stages > 1 else _robustness_view(subject))
    answer, warnings = _text("Answer", paths.ANSWER), _text("Warnings", paths.WARNINGS)
    texts = _below("Texts", answer, warnings, shares=(4.0, 1.0))
    return _beside("Answer", texts, _below("Plots", *plots), shares=(1.0, 1.0))


def _learning(subject: Subject) -> ContainerSpec:
    proposals = _plot("P(detected) against gap, by proposal", paths.PROPOSALS, shape=LARGE)
    table, robustness = _text("Stages", paths.STAGE_TABLE), _robustness_view(subject)
    if subject.stages == 1:
        curves = _below("Now", proposals, table)
        return _beside("Learning", curves, robustness, shares=(1.2, 1.0))
    results = _below("Results", _estimate_view(), robustness)
    overview = _beside("Proposals and estimates", proposals, results, shares=(1.2, 1.0))
    titles = {
        "threshold": with_unit("Threshold", subject.robustness_unit),
        "failures": "Violations",
        "ess": "Effective sample size",
        "loss": "Loss [nats a step]",
    }
    plots = tuple(
        _plot(f"{title} against stage", paths.by_stage(name), shape=WITHOUT_LEGEND)
        for name, title in titles.items()
    )
    grid = ContainerSpec("grid", "Plots", plots, columns=2)
    figures = _below("Figures of every stage", grid, table, shares=(1.3, 1.0))
    return ContainerSpec("tabs", "Learning", (overview, figures))


def _rollouts(subject: Subject) -> ContainerSpec:
    tabs = tuple(_stage_rollouts(subject, stage) for stage in shown_stages(subject.stages))
    return ContainerSpec("tabs", "Rollouts", tabs, active=len(tabs) - 1)


def _stage_rollouts(subject: Subject, stage: int) -> ContainerSpec:
    signals = tuple(
        ViewSpec("series", _title(signal), (paths.rollouts(stage, signal.key),))
        for signal in subject.signals
    )
    pem, proposal, missed, detected = (
        paths.rollouts(stage, name)
        for name in (paths.PEM_SERIES, paths.PROPOSAL_SERIES, paths.MISSED_SHARE, paths.DETECTED)
    )
    perception = _beside(
        "Perception",
        ViewSpec("series", "P(detected) against step", (pem, proposal), axis=PROBABILITY_AXIS),
        ViewSpec("series", "Share missed against step", (missed,), axis=PROBABILITY_AXIS),
        ViewSpec("tensor", "Missed (orange), by rollout and step", (detected,)),
    )
    many = len(signals) > MOST_SIGNALS_IN_ROW
    kind = "grid" if many else "horizontal"
    above = ContainerSpec(kind, "Signals", signals, columns=MOST_SIGNALS_IN_ROW)
    return _below(f"Stage {stage}", above, perception, shares=(2.0, 1.0) if many else None)


def _worst(subject: Subject) -> tuple[ContainerSpec, ...]:
    """The least robust rollouts, in 3D and from above where the scenario tells where cars are."""
    signal = subject.signal or subject.signals[0]
    path, title = paths.worst_series(signal.key), f"Least robust: {_title(signal).lower()}"
    strip = ViewSpec("text", "Answer in short", (paths.STRIP,), is_strip=True)
    plots = (
        _plot("Misses against time, by rank", paths.OUTCOMES, shape=named_rows(subject.rows)),
        ViewSpec("series", title, (path,)),
    )
    title, path = "Rank 1: P(detected) against step, grey: error model", paths.WORST_DETECTION
    curves = [ViewSpec("series", title, (path,), axis=PROBABILITY_AXIS)]
    if subject.film:
        curves.insert(0, ViewSpec("image", subject.film, (paths.FRAMES,)))
    if subject.noise:
        curves.append(ViewSpec("series", subject.noise, (paths.WORST_NOISE,)))
    ranking = _text("Ranking", paths.WORST_SUMMARY)
    ranked = _beside("Ranked", _below("Curves", *curves), ranking, shares=(1.2, 1.0))
    if subject.road is None:
        upper = _beside("Plots", *plots)
        return (_below("Worst case", strip, upper, ranked, shares=(STRIP_SHARE, 0.8, 0.8)),)
    scene = ViewSpec("scene", "Least robust rollouts in 3D", (paths.SCENE + paths.SUBTREE,))
    bounds = plan_bounds(subject.road)
    plans = tuple(
        ViewSpec("plan", f"Rank {rank}" if rank == 1 else f"{rank}",
                 (paths.plan(rank) + paths.SUBTREE,), bounds=bounds)
        for rank in range(1, FROM_ABOVE + 1)
    )  # fmt: skip
    plan = ContainerSpec("tabs", "From above, by rank", plans)
    upper = _beside(
        "Least robust", scene, _below("Plots", *plots, shares=(1.3, 1.0)), shares=(1.6, 1.0)
    )
    first = _below("Scene", strip, upper, plan, shares=(STRIP_SHARE, 1.0, 0.55))
    return first, replace(ranked, title="Worst case")


def _config() -> ContainerSpec:
    about = _text("About this recording", paths.CONTENTS)
    provenance = _text("Provenance", paths.PROVENANCE)
    config, result = _text("Configuration", paths.CONFIG), _text("Result", paths.RESULT)
    return _beside("Config", _below("About", about, provenance, shares=(1.0, 2.0)), config, result)


def blueprint(views: ContainerSpec) -> rrb.Blueprint:
    """The blueprint of these tabs; panels folded, time panel on ``step``."""
    time_panel = rrb.TimePanel(timeline=paths.STEP, state="collapsed", play_state="paused")
    return blueprint_of(_container(views), time_panel)


def _container(spec: ContainerSpec) -> rrb.Container:
    parts: list[Any] = [
        _view(part) if isinstance(part, ViewSpec) else _container(part) for part in spec.parts
    ]
    shares = list(spec.shares) if spec.shares else None
    match spec.kind:
        case "tabs":
            return rrb.Tabs(*parts, name=spec.title, active_tab=spec.active)
        case "horizontal":
            return rrb.Horizontal(*parts, name=spec.title, column_shares=shares)
        case "vertical":
            return rrb.Vertical(*parts, name=spec.title, row_shares=shares)
        case "grid":
            return rrb.Grid(*parts, name=spec.title, grid_columns=spec.columns)


def _view(spec: ViewSpec) -> rrb.View:
    """A view; one of a single entity has it as origin, for short legends."""
    first = spec.paths[0].removesuffix(paths.SUBTREE)
    common: dict[str, Any] = {
        "name": spec.title,
        "origin": first if len(spec.paths) == 1 else first.rpartition("/")[0],
        "contents": [f"+ {path}" for path in spec.paths],
    }
    match spec.kind:
        case "text":
            return rrb.TextDocumentView(**common, titlebar=not spec.is_strip)
        case "image":
            return rrb.Spatial2DView(**common)
        case "plot" | "plan":
            x, y = spec.bounds or (spec.shape.bounds_x, spec.shape.bounds_y)
            bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
            return rrb.Spatial2DView(**common, visual_bounds=bounds)
        case "series":
            corner = LEGEND_CORNERS.get(first.rpartition("/")[2])
            return rrb.TimeSeriesView(
                **common,
                axis_y=rrb.ScalarAxis(range=spec.axis) if spec.axis else None,
                plot_legend=rrb.PlotLegend(corner, visible=corner is not None),
            )
        case "tensor":
            mapping = rrb.TensorScalarMapping(colormap="spectral", mag_filter="nearest")
            return rrb.TensorView(**common, scalar_mapping=mapping, view_fit="fill")
        case "scene":
            eye = rrb.EyeControls3D(
                kind=rrb.Eye3DKind.Orbital,
                position=EYE_M,
                look_target=LOOK_AT_M,
                eye_up=(0, 0, 1),
            )
            grid = rrb.LineGrid3D(visible=False)
            return rrb.Spatial3DView(**common, line_grid=grid, eye_controls=eye)
