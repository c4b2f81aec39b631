"""Fits: same seed same bytes, normalisation from the training part, agreement with libraries."""

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from threadpoolctl import threadpool_limits

from pemviz.pem import EnsemblePem, PemEnsemble, PemError, fit_ensemble, fit_pem, load_pem, save_pem
from pemviz.pem.data.table import SalientTable
from pemviz.pem.fitting import linear_and_trees as boosting
from pemviz.pem.fitting import networks
from pemviz.pem.fitting.fit import MODEL_KINDS
from pemviz.pem.models.network import paper_inputs, pose_statistics
from pemviz.pem.models.trees import tree_features
from tests.pem.helpers import random_rows

QUICK_KINDS = [kind for kind in MODEL_KINDS if kind != "b-nn"]


def made_up_table(count=1500, seed=0) -> SalientTable:
    """Misses become likelier with distance and occlusion."""
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, count)
    logit = 4.0 - 0.04 * rows[:, 9] - rows[:, 2]
    return SalientTable(rows, rng.random(count) < 1 / (1 + np.exp(-logit)), "made up")


@pytest.fixture(scope="module")
def table():
    return made_up_table()


@pytest.mark.parametrize("kind", QUICK_KINDS)
def test_same_seed_gives_the_same_bytes_and_files_keep_every_bit(kind, table, tmp_path, quick):
    pems = [fit_pem(table, model=kind, seed=3) for _ in range(2)]
    for index, pem in enumerate(pems):
        save_pem(pem, tmp_path / f"{index}.safetensors")
    first = (tmp_path / "0.safetensors").read_bytes()
    assert first == (tmp_path / "1.safetensors").read_bytes()
    loaded = load_pem(str(tmp_path / "0.safetensors"))
    assert (loaded.name, loaded.digest) == (kind, pems[0].digest)
    np.testing.assert_array_equal(loaded.logit(table.salient), pems[0].logit(table.salient))


@pytest.mark.parametrize("kind", ["ml-nn", "gb-raw"])
def test_another_seed_gives_another_ensemble_member(kind, table, quick):
    ensemble = fit_ensemble(table, model=kind, members=3, seed=1)
    assert isinstance(ensemble, PemEnsemble)
    assert len({member.digest for member in ensemble.members}) == 3
    again = fit_ensemble(table, model=kind, members=3, seed=1)
    assert again.digest == ensemble.digest


@pytest.fixture
def quick(monkeypatch):
    """Fewer epochs and rounds: these tests are about bookkeeping."""
    monkeypatch.setattr(boosting, "ROUNDS", 15)
    monkeypatch.setattr(networks, "EPOCHS", 3)
    monkeypatch.setattr(networks, "BATCH_ROWS", 256)


def test_guess_mu_answers_with_the_share_detected(table):
    logit = fit_pem(table, model="guess-mu").logit(table.salient)
    np.testing.assert_allclose(1 / (1 + np.exp(-logit)), table.detected.mean(), rtol=1e-12)


def test_logistic_regression_agrees_with_scikit_learn(table):
    mean, std = pose_statistics(table.salient)
    inputs = paper_inputs(table.salient, pose_mean=mean, pose_std=std).T
    reference = LogisticRegression(max_iter=10_000).fit(inputs, table.detected)
    ours = fit_pem(table, model="lr").logit(table.salient)
    np.testing.assert_allclose(ours, reference.decision_function(inputs), atol=1e-10)


@pytest.mark.parametrize(("kind", "feature_set"), [("gb-paper", "paper"), ("gb-raw", "raw")])
def test_trees_agree_with_scikit_learn(kind, feature_set, table, quick):
    pem = fit_pem(table, model=kind, seed=5)
    fresh = random_rows(np.random.default_rng(9), 2000)
    features = tree_features(table.salient, feature_set=feature_set).T
    booster = HistGradientBoostingClassifier(
        max_iter=15,
        learning_rate=boosting.LEARNING_RATE,
        max_leaf_nodes=boosting.LEAVES,
        min_samples_leaf=boosting.LEAF_ROWS,
        l2_regularization=boosting.RIDGE,
        early_stopping=False,
        categorical_features=None,
        random_state=5,
    )
    with threadpool_limits(1):
        booster.fit(features, table.detected)
    raw = booster.decision_function(tree_features(fresh, feature_set=feature_set).T)
    logit = pem.logit(fresh)
    slope = pem.calibration[0]
    intercept = np.mean(logit - slope * raw)
    np.testing.assert_allclose(logit, slope * raw + intercept, atol=1e-9)
    baseline = float(np.log(table.detected.mean() / (1 - table.detected.mean())))
    # Without Platt's correction the line through the leaf sums is the booster itself.
    assert abs(pem.calibration[1] - intercept - slope * baseline) < 1e-9


def test_normalisation_comes_from_the_table_alone(table):
    far = SalientTable(table.salient + 0.0, table.detected, "moved")
    far.salient[:, 9] += 1000.0
    pem = fit_pem(far, model="lr")
    assert pem.pose_mean[2] == pytest.approx(far.salient[:, 9].mean(), rel=1e-12)


@pytest.mark.parametrize("value", [1.84, -1.57, 1.65, 0.1, 1.0e4 / 3.0])
def test_a_column_that_does_not_vary_maps_to_nothing(table, value):
    for count in (100, 1000, 2999):
        still = table.salient[np.arange(count) % len(table)].copy()
        still[:, [8, 10]] = value  # y_m, rotation_y_rad
        _, std = pose_statistics(still)
        assert std[[1, 3]].tolist() == [1.0, 1.0]
        assert (std[[0, 2]] > 1.5).all()


@pytest.mark.parametrize("model", ["guess-mu", "lr", "ml-nn", "gb-paper", "gb-raw"])
def test_a_table_with_one_outcome_is_refused(table, model):
    rows = np.flatnonzero(table.detected)
    with pytest.raises(PemError, match=r"all .* obstacles were detected"):
        fit_pem(table.take(rows), model=model)


def test_an_unknown_model_and_too_few_members_are_refused(table):
    with pytest.raises(PemError, match="unknown model 'svm', allowed: guess-mu"):
        fit_pem(table, model="svm")
    with pytest.raises(PemError, match="members is 1"):
        fit_ensemble(table, members=1)


def test_bayesian_network_learns_and_repeats(table, monkeypatch, pyro_installed):
    pyro_installed()
    monkeypatch.setattr(networks, "BAYES_STEPS", 150)
    first, second = (fit_pem(table, model="b-nn", seed=2) for _ in range(2))
    assert isinstance(first, EnsemblePem)
    assert first.digest == second.digest
    logit = first.logit(table.salient)
    share = table.detected.mean()
    guess = -(share * np.log(share) + (1 - share) * np.log(1 - share))
    ours = np.mean(np.logaddexp(0, np.where(table.detected, -logit, logit)))
    assert ours < guess - 0.02
