"""Large stages that mixture learns from: one answer whatever is kept, and after an interruption."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.runs.experiment import build_experiment
from pemviz.types import numbers_of
from tests.runs.test_learning_in_parts import assert_same_whatever_is_kept, in_parts

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "random_start.py"
RULES = {"near": "always[0,99] (gap >= 2.0)", "far": "always[0,99] (gap >= 4.0)"}
ALL = ExperimentConfig(
    method="mixture", stages=3, rollouts=150, final_rollouts=100, seed=4, measured_memory=False
)
STARTS = replace(ALL, spec="always[0,50] (gap >= 0.0)")
ENOUGH, EVEN, LISTED = 30, 10, 20


def of_rules(keep):
    return build_experiment(replace(ALL.with_rules(RULES), keep=keep), batch_rollouts=100)


def of_starts(keep):
    example = runpy.run_path(str(EXAMPLE))
    config, simulator = replace(STARTS, keep=keep), example["StandingCar"]()
    return build_experiment(
        config, simulator=simulator, pem=example["Camera"](), batch_rollouts=100
    )


@pytest.fixture(scope="module", params=[of_rules, of_starts])
def runs(request, tmp_path_factory):
    return in_parts(
        tmp_path_factory.mktemp("parts"),
        request.param,
        largest_part=2 * ENOUGH,
        sizes={"EVEN": EVEN, "LISTED": LISTED},
        stops=(2, 5),
    )


def test_a_run_tells_the_same_whatever_is_kept_and_when_it_is_resumed(runs):
    every = assert_same_whatever_is_kept(runs)
    assert every["result"]["model_classes"] or every["result"]["starts"]


def test_a_stage_is_over_when_enough_violate(runs):
    """With the part that brings them; otherwise all that were asked for are drawn."""
    learned = [stage for stage in runs["few"][1] if stage.kind != "final"]
    assert len(learned) == 4
    enough = runs["few"][3].enough
    part = enough // 4
    for stage in learned:
        violated, row = stage.sampled.violated, stage.sampled.row
        before = int(violated[:-part].sum())
        if stage.count < 150:
            assert before < enough <= stage.failures == int(violated.sum()) < enough + part
        assert np.isin(np.flatnonzero(violated), row).all()
        assert row.size <= enough + part + EVEN + 4 * LISTED
    assert any(stage.count < 150 for stage in learned)
    assert any(stage.scored.rollouts.count < stage.count for stage in learned)


def test_held_rollouts_are_those_of_the_whole_stage(runs):
    for whole, few in zip(runs["all"][1], runs["few"][1], strict=True):
        assert (few.count, few.failures) == (whole.count, whole.failures)
        assert whole.sampled is None
        row = numbers_of(few.scored.rollouts.count, few.sampled)
        for name, values in whole.scored.rollouts.signals.items():
            np.testing.assert_array_equal(few.scored.rollouts.signals[name], values[row])
