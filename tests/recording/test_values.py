"""What a recording holds equals what the run computed, to the last bit."""

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
from scipy.special import expit

from pemviz.analysis.detection_curves import detection_curves, gap_grid
from pemviz.arrays import row_sums
from pemviz.recording import paths
from pemviz.recording.learning import curve_frame, robustness_frame, stage_axis
from pemviz.recording.plot import WITHOUT_LEGEND, Axis, Frame, decade_axis
from pemviz.recording.recorder import CURVE_STEP_M
from pemviz.recording.worst import outcome_frame
from pemviz.runs.engine import run
from pemviz.sampling.estimates.estimators import importance_sampling_estimate
from pemviz.sampling.rollouts.large_stages import weighed
from pemviz.simulators.braking.scenario import EGO_LENGTH_M
from tests.recording.conftest import LEARNING, record, with_blind_pem
from tests.recording.read_back import chunks, dots, read_stages, scalars, strips, texts, values_at

RERUN = Path(rerun_cli.__file__).parent / "rerun"


def verify(path):
    return subprocess.run([RERUN, "rrd", "verify", path], capture_output=True, check=False)


def test_rerun_verifies_the_file(learned):
    done = verify(learned.path)
    assert done.returncode == 0, done.stderr


def test_every_rollout_reads_back_exactly(learned):
    recorded = read_stages(learned.path)
    assert sorted(recorded) == [stage.stage for stage in learned.stages] == [0, 1, 2, 3]
    for stage in learned.stages:
        found, rollouts = recorded[stage.stage], stage.scored.rollouts
        np.testing.assert_array_equal(found.rollout, np.arange(rollouts.count))
        for key, name in (
            ("gap_m", "gap"),
            ("ego_speed_mps", "ego_speed"),
            ("lead_speed_mps", "lead_speed"),
        ):
            np.testing.assert_array_equal(found.series[key], rollouts.signals[name])
        np.testing.assert_array_equal(found.detected, rollouts.detected)
        np.testing.assert_array_equal(found.series["p_detected_pem"], expit(rollouts.pem_logit))
        np.testing.assert_array_equal(
            found.series["p_detected_proposal"], expit(rollouts.proposal_logit)
        )
        np.testing.assert_array_equal(found.robustness, stage.scored.robustness)
        np.testing.assert_array_equal(found.violated, stage.scored.violated)
        np.testing.assert_array_equal(found.log_weight, rollouts.log_weight)
        np.testing.assert_array_equal(found.log_p, row_sums(rollouts.log_p))


def test_rollouts_equal_those_of_the_run_folder(learned):
    arrays = np.load(learned.folder / "rollouts.npz")
    for stage, found in read_stages(learned.path).items():
        rows = arrays["stage"] == stage
        for key in ("gap_m", "ego_speed_mps", "lead_speed_mps"):
            np.testing.assert_array_equal(found.series[key], arrays[key][rows])
        for key in ("detected", "robustness", "violated"):
            np.testing.assert_array_equal(getattr(found, key), arrays[key][rows])


def test_an_optimized_recording_reads_back_the_same(learned, tmp_path):
    path = tmp_path / "optimized.rrd"
    words = [RERUN, "rrd", "optimize", learned.path, "-o", path]
    subprocess.run(words, capture_output=True, check=True)
    found = read_stages(path)
    for stage, original in read_stages(learned.path).items():
        for name in ("rollout", "robustness", "violated", "log_weight", "log_p", "detected"):
            np.testing.assert_array_equal(getattr(found[stage], name), getattr(original, name))
        assert set(found[stage].series) == set(original.series)
        for name, values in original.series.items():
            np.testing.assert_array_equal(found[stage].series[name], values)


def test_timelines_are_those_documented_and_agree(learned):
    entity = paths.rollouts(1, "gap_m")
    rows = [c for c in chunks(learned.path) if c.entity_path == entity and not c.is_static]
    batch = rows[0].to_record_batch()
    assert batch["step"].to_pylist() == list(range(100))
    assert set(batch["stage"].to_pylist()) == {1}
    dt_s = LEARNING.scenario.dt_s
    seconds = [duration.total_seconds() for duration in batch["sim_time"].to_pylist()]
    np.testing.assert_allclose(seconds, np.arange(100) * dt_s, atol=1e-6)
    for chunk in chunks(learned.path):
        assert set(chunk.timeline_names) <= {"stage", "step", "sim_time"}


