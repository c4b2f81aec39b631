"""Very many plain rollouts: what may be asked for, and stages without number."""

from dataclasses import replace

import pytest

from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.runs import run_folder
from pemviz.runs.experiment import build_experiment
from pemviz.runs.reading import read_result
from pemviz.runs.run_folder import record

LARGE = ExperimentConfig(method="monte-carlo", final_rollouts=100_000_000, keep="violations")


def test_a_hundred_million_are_five_thousand_parts():
    experiment = build_experiment(LARGE)
    assert experiment.method.stages == 5_000
    assert experiment.planned_rollouts == 100_000_000


@pytest.mark.parametrize(
    ("change", "fragment"),
    [
        ({"keep": "all"}, "final_rollouts = 100000000: must be at most 10000000; more take"),
        ({"method": "naive"}, "method monte-carlo and keep = 'violations'"),
        ({"method": "mixture"}, "must be at most 10000000"),
        ({"final_rollouts": 1_000_000_001}, "final_rollouts = 1000000001"),
    ],
)
def test_more_than_can_be_kept_or_weighed_is_refused_in_a_line(change, fragment):
    with pytest.raises(ConfigError, match=fragment) as refused:
        build_experiment(replace(LARGE, **change))
    assert "\n" not in str(refused.value)


def test_a_result_of_many_stages_is_whole_at_the_end_however_rarely_it_is_written(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(run_folder, "ALWAYS_WRITTEN", 2)
    monkeypatch.setattr(run_folder, "PAUSES", 1e9)
    written = []
    write = run_folder.write_result
    monkeypatch.setattr(
        run_folder,
        "write_result",
        lambda *given, **files: written.append(given[1]) or write(*given, **files),
    )
    few = replace(LARGE, final_rollouts=40, spec="always[0,99] (gap >= 9.0)", memory_s=0.4)
    experiment = build_experiment(few)
    parts = replace(experiment, method=replace(experiment.method, largest_part=5))
    record(parts, tmp_path)
    by_stage = [len(result.stages) for result in written]
    assert by_stage[:3] == [0, 1, 2]
    assert 3 not in by_stage
    result = read_result(tmp_path)
    assert [stage.stage for stage in result.stages] == list(range(8))
    assert result.estimate.rollouts_in_estimate == 40
    assert result.estimate.failures == sum(stage.failures for stage in result.stages) > 0
