"""The views as a rerun blueprint."""

from collections.abc import Callable, Collection
from typing import Any

import rerun.blueprint as rrb

from pemviz.recording import paths
from pemviz.recording.views import ContainerSpec, ViewKind, ViewSpec, keep_views

EYE_M = (-7.0, -13.0, 10.0)
LOOK_AT_M = (11.0, 6.0, 0.0)
LEGEND_CORNERS = {
    paths.MISSED_SHARE: rrb.Corner2D.RightTop,
}
"""Of plots with few curves: where these hardly ever run."""
PLOT_BACKGROUND = (13, 16, 17)
"""That of the viewer's own plots."""


def blueprint(views: ContainerSpec) -> rrb.Blueprint:
    """The blueprint of these tabs; panels folded, time panel on ``step``."""
    return rrb.Blueprint(
        _container(views),
        rrb.TimePanel(timeline=paths.STEP, state="collapsed", play_state="paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def shown(path: str, logged: Collection[str]) -> bool:
    """Whether something was logged that a view's path, or its subtree ``path/**``, shows."""
    if path.endswith(paths.SUBTREE):
        root = path.removesuffix(paths.SUBTREE)
        return any(entity == root or entity.startswith(f"{root}/") for entity in logged)
    return path in logged


def views_with_data(views: ContainerSpec, logged: Collection[str]) -> ContainerSpec:
    """The views without those that would be empty."""
    with_data = keep_views(views, lambda view: shown(view.paths[-1], logged))
    return views if with_data is None else with_data


def _container(spec: ContainerSpec) -> rrb.Container:
    parts = [_part(part) for part in spec.parts]
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


def _part(spec: ViewSpec | ContainerSpec) -> Any:
    return _view(spec) if isinstance(spec, ViewSpec) else _container(spec)


def _view(spec: ViewSpec) -> rrb.View:
    return VIEWS[spec.kind](spec, _common(spec))


def _common(spec: ViewSpec) -> dict[str, Any]:
    """Origin and contents; a view of one entity has it as origin, for short legends."""
    first = spec.paths[0].removesuffix(paths.SUBTREE)
    origin = first if len(spec.paths) == 1 else first.rpartition("/")[0]
    return {
        "name": spec.title,
        "origin": origin,
        "contents": [f"+ {path}" for path in spec.paths],
    }


def _series(spec: ViewSpec, common: dict[str, Any]) -> rrb.View:
    corner = LEGEND_CORNERS.get(spec.paths[0].rpartition("/")[2])
    return rrb.TimeSeriesView(
        **common,
        axis_y=rrb.ScalarAxis(range=spec.axis) if spec.axis else None,
        plot_legend=rrb.PlotLegend(corner, visible=corner is not None),
    )


def _tensor(spec: ViewSpec, common: dict[str, Any]) -> rrb.View:  # noqa: ARG001
    return rrb.TensorView(
        **common,
        scalar_mapping=rrb.TensorScalarMapping(colormap="spectral", mag_filter="nearest"),
        view_fit="fill",
    )


def _scene(spec: ViewSpec, common: dict[str, Any]) -> rrb.View:  # noqa: ARG001
    return rrb.Spatial3DView(
        **common,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=EYE_M,
            look_target=LOOK_AT_M,
            eye_up=(0, 0, 1),
        ),
    )


def _plan(spec: ViewSpec, common: dict[str, Any]) -> rrb.View:
    x, y = spec.bounds or ((0.0, 1.0), (0.0, 1.0))
    return rrb.Spatial2DView(
        **common,
        background=PLOT_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=x, y_range=y),
    )


def _plot(spec: ViewSpec, common: dict[str, Any]) -> rrb.View:
    return rrb.Spatial2DView(
        **common,
        background=PLOT_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=spec.shape.bounds_x, y_range=spec.shape.bounds_y),
    )


VIEWS: dict[ViewKind, Callable[[ViewSpec, dict[str, Any]], rrb.View]] = {
    "text": lambda _, common: rrb.TextDocumentView(**common),
    "plot": _plot,
    "series": _series,
    "tensor": _tensor,
    "scene": _scene,
    "plan": _plan,
    "image": lambda _, common: rrb.Spatial2DView(**common),
}
