"""Position errors drawn along tracks: marginals and correlations, and the largest of a track."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from pemviz.pem import PemError, load_position_errors
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.judging.position_error_check import cross_fitted_law, law_of_model
from pemviz.pem.judging.predictive_check import p_value
from pemviz.pem.models.position_errors import NoiseMemory, constant_errors, standard_quantile

MEMORY = NoiseMemory(lasting_share=0.4, tau_s=0.3)


def table_of(*, tracks=60, frames=12, drives=6, rate_hz=10.0, seed=0):
    """Cars straight ahead, seen from behind, with errors of 0 that are filled in later."""
    random = np.random.default_rng(seed)
    track = np.repeat(np.arange(tracks), frames)
    z_m = np.repeat(random.uniform(10.0, 60.0, tracks), frames)
    return PositionErrorTable(
        x_m=np.zeros(track.size), z_m=z_m, alpha_rad=None, axes=("range", "cross_range"),
        errors=np.zeros((track.size, 2)), source="made up", sequence=track % drives, track=track,
        time_s=np.tile(np.arange(frames), tracks) / rate_hz,
    )  # fmt: skip


def noises(law, variant, count, seed=1):
    random = np.random.default_rng(seed)
    return np.stack([law._noise(variant, random) for _ in range(count)])


@pytest.mark.parametrize(
    ("variant", "correlation"),
    [
        ("independent", lambda h: 0.0 * h),
        ("memory", lambda h: np.exp(-h / 0.3)),
        ("frailty", lambda h: 0.4 + 0.0 * h),
        ("both", MEMORY.correlation),
        ("visibility", MEMORY.correlation),
    ],
)
def test_noise_hangs_together_as_its_variant_says(variant, correlation):
    """12,000 tracks of 12 frames; correlations by lag within 5 standard errors."""
    law = law_of_model(table_of(), constant_errors(range_sd_m=1.0, memory=MEMORY))
    found = noises(law, variant, 200).reshape(-1, 12)
    assert abs(found.std() - 1.0) < 0.02
    for lag in (1, 3, 7):
        expected = float(correlation(np.array(0.1 * lag)))
        measured = np.mean(found[:, 0] * found[:, lag])
        assert abs(measured - expected) < 5.0 * np.sqrt((1.0 + expected**2) / len(found))


def test_drawn_errors_have_the_models_own_quantiles():
    """Largest errors of tracks of one frame are |mean + scale Q(u)|: Kolmogorov-Smirnov at 1e-3."""
    model = load_position_errors("pointpillars")
    table = table_of(tracks=40, frames=1)
    law = law_of_model(table, model)
    random = np.random.default_rng(3)
    largest = law.drawn("both", count=400, random=random)["largest_error_m"]
    salient = np.zeros((40, 11))
    salient[:, 9] = table.z_m
    noise = np.random.default_rng(4).standard_normal((400, 40))
    axis = model.axes[0]
    aspect = model.scale(salient)[:, 0] / np.exp(axis.log_scale[5])  # of an unknown heading
    standard = standard_quantile(noise, degrees_of_freedom=axis.degrees_of_freedom)
    expected = np.abs(model.mean(salient)[:, 0] + aspect * standard).mean(axis=1)
    assert kstest(largest, expected).pvalue > 1e-3


def test_p_values_of_errors_from_the_model_itself_are_uniform():
    """200 data sets, each with 99 draws of its own; Kolmogorov-Smirnov at 1e-3."""
    law = law_of_model(table_of(tracks=10), constant_errors(range_sd_m=1.0, memory=MEMORY))
    random = np.random.default_rng(8)
    found = []
    for _ in range(200):
        values = law.drawn("both", count=100, random=random)["largest_error_m"]
        found.append(p_value(float(values[0]), values[1:]))
    assert kstest(np.array(found) - random.random(200) / 50.0, "uniform").pvalue > 1e-3


def test_cross_fitted_laws_find_the_spread_and_how_it_hangs_together():
    table = table_of(tracks=200, frames=20, drives=10)
    law = law_of_model(table, constant_errors(range_sd_m=0.5, memory=MEMORY))
    noise = 0.5 * noises(law, "both", 1)[0]
    table.errors[:, 0] = noise
    found = cross_fitted_law(table)
    np.testing.assert_allclose(found.scale, 0.5, rtol=0.35)
    for axis in found.axes:
        assert abs(axis.memory.lasting_share - 0.4) < 0.25
    assert found.observed()["largest_of_all_m"][0] == pytest.approx(np.abs(noise).max())


def test_the_largest_error_of_a_track_is_that_of_its_rows():
    table = table_of(tracks=2, frames=3)
    table.errors[:, 0] = [0.1, -0.9, 0.2, 0.3, 0.0, -0.1]
    law = law_of_model(table, constant_errors(range_sd_m=1.0))
    assert law.observed()["largest_error_m"][0] == pytest.approx(0.6)
    assert law.observed()["largest_of_all_m"][0] == pytest.approx(0.9)


def test_errors_without_tracks_are_refused():
    table = replace(table_of(), track=None)
    with pytest.raises(PemError, match="position errors need track, frame and the rate"):
        law_of_model(table, constant_errors(range_sd_m=1.0))
