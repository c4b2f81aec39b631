"""Position errors: the model against scipy's distributions, the fit against drawn tables."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import check_grad

from pemviz.pem import NoiseMemory, PemError, PositionErrorModel, constant_errors
from pemviz.pem.data.position_errors import PositionErrorTable, sight_errors
from pemviz.pem.fitting.position_errors import (
    _mean_nats,
    error_features,
    error_nats,
    fit_axis,
    fit_noise_memory,
    lag_pairs,
    normal_scores,
)
from pemviz.pem.judging.position_error_report import (
    FitSettings,
    fit_position_errors,
    straight_ahead,
)
from pemviz.pem.models.position_errors import ErrorAxis, standard_quantile
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS

TRUE = {
    "range": ErrorAxis(
        "range",
        mean=np.array([0.02, 0.05, 0.03, 0.0]),
        log_scale=np.array([-1.8, 0.7, 0.2, 0.1, 0.2, -0.2]),
        degrees_of_freedom=3.0,
        memory=NoiseMemory(lasting_share=0.3, tau_s=0.4),
    ),
    "cross_range": ErrorAxis(
        "cross_range",
        mean=np.array([0.0, 0.0, -0.04, 0.02]),
        log_scale=np.array([-2.2, 0.5, 0.1, 0.0, 0.3, 0.4]),
        memory=NoiseMemory(lasting_share=0.3, tau_s=0.4),
    ),
}
CORRELATION = np.array([[1.0, 0.4], [0.4, 1.0]])
MODEL = PositionErrorModel((TRUE["range"], TRUE["cross_range"]), CORRELATION)


def salient_at(random, count):
    salient = np.zeros((count, len(SALIENT_COLUMNS)))
    distance, bearing = random.uniform(5.0, 60.0, count), random.uniform(-np.pi, np.pi, count)
    salient[:, COLUMN["x_m"]] = distance * np.sin(bearing)
    salient[:, COLUMN["z_m"]] = distance * np.cos(bearing)
    salient[:, COLUMN["alpha_rad"]] = random.uniform(-np.pi, np.pi, count)
    return salient


def drawn_table(*, seed=3, tracks=400, frames=12, rate_hz=5.0):
    """Errors of MODEL, with the memory of their noise, as a table of 20 drives."""
    random = np.random.default_rng(seed)
    memory = TRUE["range"].memory
    lasting = random.standard_normal((tracks, 2))
    moving = random.standard_normal((tracks, 2))
    noise = []
    for _ in range(frames):
        noise.append(memory.noise(lasting, moving))
        moving = memory.after(moving, random.standard_normal((tracks, 2)), since_s=1 / rate_hz)
    salient = salient_at(random, tracks * frames)
    errors = MODEL.error(salient, np.concatenate(noise))
    track = np.tile(np.arange(tracks), frames)
    return PositionErrorTable(
        x_m=salient[:, COLUMN["x_m"]],
        z_m=salient[:, COLUMN["z_m"]],
        alpha_rad=salient[:, COLUMN["alpha_rad"]],
        axes=("range", "cross_range"),
        errors=errors,
        source="drawn",
        sequence=track % 20,
        track=track,
        time_s=np.repeat(np.arange(frames) / rate_hz, tracks),
    )


@pytest.fixture(scope="module")
def table():
    return drawn_table()


@pytest.fixture(scope="module")
def fitted(table):
    return fit_position_errors(table, FitSettings(name="drawn", data="drawn", licence="none"))


@pytest.mark.parametrize("freedom", [1.5, 2.6, 30.0])
def test_noise_goes_through_the_quantile_function(freedom):
    noise = np.array([-8.0, -3.0, -1e-6, 0.0, 0.7, 3.0, 8.0])
    ours = standard_quantile(noise, degrees_of_freedom=freedom)
    # the tail's probability stays, down to 6e-16: a latent stays standard normal whatever the tail
    np.testing.assert_allclose(
        stats.t.cdf(-np.abs(ours), freedom), stats.norm.cdf(-np.abs(noise)), rtol=1e-12
    )
    assert (np.sign(ours) == np.sign(noise)).all()
    assert np.isfinite(standard_quantile(np.array([-1e300, 1e300]), degrees_of_freedom=1.5)).all()
    np.testing.assert_array_equal(standard_quantile(noise, degrees_of_freedom=np.inf), noise)


def test_an_error_is_mean_and_scaled_quantile():
    """At 40 m, 30 degrees to the right, seen from its side, by hand."""
    salient = np.zeros((1, len(SALIENT_COLUMNS)))
    salient[0, COLUMN["x_m"]], salient[0, COLUMN["z_m"]] = 20.0, 40.0 * np.sqrt(0.75)
    far, side, turned = np.log(2.0), 0.5, 1.0 - np.sqrt(0.75)
    mean = (0.02 + 0.05 * far + 0.03 * side, -0.04 * side + 0.02 * turned)
    scale = (
        np.exp(-1.8 + 0.7 * far + 0.2 * far**2 + 0.1 * side + 0.2 * turned - 0.2),
        np.exp(-2.2 + 0.5 * far + 0.1 * far**2 + 0.3 * turned + 0.4),
    )
    noise = np.array([[1.3, -0.4]])
    standard = (stats.t.ppf(stats.norm.cdf(1.3), 3.0), 0.4 * 1.3 - np.sqrt(0.84) * 0.4)
    expected = [m + s * q for m, s, q in zip(mean, scale, standard, strict=True)]
    np.testing.assert_allclose(MODEL.error(salient, noise), [expected], rtol=1e-12)
    np.testing.assert_allclose(MODEL.mean(salient), [mean], rtol=1e-12)
    np.testing.assert_allclose(MODEL.sd(salient), [(scale[0] * np.sqrt(3.0), scale[1])], rtol=1e-12)
    np.testing.assert_array_equal(
        MODEL.range_error(salient, noise[:, 0]), MODEL.error(salient, noise)[:, 0]
    )


def test_rows_do_not_depend_on_the_batch():
    random = np.random.default_rng(5)
    salient, noise = salient_at(random, 7), random.standard_normal((7, 2))
    one_by_one = [MODEL.error(salient[[row]], noise[[row]])[0] for row in range(7)]
    np.testing.assert_array_equal(MODEL.error(salient, noise), one_by_one)


def test_beyond_the_training_data_it_stays_what_it_is_at_the_end():
    held = PositionErrorModel(MODEL.axes, CORRELATION, distance_m=(5.0, 50.0))
    for inside, outside in ((50.0, 400.0), (5.0, 0.01)):
        np.testing.assert_array_equal(
            held.scale(straight_ahead(inside)), held.scale(straight_ahead(outside))
        )


def test_no_spread_is_no_error_to_the_last_bit():
    random = np.random.default_rng(6)
    error = constant_errors().error(salient_at(random, 50), 9.0 * random.standard_normal((50, 2)))
    assert (error == 0.0).all()
    place = straight_ahead(20.0)
    constant = constant_errors(range_sd_m=0.5, cross_range_sd_m=0.25)
    assert constant.error(place, np.array([[2.0, -2.0]])).tolist() == [[1.0, -0.5]]


def test_errors_along_and_across_the_line_of_sight():
    x_m, z_m = np.array([0.0, 10.0, -3.0]), np.array([20.0, 0.0, 4.0])
    errors = sight_errors(
        x_m, z_m, x_error_m=np.array([0.5, 0.5, 0.5]), z_error_m=np.array([1.0, 1.0, 0.0])
    )
    # ahead: forward is away; to the right: forward is to its left; 3-4-5
    np.testing.assert_allclose(errors, [[1.0, 0.5], [0.5, -1.0], [-0.3, 0.4]], atol=1e-15)


@pytest.mark.parametrize("heavy", [False, True])
def test_the_likelihood_is_scipys_and_its_gradient_right(table, heavy):
    explained, error = error_features(table), table.errors[:, 0]
    axis = TRUE["range"] if heavy else TRUE["cross_range"]
    centre = explained.of_mean @ axis.mean
    scale = np.exp(explained.of_scale @ axis.log_scale)
    density = stats.t(3.0, centre, scale) if heavy else stats.norm(centre, scale)
    np.testing.assert_allclose(error_nats(axis, explained, error), -density.logpdf(error))
    middle = np.abs(density.cdf(error) - 0.5) < 0.499
    scores = normal_scores(axis, explained, error)
    expected = stats.norm.ppf(density.cdf(error))
    np.testing.assert_allclose(scores[middle], expected[middle], rtol=1e-8)
    values = np.concatenate([axis.mean, axis.log_scale, [np.log(3.0)] if heavy else []])
    wrong = check_grad(
        lambda v: _mean_nats(v, explained, error, 0.3, heavy)[0],
        lambda v: _mean_nats(v, explained, error, 0.3, heavy)[1],
        values,
    )
    assert wrong < 1e-4 * np.linalg.norm(_mean_nats(values + 0.1, explained, error, 0.3, heavy)[1])


@pytest.mark.parametrize("unit_m", [1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("heavy", [False, True])
def test_a_fit_is_likelier_than_what_was_drawn_from_in_whatever_unit(table, heavy, unit_m):
    """An optimum cannot lie below another point: of the likelihood and the prior together."""
    true = TRUE["range" if heavy else "cross_range"]
    drawn = replace(
        true, mean=true.mean * unit_m, log_scale=true.log_scale + np.eye(6)[0] * np.log(unit_m)
    )
    explained = error_features(table)
    error = table.errors[:, 0 if heavy else 1] * unit_m

    def nats(axis):
        prior = np.sum(axis.mean[1:] ** 2) + np.sum(axis.log_scale[1:] ** 2)
        return np.mean(error_nats(axis, explained, error)) + 0.5 * prior / len(error)

    assert nats(fit_axis(explained, error, name="range", heavy=heavy)) <= nats(drawn)


def test_a_search_that_begins_far_away_does_not_overflow(table):
    """One error of a million, far from all others: numpy's overflow is an error in these tests."""
    explained = error_features(table)
    error = np.full(len(table), 0.1)
    error[::2] = -0.1
    error[7] = 1e6
    for heavy in (False, True):
        assert np.isfinite(fit_axis(explained, error, name="range", heavy=heavy).log_scale).all()


