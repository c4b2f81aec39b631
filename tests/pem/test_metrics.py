"""Scores against scikit-learn, and the cross-validated figures of the paper's Table I."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import brier_score_loss, log_loss, roc_auc_score

from pemviz.files.shipped import asset_path
from pemviz.pem import PemError, fit_pem, load_table
from pemviz.pem.judging.cross_validation import (
    calibration_error,
    cross_validate,
    reliability,
    score,
    split_folds,
    write_report,
)
from studies.synthetic_obstacles import main, synthetic_table, true_logit
from tests.pem.helpers import seeds


@settings(derandomize=True, deadline=None, max_examples=40)
@given(seed=seeds, count=st.integers(10, 500), ties=st.booleans())
def test_scores_agree_with_scikit_learn(seed, count, ties):
    rng = np.random.default_rng(seed)
    logit = rng.normal(2, 2, count)
    logit = np.round(logit) if ties else logit
    detected = rng.random(count) < 0.8
    detected[:2] = (True, False)
    p = 1 / (1 + np.exp(-logit))
    ours = score(logit, detected)
    assert ours.bce == pytest.approx(log_loss(detected, p), rel=1e-9)
    assert ours.roc_auc == pytest.approx(roc_auc_score(detected, logit), abs=1e-12)
    assert ours.brier == pytest.approx(brier_score_loss(detected, p), rel=1e-9)
    assert (ours.obstacles, ours.missed) == (count, (~detected).sum())


def test_calibration_error_by_hand():
    logit = np.log(np.array([0.2, 0.2, 0.6, 0.6]) / np.array([0.8, 0.8, 0.4, 0.4]))
    bins = reliability(logit, np.array([False, True, True, True]), bins=2)
    assert [each.observed for each in bins] == [0.5, 1.0]
    assert calibration_error(bins) == pytest.approx((0.3 + 0.4) / 2)


def test_one_outcome_has_no_roc_auc():
    assert score(np.zeros(3), np.ones(3, dtype=bool)).roc_auc is None


def test_the_synthetic_table_is_what_its_generator_writes(tmp_path):
    assert main([str(tmp_path / "again.csv")]) == 0
    shipped = asset_path("pem", "synthetic-obstacles.csv")
    assert (tmp_path / "again.csv").read_bytes() == shipped.read_bytes()
    table, loaded = synthetic_table(), load_table(shipped)
    np.testing.assert_array_equal(loaded.salient, table.salient)
    np.testing.assert_array_equal(loaded.detected, table.detected)
    assert loaded.digest == table.digest


def test_models_learn_the_synthetic_detector():
    table = synthetic_table(obstacles=20_000, seed=1)
    fresh = synthetic_table(obstacles=20_000, seed=2)
    truth = score(true_logit(fresh.salient), fresh.detected)
    guess = score(fit_pem(table, model="guess-mu").logit(fresh.salient), fresh.detected)
    ours = score(fit_pem(table, model="lr").logit(fresh.salient), fresh.detected)
    assert truth.bce < ours.bce < truth.bce + 0.3 * (guess.bce - truth.bce)


def test_folds_in_processes_of_their_own_give_the_same_bits():
    table = synthetic_table()
    alone, together = (cross_validate(table, model="lr", folds=2, workers=n) for n in (1, 2))
    np.testing.assert_array_equal(together.logit, alone.logit)


def test_a_report_holds_table_scores_groups_and_picture(tmp_path):
    table = synthetic_table()
    evaluations = [cross_validate(table, model=kind, folds=3) for kind in ("guess-mu", "lr")]
    paths = write_report(evaluations, table=table, folder=tmp_path / "report")
    assert [path.name for path in paths] == [
        "evaluation.md",
        "evaluation.csv",
        "evaluation.json",
        "reliability.png",
    ]
    page = paths[0].read_text()
    assert "| lr |" in page
    assert "0.244 / 0.688" in page
    assert "| Cyclist |" in page
    content = json.loads(paths[2].read_text())
    assert [model["model"] for model in content["models"]] == ["guess-mu", "lr"]
    assert sum(s["obstacles"] for s in content["models"][1]["by_distance"].values()) == len(table)
    assert paths[3].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("folds", [1, 10_000])
def test_a_number_of_folds_out_of_range_is_refused(folds):
    with pytest.raises(PemError, match=f"folds is {folds}, allowed: 2 to"):
        split_folds(synthetic_table(), folds=folds)


@pytest.mark.parametrize(
    ("kind", "bce", "bce_within", "auc", "auc_within"),
    [("guess-mu", 0.260, 0.001, 0.500, 1e-9), ("lr", 0.244, 0.002, 0.687, 0.003)],
)
def test_the_papers_baselines_are_reproduced(kitti_folder, kind, bce, bce_within, auc, auc_within):
    evaluation = cross_validate(load_table(kitti_folder), model=kind)
    assert evaluation.bce[0] == pytest.approx(bce, abs=bce_within)
    assert evaluation.roc_auc[0] == pytest.approx(auc, abs=auc_within)


TABLE = {
    "ml-nn": ((0.2235, 0.2295), (0.771, 0.783)),
    "b-nn": ((0.0, 0.238), (0.726, 1.0)),
    "gb-paper": ((0.0, 0.212), (0.813, 1.0)),
    "gb-raw": ((0.0, 0.188), (0.865, 1.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", TABLE)
def test_table_1_and_better(kitti_folder, kind, pyro_installed):
    if kind == "b-nn":
        pyro_installed()
    evaluation = cross_validate(load_table(kitti_folder), model=kind)
    (bce_low, bce_high), (auc_low, auc_high) = TABLE[kind]
    assert bce_low <= evaluation.bce[0] <= bce_high
    assert auc_low <= evaluation.roc_auc[0] <= auc_high
    if kind.startswith("gb"):
        assert evaluation.calibration_error <= 0.01