def test_figures_of_each_stage_are_on_the_stage_timeline(learned):
    fields = {"threshold": "threshold", "failures": "failures", "ess": "ess", "loss": "loss",
              "log10_probability": "log10_probability"}  # fmt: skip
    for name, field in fields.items():
        rows = scalars(learned.path, paths.figure(name), paths.STAGE)
        expected = {
            stage.stage: [float(getattr(stage, field))]
            for stage in learned.stages
            if getattr(stage, field) is not None
        }
        assert rows == expected


def test_each_stages_interval_is_that_of_an_estimate_from_its_rollouts(learned):
    low = scalars(learned.path, paths.figure("log10_ci_low"), paths.STAGE)
    high = scalars(learned.path, paths.figure("log10_ci_high"), paths.STAGE)
    for stage in learned.stages:
        estimate = importance_sampling_estimate(
            weighed(stage.scored), method="adaptive", rollouts_simulated=stage.scored.rollouts.count
        )
        assert low[stage.stage] == pytest.approx([np.log10(estimate.ci_low)])
        assert high[stage.stage] == pytest.approx([np.log10(estimate.ci_high)])


def test_figures_are_drawn_of_every_stage_so_far(learned):
    for name in ("failures", "loss"):
        places = dots(learned.path, paths.part(paths.by_stage(name), "values"))
        known = [s for s in learned.stages if getattr(s, name) is not None]
        high = 1.05 * max(getattr(stage, name) for stage in known)
        frame = Frame(x=stage_axis(4), y=Axis(0.0, high, ()), shape=WITHOUT_LEGEND)
        stages, values = values_at(frame, places)
        np.testing.assert_allclose(stages, [stage.stage for stage in known], atol=1e-5)
        np.testing.assert_allclose(values, [getattr(s, name) for s in known], rtol=1e-5)


def test_estimates_are_drawn_on_powers_of_ten_with_their_intervals(learned):
    low = scalars(learned.path, paths.figure("log10_ci_low"), paths.STAGE)
    high = scalars(learned.path, paths.figure("log10_ci_high"), paths.STAGE)
    estimate = learned.result.estimate
    own = [stage.log10_probability for stage in learned.stages]
    ends = [*low.values(), *high.values(), own]
    frame = Frame(x=stage_axis(4), y=decade_axis(min(map(min, ends)), max(map(max, ends))))
    entity = paths.part(paths.ESTIMATES, "values")
    stages, values = values_at(frame, dots(learned.path, entity))
    np.testing.assert_allclose(stages, range(4), atol=1e-5)
    np.testing.assert_allclose(values, own, atol=1e-4)
    bars = strips(learned.path, entity)[::3]  # each with two caps
    for stage, bar in enumerate(bars):
        _, drawn = values_at(frame, bar)
        np.testing.assert_allclose(drawn, [low[stage][0], high[stage][0]], atol=1e-4)
    answer = strips(learned.path, paths.part(paths.ESTIMATES, "answer"))[0]
    np.testing.assert_allclose(values_at(frame, answer)[1], estimate.log10_probability, atol=1e-4)


def test_curves_against_gap_are_those_of_the_proposal_sampled_from(learned):
    experiment = with_blind_pem(LEARNING)
    simulator = experiment.problem.simulator
    for stage in learned.stages:
        expected = detection_curves(
            simulator=simulator,
            pem=experiment.problem.pem,
            proposal=stage.sampled_from,
            gap_m=gap_grid(simulator, step_m=CURVE_STEP_M),
            rollouts=stage.scored.rollouts,
        )
        frame = curve_frame(expected.gap_m)
        (strip,) = strips(learned.path, paths.stage_curve(stage.stage))
        gap_m, probability = values_at(frame, strip)
        np.testing.assert_allclose(gap_m, expected.gap_m, atol=1e-5)
        np.testing.assert_allclose(probability, expected.proposal, atol=1e-6)
    (newest,) = strips(learned.path, paths.NEWEST_CURVE)
    np.testing.assert_array_equal(newest, strip)
    (pem,) = strips(learned.path, paths.PEM_CURVE)
    np.testing.assert_allclose(values_at(frame, pem)[1], expected.pem, atol=1e-6)


