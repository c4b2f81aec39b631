"""The figures of a recording: what they are called, and that they are sane."""

from benchmarks.recording import recording_figures
from pemviz.config import ExperimentConfig


def test_size_and_cost_are_measured_on_a_small_run():
    config = ExperimentConfig(method="naive", final_rollouts=20, plan=False, measured_memory=False)
    size, ratio = recording_figures(config=config, repeats=1)
    assert size.unit == "MB"
    assert 0.01 < size.value < 1.0
    assert size.goal == "at most 8"
    assert ratio.value > 0.0
    assert ratio.goal == "at most 1.25"
