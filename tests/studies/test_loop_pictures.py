"""The camera of the study of the detector in the loop, against answers known otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from studies.detector_in_the_loop import camera
from studies.detector_in_the_loop.bodies import GRID, NOTHING, REARS, SIZES_M
from studies.detector_in_the_loop.cars import draw_rear
from studies.detector_in_the_loop.drives import draw_drive
from studies.detector_in_the_loop.ground import DASH_M, DASH_PERIOD_M, dashes, draw_rectangle
from studies.detector_in_the_loop.hashing import normals, uniforms
from studies.detector_in_the_loop.lens import METERED, NORMALS, READ, SHOT, TONES, expose
from studies.detector_in_the_loop.light import airlight, seen
from studies.detector_in_the_loop.render import render
from studies.detector_in_the_loop.scene import AT, DOMAINS, draw_scenes

FALSE_ALARM = 1e-4


def scenes(count, domain="all", seed=3):
    return draw_scenes(DOMAINS[domain], count=count, cars=1, seeds=np.random.SeedSequence(seed))


def test_boxes_are_those_of_a_camera_matrix():
    random = np.random.default_rng(1)
    count = 200
    x_m, near_m = random.uniform(-6, 6, count), random.uniform(1.0, 80.0, count)
    heading = random.uniform(-0.2, 0.2, count)
    size_m = SIZES_M[random.integers(0, len(SIZES_M), count)]
    found = camera.boxes(x_m=x_m, near_m=near_m, heading_rad=heading, size_m=size_m)
    f = 80.0 / np.tan(np.deg2rad(32.0))
    matrix = np.array([[f, 0, 80.0], [0, f, 24.0], [0, 0, 1.0]])
    for row in range(count):
        height, width, length = size_m[row]
        points = [
            (
                x_m[row] + side * width / 2 - along * np.tan(heading[row]),
                1.65 - up,
                near_m[row] + along,
            )
            for side in (-1, 1)
            for up in (0.0, height)
            for along in (0.0, length)
        ]
        u, v, w = matrix @ np.array(points).T
        u, v = (u / w).clip(0, 160), (v / w).clip(0, 64)
        np.testing.assert_allclose(found[row], [u.min(), v.min(), u.max(), v.max()], atol=1e-9)


@pytest.mark.parametrize("z_m", [6.0, 11.3, 37.0, 120.0])
def test_a_rear_covers_the_area_that_perspective_gives_it(z_m):
    """Whole inside the image, light on black: the sum over pixels is an area, exactly."""
    body, image = 1, np.zeros((64, 160, 3), dtype=np.float64)
    colours = np.ones((7, 3))
    colours[NOTHING] = 0.0
    size_m = np.array([1.0, 1.8, 4.0])
    draw_rear(image, REARS[body], colours, 0.37, z_m, size_m)
    scale = camera.FOCAL_PX / z_m
    share = np.mean(REARS[body] != NOTHING)
    assert image[..., 1].sum() == pytest.approx(share * 1.8 * 1.0 * scale**2, rel=1e-9)
    assert REARS.shape[1:] == (GRID, GRID)


def test_a_rectangle_has_its_area_and_its_middle():
    image = np.zeros((64, 160, 3))
    draw_rectangle(image, 2.0, 20.0, 0.5, 0.3, 2.1, np.ones(3))
    scale = camera.FOCAL_PX / 20.0
    assert image[..., 0].sum() == pytest.approx(1.0 * 1.8 * scale**2)
    u = np.arange(160) + 0.5
    assert (image[..., 0].sum(0) * u).sum() / image[..., 0].sum() == pytest.approx(
        80.0 + 2.0 * scale, abs=0.05
    )


def test_dashes_are_the_integral_of_a_broken_line():
    z_m = np.linspace(0.0, 60.0, 24001)
    marked = (z_m % DASH_PERIOD_M) < DASH_M
    integral = np.concatenate([[0.0], np.cumsum(marked[:-1] * np.diff(z_m))])
    for place in range(0, z_m.size, 517):
        assert dashes(z_m[place]) == pytest.approx(integral[place], abs=0.02)


def test_contrast_fades_as_koschmieder_says():
    scene = scenes(1, "fog").values[0]
    scene[AT["extinction_per_m"]] = 0.05
    air = airlight(scene, 1)
    for z_m in (5.0, 20.0, 60.0):
        contrast = (seen(scene, 0.1 * air, z_m, 1) - air) / air
        assert contrast == pytest.approx(-0.9 * np.exp(-0.05 * z_m))


def test_an_even_image_gets_the_noise_that_is_stated():
    """False alarm below 1e-4: 30,720 values give the deviation to 0.4 %, the bound is 3 %."""
    scene = scenes(1).values[0]
    scene[AT["exposure"]], scene[AT["noise"]] = 1.0, 1.0
    luminance, out = 0.02, np.empty((64, 160, 3), dtype=np.uint8)
    image = np.full((64, 160, 3), luminance, dtype=np.float32)
    expose(image, scene, 1.0, np.uint64(77), NORMALS, TONES, out)
    value = (out / 255.0) ** 2
    gain = METERED / luminance
    stated = np.sqrt(SHOT * gain * METERED + (READ * gain) ** 2)
    assert value.mean() == pytest.approx(METERED, rel=3e-3)
    assert value.std() == pytest.approx(stated, rel=0.03)
    # neighbours, channels and rows are independent: correlations below 5 / sqrt(n)
    flat = (value - value.mean()).ravel()
    for lag in (1, 3, 5, 480):
        correlation = np.mean(flat[lag:] * flat[:-lag]) / flat.var()
        assert abs(correlation) < 5.0 / np.sqrt(flat.size)


def test_hashes_are_uniform_and_independent_over_rollouts_steps_and_purposes():
    seeds = np.arange(20_000, dtype=np.uint64)
    one, other = uniforms(seeds, 3.0, 0), normals(seeds, 4.0, 0)
    assert stats.kstest(one, "uniform").pvalue > FALSE_ALARM
    assert stats.kstest(other, "norm").pvalue > FALSE_ALARM
    for twin in (uniforms(seeds, 4.0, 0), uniforms(seeds, 3.0, 1), np.roll(one, 1)):
        assert abs(np.corrcoef(one, twin)[0, 1]) < 5.0 / np.sqrt(seeds.size)


def test_scenes_have_the_stated_distributions():
    drawn = scenes(20_000)
    weather = drawn.column("weather")
    counts = [(weather == number).sum() for number in range(3)]
    expected = np.array(DOMAINS["all"].weathers) * drawn.count
    assert stats.chisquare(counts, expected).pvalue > FALSE_ALARM
    dry = drawn.column("extinction_per_m")[weather == 0]
    assert stats.kstest(np.log(dry / 0.0008) / 0.5, "norm").pvalue > FALSE_ALARM
    dusk = drawn.column("light") == 1
    share = np.log(drawn.column("illuminance")[dusk] / 0.004) / np.log(15.0)
    assert stats.kstest(share, "uniform").pvalue > FALSE_ALARM


def test_an_image_does_not_depend_on_those_beside_it():
    drive = draw_drive(DOMAINS["all"], count=30, seeds=np.random.SeedSequence(4))
    rows, steps = np.arange(30), np.arange(30)
    every = render(*drive.at(rows, steps))
    some = np.array([17, 3, 3, 29])
    np.testing.assert_array_equal(render(*drive.at(some, steps[some])), every[some])


def test_what_changes_from_frame_to_frame_changes():
    drive = draw_drive(DOMAINS["fair"], count=1, seeds=np.random.SeedSequence(4))
    still = replace(drive, poses=drive.poses[:, :1].repeat(60, 1), travelled_m=np.zeros((1, 60)))
    first, second = render(*still.at(np.zeros(2, dtype=int), np.array([10, 11])))
    difference = first.astype(float) - second
    assert 0.0 < np.abs(difference).mean() < 12.0
