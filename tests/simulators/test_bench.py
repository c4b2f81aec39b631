import dataclasses
import math

from pemviz.bench.simulators import bench_simulators
from pemviz.config import ScenarioConfig


def test_table_names_all_figures() -> None:
    rows = bench_simulators(
        ScenarioConfig(states=5), vectorized_rollouts=10, highway_rollouts=2, repeats=1
    )
    assert [row.name for row in rows] == [
        "vectorized",
        "highway-env",
        "bare-highway-env",
        "vectorized-gain",
        "highway-env-cost",
    ]
    assert [row.unit for row in rows] == ["rollouts/s"] * 3 + ["x"] * 2
    assert all(math.isfinite(row.figure) and row.figure > 0 for row in rows)
    # One repeat leaves nothing to take medians over: the ratios are the rates'.
    rate = {row.name: row.figure for row in rows}
    assert math.isclose(rate["vectorized-gain"], rate["vectorized"] / rate["highway-env"])
    assert math.isclose(rate["highway-env-cost"], rate["bare-highway-env"] / rate["highway-env"])
    assert dataclasses.is_dataclass(rows[0])
