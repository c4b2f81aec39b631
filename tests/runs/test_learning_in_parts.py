"""Large stages that are learned from, held in part: the same run, in bounded memory."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.panel.loading import load_run
from pemviz.recording.recorder import Recorder
from pemviz.runs.experiment import build_experiment
from pemviz.runs.observers import KeptStages, LeastRobust
from pemviz.runs.rollout_files import load_rollouts, part_path, sampled_arrays, sampled_of
from pemviz.runs.run_folder import record
from pemviz.types import SampledRollouts
from tests.faults.test_resume import StopAfter, contents, folder_of
from tests.recording.read_back import read_stages
from tests.runs.recounts import assert_recounted

RULES = {"near": "always[0,99] (gap >= 2.0)", "far": "always[0,99] (gap >= 4.0)"}
ALL = ExperimentConfig(
    method="adaptive", stages=2, rollouts=150, final_rollouts=100, epochs=60, learning_rate=1e-2,
    memory_s=0.2, seed=4, measured_memory=False,
).with_rules(RULES)  # fmt: skip
HELD, EVEN, LISTED = 25, 10, 20


def in_parts(root, experiment, *, largest_part, sizes, stops):
    """By what is kept, folder, stages, least robust rollout, method; of few also interrupted."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pemviz.sampling.rollouts.large_stages.LARGEST_PART", largest_part)
        patch.setattr("pemviz.analysis.model_uncertainty.DATA_BOUND_ROLLOUTS", 200)
        for name, value in sizes.items():
            patch.setattr(f"pemviz.sampling.rollouts.large_stages.{name}", value)
        for name, keep in (("all", "all"), ("few", "violations"), ("resumed", "violations")):
            folder, stages, least = folder_of(root, name), KeptStages(), LeastRobust()
            one = experiment(keep)
            for stop_after in stops if name == "resumed" else ():
                stop = StopAfter(stop_after)
                record(one, folder, observers=[stop], should_stop=stop)
                if stop_after == stops[0]:
                    middle = part_path(folder, repetition=0, stage=1).read_bytes()
            recorder = Recorder(folder / "run.rrd", frames=False)
            recorders = [] if name == "resumed" else [recorder]
            record(one, folder, recorders=recorders, observers=[stages, least])
            found[name] = folder, stages.stages, least.rollout, one.method
    assert b"all.robustness" in middle
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return in_parts(
        tmp_path_factory.mktemp("parts"),
        lambda keep: build_experiment(replace(ALL, keep=keep), batch_rollouts=100),
        largest_part=60,
        sizes={"HELD": HELD, "EVEN": EVEN, "LISTED": LISTED},
        stops=(2, 4),
    )


def assert_same_whatever_is_kept(runs):
    every, few, resumed = (contents(runs[name][0]) for name in ("all", "few", "resumed"))
    assert resumed == few
    assert few["result"]["config"].pop("keep") == "violations"
    assert few["result"] == every["result"]
    assert few["proposals.safetensors"] == every["proposals.safetensors"]
    assert str(runs["few"][2]) == str(runs["all"][2])
    for folder, *_ in runs.values():
        assert_recounted(folder)
    return every


def test_a_run_tells_the_same_whatever_is_held_and_when_it_is_resumed(runs):
    every = assert_same_whatever_is_kept(runs)
    elites = [stage["elites"] for stage in every["result"]["stages"]]
    assert elites[0] == 150
    assert 8 <= elites[1] < 20
    assert sum(stage["failures"] for stage in every["result"]["stages"]) > 0


def test_stages_hold_no_more_than_what_is_looked_at(runs):
    for whole, few in zip(runs["all"][1], runs["few"][1], strict=True):
        assert (few.count, few.failures) == (whole.count, whole.failures)
        if few.kind == "final":
            assert few.sampled is None
            continue
        held, scored = few.scored.rollouts.count, whole.scored
        assert HELD <= held == few.sampled.row.size <= HELD + EVEN + 3 * LISTED < whole.count
        np.testing.assert_array_equal(few.sampled.robustness, scored.robustness)
        np.testing.assert_array_equal(few.sampled.log_weight, scored.rollouts.log_weight)
        row = few.sampled.row
        gap = few.scored.rollouts.signals["gap"]
        np.testing.assert_array_equal(gap, scored.rollouts.signals["gap"][row])
        assert not few.scored.rollouts.log_weight.flags.writeable
        for values in (row, few.sampled.robustness, few.sampled.violated, few.sampled.log_weight):
            assert not values.flags.writeable


def test_files_number_rollouts_by_their_stage(runs):
    every, few = (load_rollouts(runs[name][0]) for name in ("all", "few"))
    for stage in range(3):
        rows = few["stage"] == stage
        of_all = every["stage"] == stage
        number = few["rollout"][rows]
        assert number.size < of_all.sum() == 150
        for name, values in every.items():
            np.testing.assert_array_equal(few[name][rows], values[of_all][number], err_msg=name)
    loaded = load_run(runs["few"][0])
    assert loaded.kept == few["stage"].size < loaded.simulated == 550


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("all.every", np.array(0)),
        ("all.violated", np.ones(9)),
        ("all.robustness", np.array([0.0, np.nan, 1.0])),
        ("all.log_weight", np.array([0.0, np.inf, 1.0])),
        ("all.log_weight", np.zeros(4)),
        ("rollout", np.array([2, 1])),
        ("rollout", np.array([1, 3])),
        ("rollout", np.array([1.0, 2.0])),
    ],
)
def test_what_a_file_tells_of_all_rollouts_is_checked(name, value):
    sampled = SampledRollouts(
        np.array([0, 2]), 2, np.zeros(3), np.ones(3, dtype=np.bool_), np.zeros(3)
    )
    whole = {
        "rollout": sampled.row,
        "violated": np.ones(2, dtype=np.bool_),
        **sampled_arrays(sampled),
    }
    assert sampled_of(whole).count == 3
    assert sampled_of({"violated": whole["violated"]}) is None
    with pytest.raises(ValueError, match="does not fit together"):
        sampled_of({**whole, name: value})


def test_a_recording_tells_of_all_rollouts(runs):
    """Its curves are those of the same numbers, and figures count all."""
    every, few = (read_stages(runs[name][0] / "run.rrd") for name in ("all", "few"))
    for stage in range(3):
        found, whole = few[stage], every[stage]
        assert found.rollout.size < whole.rollout.size == 150
        rows = np.searchsorted(whole.rollout, found.rollout)
        np.testing.assert_array_equal(whole.rollout[rows], found.rollout)
        np.testing.assert_array_equal(whole.robustness[rows], found.robustness)
        np.testing.assert_allclose(whole.series["gap_m"][rows], found.series["gap_m"])