def test_a_fit_finds_what_the_errors_are_drawn_from(fitted):
    """4,800 errors; bounds are five standard errors of such fits or more: one run in 10^5 fails."""
    for axis, true in zip(fitted.axes, MODEL.axes, strict=True):
        np.testing.assert_allclose(axis.mean, true.mean, atol=0.05)
        np.testing.assert_allclose(axis.log_scale, true.log_scale, atol=0.25)
    assert 2.4 < fitted.axes[0].degrees_of_freedom < 4.0
    assert np.isinf(fitted.axes[1].degrees_of_freedom)
    assert fitted.correlation[0, 1] == pytest.approx(0.4, abs=0.1)
    for axis in fitted.axes:
        assert axis.memory.lasting_share == pytest.approx(0.3, abs=0.15)
        assert axis.memory.tau_s == pytest.approx(0.4, abs=0.25)


def test_the_card_counts_what_is_held_out(fitted, table):
    report = fitted.card.report
    assert (report["rows"], report["groups"], report["grouped_by"]) == (4800, 20, "drives")
    heavy, light = report["axes"]
    assert heavy["nats"]["student-t"] < heavy["nats"]["gaussian"] < heavy["nats"]["constant"]
    assert light["nats"]["gaussian"] < light["nats"]["constant"]
    for axis in (heavy, light):
        assert sum(axis["pit"]) == 4800
        for tail in axis["tails"][:2]:
            assert tail["expected"] == pytest.approx(4800 * 2 * stats.norm.sf(tail["beyond"]))
            # errors hang together: up to three times the Poisson deviation
            assert abs(tail["measured"] - tail["expected"]) < 15 * np.sqrt(tail["expected"])
    # were it Gaussian, Student's t with 3 degrees of freedom would exceed four deviations too often
    assert heavy["tails"][2]["if_gaussian"] > 10 * (heavy["tails"][2]["measured"] + 1)
    inside = (table.distance_m >= 20.0) & (table.distance_m < 30.0)
    (row,) = (each for each in light["distances"] if each["low_m"] == 20.0)
    assert row["rows"] == np.count_nonzero(inside)
    assert row["sd"] == pytest.approx(np.std(table.errors[inside, 1]))
    assert row["fitted_sd"] == pytest.approx(row["sd"], rel=0.15)


