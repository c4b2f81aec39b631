"""A scenario with several slots is recorded by step: whether perception errs in none of them."""

import numpy as np
from scipy.special import expit

import pemviz
from pemviz import figures
from pemviz.recording import paths
from pemviz.recording.outcomes import outcome_frame
from pemviz.runs.drawn_rollout import faultless, faultless_probability
from pemviz.simulators.slots import Slot
from tests.recording.conftest import record, strips, texts, values_at
from tests.recording.read_back import read_stages
from tests.sampling.test_slots import experiment_of


def test_outcomes_and_probabilities_are_those_of_no_error_in_any_slot(tmp_path):
    worst = pemviz.LeastRobust()
    experiment = experiment_of("false brake", method="naive", final_rollouts=40, seed=4)
    recorded = record(experiment, tmp_path, observers=[worst])
    (stage,) = recorded.stages
    rollouts = stage.scored.rollouts
    ghost = np.array([slot.nominal for slot in experiment.folding.simulator.slots])
    found = read_stages(recorded.path)[0]
    np.testing.assert_array_equal(found.detected, (rollouts.detected == ghost).all(axis=-1))
    p = expit(rollouts.pem_logit)
    expected = np.where(ghost, p, 1.0 - p).prod(axis=-1)
    np.testing.assert_allclose(found.series["p_detected_pem"], expected, rtol=1e-12)
    assert "errs in none of them" in texts(recorded.path)[paths.CONTENTS]
    index = recorded.result.least_robust[0].rollout
    right = (rollouts.detected[index] == ghost).all(axis=-1)
    np.testing.assert_array_equal(worst.rollout.missed_steps, np.flatnonzero(~right))
    for row, (name, detected) in enumerate(zip(("car", "ghost"), (True, False), strict=True), 1):
        _, *strokes = strips(recorded.path, paths.outcomes(row))
        frame = outcome_frame(["row"] * 8, steps=15, dt_s=0.1)
        at_s = [values_at(frame, stroke)[0][0] for stroke in strokes]
        errors = rollouts.detected[index][:, row - 1] != detected
        np.testing.assert_allclose(at_s, (np.flatnonzero(errors) + 0.5) * 0.1, atol=1e-4)
        np.testing.assert_array_equal(worst.rollout.right_by_slot[name], ~errors)
    assert "perception errs about car at" in str(worst)
    assert figures.robustness_distribution(stages=[stage]).axes


def test_a_report_of_a_ghost_is_an_error_and_silence_is_none():
    slots = (Slot(name="car"), Slot(name="ghost", nominal=False))
    detected = np.array([[[True, False], [True, True], [False, False]]])
    np.testing.assert_array_equal(faultless(detected, slots=slots), [[True, False, False]])
    np.testing.assert_array_equal(faultless(detected[..., 1], slots=slots[1:]), [[1, 0, 1]])
    np.testing.assert_array_equal(faultless(detected[..., 0], slots=()), detected[..., 0])
    logit = np.log(np.array([[[3.0, 1.0 / 4.0]]]))
    np.testing.assert_allclose(faultless_probability(logit, slots=slots), [[0.75 * 0.8]])
