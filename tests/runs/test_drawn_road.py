"""What is drawn of a road: its lanes everywhere, and a ramp where it is one."""

import numpy as np
import pytest

from pemviz.runs.drawn_road import DASH_M, DASH_SPACING_M, drawn_road
from pemviz.simulators.scene import Ramp, Road

LANES_M = (-3.5, 0.0, 3.5)
MERGING = Ramp(x_m=(0.0, 50.0, 110.0), right_m=(-12.0, -7.0, -7.0), left_m=(-8.5, -3.5, -3.5))
LEAVING = Ramp(x_m=(20.0, 70.0, 120.0), right_m=(3.5, 3.5, 8.0), left_m=(7.0, 7.0, 11.5))


def ends(lines):
    return {tuple(map(tuple, line[[0, -1]].tolist())) for line in lines}


def test_outer_lines_are_solid_and_inner_ones_dashes_that_stand_still():
    road = drawn_road(Road(LANES_M), from_m=-30.0, to_m=60.0)
    assert ends(road.solid) == {((-30.0, y), (60.0, y)) for y in (-3.5, 3.5)}
    assert set(road.dashed[..., 1].ravel()) == {0.0}
    np.testing.assert_allclose(np.diff(road.dashed[..., 0], axis=1), DASH_M)
    np.testing.assert_allclose(np.diff(road.dashed[:, 0, 0]), DASH_SPACING_M)
    longer = drawn_road(Road(LANES_M), from_m=-130.0, to_m=160.0)
    assert {tuple(dash.ravel()) for dash in road.dashed} <= {
        tuple(dash.ravel()) for dash in longer.dashed
    }


@pytest.mark.parametrize(
    ("ramp", "edge_m", "beside_m", "closed"),
    [
        (MERGING, -3.5, (50.0, 110.0), ((110.0, -7.0), (110.0, -3.5))),
        (LEAVING, 3.5, (20.0, 70.0), ((20.0, 3.5), (20.0, 7.0))),
    ],
)
def test_where_a_ramp_is_beside_the_lanes_the_line_is_dashed_and_its_end_is_closed(
    ramp, edge_m, beside_m, closed
):
    road = drawn_road(Road(LANES_M, (ramp,)), from_m=-40.0, to_m=200.0)
    start_m, end_m = beside_m
    outer = {((-40.0, edge_m), (start_m, edge_m)), ((end_m, edge_m), (200.0, edge_m))}
    assert outer <= ends(road.solid)
    dashes = road.dashed[road.dashed[:, 0, 1] == edge_m][..., 0]
    assert dashes.min() >= start_m
    assert dashes.max() <= end_m
    assert len(dashes) >= (end_m - start_m) / DASH_SPACING_M - 1
    assert closed in ends(road.solid)
    # beside the lanes the ramp has no line of its own there
    drawn = [line for line in road.solid if len(line) == 2 and set(line[:, 1]) == {edge_m}]
    assert not any(start_m <= line[:, 0].mean() <= end_m for line in drawn)
    _, edges = road.asphalt
    np.testing.assert_array_equal(edges[0], np.stack([ramp.x_m, ramp.right_m], axis=1))


def test_a_road_reaches_as_far_aside_as_its_ramps():
    road = Road(LANES_M, (MERGING, LEAVING))
    assert (road.right_m, road.left_m) == (-12.0, 11.5)
    assert (Road(LANES_M).right_m, Road(LANES_M).left_m) == (-3.5, 3.5)