def test_noise_of_one_obstacle_hangs_together_as_said():
    """Correlations of 20,000 obstacles' noise; five standard errors: one run in 10^6 fails."""
    random = np.random.default_rng(8)
    memory = NoiseMemory(lasting_share=0.25, tau_s=0.5)
    lasting, moving = random.standard_normal((2, 20_000))
    first = memory.noise(lasting, moving)
    for _ in range(4):
        moving = memory.after(moving, random.standard_normal(20_000), since_s=0.1)
    later = memory.noise(lasting, moving)
    expected = 0.25 + 0.75 * np.exp(-0.4 / 0.5)
    assert memory.correlation(0.4) == pytest.approx(expected)
    assert np.corrcoef(first, later)[0, 1] == pytest.approx(expected, abs=5 / np.sqrt(20_000))
    assert np.var(later) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 20_000))


def test_independent_noise_has_no_memory():
    random = np.random.default_rng(9)
    table = drawn_table(tracks=100)
    found = fit_noise_memory(
        random.standard_normal(len(table)), lag_pairs(table), groups=table.sequence, seed=0
    )
    assert found is not None
    assert max(np.abs(found.correlations)) < 0.2  # 300 pairs or more: three standard errors
    assert found.memory.correlation(0.2) < 0.2


def test_without_tracks_independence_is_assumed_and_tails_are_as_asked(table):
    bare = PositionErrorTable(
        table.x_m, table.z_m, None, table.axes, table.errors, "bare", sequence=table.sequence
    )
    model = fit_position_errors(bare, FitSettings("bare", "bare", "none", tails="gaussian"))
    assert np.isinf(model.axes[0].degrees_of_freedom)
    assert all(axis.memory == NoiseMemory() for axis in model.axes)
    assert all(axis["lags"] == [] for axis in model.card.report["axes"])
    assert model.axes[1].log_scale[-1] == 0.0  # headings are unknown


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": MODEL.axes[:1]}, "kinds of error are"),
        ({"correlation": np.array([[1.0, 1.0], [1.0, 1.0]])}, "positive definite"),
        ({"distance_m": (5.0, 5.0)}, "increasing"),
        ({"axes": (ErrorAxis("range", np.zeros(3), np.zeros(6)), MODEL.axes[1])}, "shapes"),
        (
            {"axes": (ErrorAxis("range", np.zeros(4), np.zeros(6), 0.5), MODEL.axes[1])},
            "must be >= 1",
        ),
    ],
)
def test_parameters_that_are_none_are_refused(change, words):
    with pytest.raises(PemError, match=words):
        PositionErrorModel(**{"axes": MODEL.axes, "correlation": CORRELATION, **change})


def test_shapes_and_memories_that_are_none_are_refused():
    with pytest.raises(PemError, match=r"noise has shape \[3, 1\], need \[3, 2\]"):
        MODEL.error(np.repeat(straight_ahead(9.0), 3, axis=0), np.zeros((3, 1)))
    with pytest.raises(PemError, match=r"lasting_share is 1\.5"):
        NoiseMemory(lasting_share=1.5)
    with pytest.raises(PemError, match="range_sd_m is -1"):
        constant_errors(range_sd_m=-1.0)


def test_what_cannot_be_fitted_is_refused(table):
    few = PositionErrorTable(
        table.x_m[:150], table.z_m[:150], None, table.axes, table.errors[:150], "few"
    )
    with pytest.raises(PemError, match="few: 150 errors, need 200"):
        error_features(few)
    with pytest.raises(PemError, match="there is no spread"):
        fit_axis(error_features(table), np.zeros(len(table)), name="range", heavy=True)