def test_histogram_counts_every_rollout(learned):
    (outline,) = strips(learned.path, paths.part(paths.ROBUSTNESS, "counts"))
    robustness = learned.stages[-1].scored.robustness
    counts, edges = np.histogram(robustness, bins=(outline.shape[0] - 2) // 2)
    frame = robustness_frame(edges, highest=int(counts.max()), unit="m")
    heights = values_at(frame, outline)[1][1:-1:2]
    np.testing.assert_allclose(heights, counts, atol=1e-4)
    assert counts.sum() == LEARNING.final_rollouts


def test_least_robust_outcomes_are_recorded(learned):
    worst = learned.result.least_robust[0]
    detected = learned.stages[worst.stage].scored.rollouts.detected[worst.rollout]
    dt_s = LEARNING.scenario.dt_s
    frame = outcome_frame([f"rank {rank}" for rank in range(1, 9)], steps=detected.size, dt_s=dt_s)
    _, *strokes = strips(learned.path, paths.outcomes(1))
    at_s = [values_at(frame, stroke)[0][0] for stroke in strokes]
    np.testing.assert_allclose(at_s, (np.flatnonzero(~detected) + 0.5) * dt_s, atol=1e-4)


def test_scene_places_the_lead_car_at_the_gap_and_leaves_it_there_once_the_bumpers_touch(learned):
    worst = learned.result.least_robust[0]
    gap_m = learned.stages[worst.stage].scored.rollouts.signals["gap"][worst.rollout]
    latest = [c for c in chunks(learned.path) if c.entity_path == paths.road_car(1, 1)][-1]
    places = latest.to_record_batch()["Transform3D:translation"].to_pylist()
    touching = np.logical_or.accumulate(gap_m <= 2.0)
    assert touching.any()
    half_m = (EGO_LENGTH_M + LEARNING.scenario.lead_length_m) / 2
    between_m = np.array([row[0][0] for row in places]) - half_m
    np.testing.assert_allclose(between_m, np.where(touching, 0.0, gap_m - 2.0), atol=1e-5)


def test_recording_changes_no_digit_of_the_result(learned):
    alone = run(with_blind_pem(LEARNING), run_id="a-run")
    assert replace(alone, timings_s={}) == replace(learned.result, timings_s={})


def test_repetitions_show_the_first_in_detail_and_every_estimate(tmp_path):
    config = replace(LEARNING, method="naive", repetitions=3, final_rollouts=30)
    recorded = record(with_blind_pem(config), tmp_path)
    found = read_stages(recorded.path)
    np.testing.assert_array_equal(
        found[0].series["gap_m"], recorded.stages[0].scored.rollouts.signals["gap"]
    )
    assert "There are 3 repetitions" in texts(recorded.path)[paths.CONTENTS]
    places = dots(recorded.path, paths.part(paths.REPETITIONS, "values"))
    repetitions = recorded.result.repetitions
    ends = np.log10([end for e in repetitions for end in (e.ci_low, e.ci_high) if end > 0.0])
    frame = Frame(x=stage_axis(3), y=decade_axis(ends.min(), ends.max()))
    repetition, values = values_at(frame, places)
    np.testing.assert_allclose(repetition, [0, 1, 2], atol=1e-5)
    np.testing.assert_allclose(values, [e.log10_probability for e in repetitions], atol=1e-4)


def test_another_metric_is_recorded_too(tmp_path):
    config = replace(LEARNING, method="naive", metric="agm", final_rollouts=30)
    recorded = record(with_blind_pem(config), tmp_path)
    assert verify(recorded.path).returncode == 0
    np.testing.assert_array_equal(
        read_stages(recorded.path)[0].robustness, recorded.stages[0].scored.robustness
    )
