"""The detector of the study, its labels and files, and the loop that it drives in."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.stats import binomtest

from pemviz.matching import assign_boxes, iou, matched
from pemviz.pem.data.detections import read_sequence_detections
from pemviz.pem.data.kitti_labels import read_tracking_labels
from studies.detector_in_the_loop.detector import (
    MOST,
    Detections,
    Detector,
    Network,
    load_detector,
    ready,
    save_network,
)
from studies.detector_in_the_loop.drives import draw_drive
from studies.detector_in_the_loop.hashing import uniforms
from studies.detector_in_the_loop.labelled import write_sequences
from studies.detector_in_the_loop.loop import Loop
from studies.detector_in_the_loop.render import render
from studies.detector_in_the_loop.scene import DOMAINS, draw_scenes
from studies.detector_in_the_loop.settings import FAR, Setting
from studies.detector_in_the_loop.splitting import of_runs, split_run
from studies.detector_in_the_loop.training import curve, targets
from studies.detector_in_the_loop.truth import exact_interval
from studies.detector_in_the_loop.worlds import BrakingWorld, CutInWorld


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(5)
    made = Network()
    for layer in made.modules():  # as if trained: normalisations that do something
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.uniform_(-0.2, 0.2)
            layer.running_var.uniform_(0.5, 2.0)
    return made.eval()


def pictures(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 64, 160, 3), dtype=np.uint8)


def test_folding_normalisations_changes_nothing(network):
    images = torch.rand(3, 3, 64, 160) * 2 - 1
    with torch.inference_mode():
        np.testing.assert_allclose(ready(network)(images), network(images), atol=1e-4)


def test_what_is_detected_does_not_depend_on_the_images_beside(network):
    detector, images = Detector(ready(network), 0.5), pictures(150)
    every = detector.detect(images)
    order = np.random.default_rng(2).permutation(150)[:83]
    some = detector.detect(images[order])
    np.testing.assert_array_equal(some.score, every.score[order])
    np.testing.assert_array_equal(some.box_px, every.box_px[order])


def test_a_detector_is_read_back_as_it_was(network, tmp_path):
    save_network(network, tmp_path / "own.safetensors", threshold=0.37)
    again = load_detector(tmp_path / "own.safetensors")
    images = pictures(5)
    assert again.threshold == 0.37
    wanted = Detector(ready(network), 0.37).detect(images)
    np.testing.assert_array_equal(again.detect(images).score, wanted.score)


def random_boxes(random, shape, *, side):
    low = random.uniform(0, 40, (*shape, 2))
    return np.concatenate([low, low + random.uniform(4, side, (*shape, 2))], axis=-1)


def test_matching_is_that_of_pem_collect():
    random = np.random.default_rng(3)
    labelled = random_boxes(random, (400, 3), side=40)
    visible = random.random((400, 3)) < 0.8
    score = np.sort(random.random((400, MOST)), axis=1)[:, ::-1]
    found = Detections(random_boxes(random, (400, MOST), side=40), score)
    hits = matched(
        labelled,
        found.box_px,
        obstacle_counts=visible,
        detection_counts=score >= 0.6,
        above=0.3,
    )
    for row in range(400):
        kept = found.box_px[row][score[row] >= 0.6]
        own = labelled[row][visible[row]]
        wanted, _ = assign_boxes([tuple(b) for b in own], [tuple(b) for b in kept])
        np.testing.assert_array_equal(hits[row][visible[row]], wanted > 0.3)
        assert not hits[row][~visible[row]].any()


def test_overlaps_are_areas_of_cells():
    one, other = np.array([[[2, 3, 12, 9]]]), np.array([[[6, 1, 20, 7]]])
    cells = np.zeros((2, 30, 30), dtype=bool)
    cells[0, 3:9, 2:12] = cells[1, 1:7, 6:20] = True
    wanted = (cells[0] & cells[1]).sum() / (cells[0] | cells[1]).sum()
    assert iou(one.astype(float), other.astype(float))[0, 0, 0] == pytest.approx(wanted)


def test_precision_and_recall_of_a_case_by_hand():
    """Two cars: the first, nothing, the second, and the first once more."""
    cars = np.array([[[0, 0, 10, 10], [50, 0, 60, 10]]], dtype=float)
    boxes = np.zeros((1, MOST, 4))
    boxes[0, :4] = [[1, 0, 10, 10], [90, 0, 99, 9], [50, 1, 60, 10], [0, 1, 10, 10]]
    score = np.zeros((1, MOST))
    score[0, :4] = [0.9, 0.8, 0.7, 0.6]
    quality = curve(Detections(boxes, score), cars, np.ones((1, 2), dtype=bool))
    np.testing.assert_allclose(quality.precision, [1, 1 / 2, 2 / 3, 2 / 4])
    np.testing.assert_allclose(quality.recall, [1 / 2, 1 / 2, 1, 1])
    assert quality.average_precision == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert quality.best_f1() == 0.7


def test_targets_put_the_nearer_car_before_the_farther_one():
    box = np.array([[[40.0, 20.0, 80.0, 50.0], [48.0, 20.0, 72.0, 40.0]]])
    score, boxes, counts = targets(box, np.ones((1, 2), dtype=bool))
    assert score[0, 8, 14] == 1.0  # row 34, column 58
    np.testing.assert_array_equal(boxes[0, 8, 14], box[0, 0])
    assert counts.min() == 1.0


def test_labels_and_detections_are_read_back(network, tmp_path):
    seeds = np.random.SeedSequence(8)
    detector = Detector(ready(network), 0.5)
    write_sequences(DOMAINS["all"], detector, tmp_path, count=3, seeds=seeds)
    block = np.random.SeedSequence(seeds.entropy, spawn_key=(0,))
    drive = draw_drive(DOMAINS["all"], count=20, seeds=block)

    def refuse(error):
        raise error

    for sequence in range(3):
        labels = drive.labels(np.full(60, sequence), np.arange(60))
        read = read_tracking_labels(tmp_path / f"label_02/{sequence:06d}.txt", on_bad_line=refuse)
        assert [(each.frame, each.track) for each in read] == list(
            zip(*np.nonzero(labels.visible), strict=True)
        )
        for each in read:
            place = (each.frame, each.track)
            np.testing.assert_allclose(each.obstacle.box_px, labels.box_px[place], atol=6e-4)
            x_m, _, z_m = each.obstacle.location_m
            assert (x_m, z_m) == pytest.approx((labels.x_m[place], labels.z_m[place]), abs=6e-4)
        found = detector.detect(render(*drive.at(np.full(60, sequence), np.arange(60))))
        told = read_sequence_detections(
            tmp_path / f"boxes/{sequence:06d}.txt", sequence_format="mot", on_bad_line=refuse
        )
        for frame in range(60):
            kept = found.score[frame] > 0.0
            own = told.get(frame, [])
            np.testing.assert_allclose(
                [one.score for one in own], found.score[frame][kept], atol=6e-6
            )


def test_intervals_of_counts_are_scipys():
    for events, trials in ((0, 50), (3, 1000), (50, 50)):
        wanted = binomtest(events, trials).proportion_ci(0.95, method="exact")
        assert exact_interval(events, trials) == pytest.approx((wanted.low, wanted.high))


@dataclass(frozen=True)
class Blind:
    """A detector that sees nothing."""

    threshold: float = 0.5

    def detect(self, images):
        return Detections(np.zeros((len(images), MOST, 4)), np.zeros((len(images), MOST)))


@pytest.mark.parametrize("world", [BrakingWorld(), CutInWorld()])
def test_a_loop_with_a_blind_detector_is_the_scenario_with_all_missed(world):
    count = 12
    scenes = draw_scenes(
        DOMAINS["fair"], count=count, cars=world.cars, seeds=np.random.SeedSequence(1)
    )
    normals = np.random.default_rng(2).standard_normal((count, world.starts))
    driven = Loop(world, Blind(), 0.5).drive(scenes, normals)
    states, failed = world.begin(normals), np.zeros(count, dtype=bool)
    for _ in range(world.simulator.states - 1):
        states = world.step(states, np.zeros((count, world.cars), dtype=bool))
        failed |= world.failed(states.signals)
    np.testing.assert_array_equal(driven.failed, failed)
    assert failed.any()


def test_frames_that_are_left_out_change_nothing(network):
    @dataclass(frozen=True)
    class Everywhere(Loop):
        def matters(self, states):
            return np.ones(states.shape[0], dtype=bool)

    world = BrakingWorld()
    scenes = draw_scenes(DOMAINS["fog"], count=40, cars=1, seeds=np.random.SeedSequence(6))
    detector, normals = Detector(ready(network), 0.5), np.zeros((40, 0))
    few = Loop(world, detector, 0.5).drive(scenes, normals)
    every = Everywhere(world, detector, 0.5).drive(scenes, normals)
    np.testing.assert_array_equal(few.failed, every.failed)
    assert few.looks.step.size < every.looks.step.size
    part = Loop(world, detector, 0.5).drive(scenes.take(np.arange(7, 19)), normals[7:19])
    np.testing.assert_array_equal(part.failed, few.failed[7:19])


@dataclass(frozen=True)
class Coin(Loop):
    """A detector that misses with one probability, whatever is in the picture."""

    missed: float = 0.5

    def look(self, scenes, poses, travelled_m, *, step):
        found = [uniforms(scenes.frame_seeds, step, 70 + car) for car in range(self.world.cars)]
        return np.stack(found, axis=1) >= self.missed


@pytest.mark.parametrize(("world", "missed"), [(FAR, 0.7), (CutInWorld(), 0.3)])
def test_a_verdict_is_known_no_sooner_than_it_is(world, missed):
    """Rollouts with frames left out fail where those of a coin thrown everywhere do."""
    count = 300
    scenes = draw_scenes(
        DOMAINS["fair"], count=count, cars=world.cars, seeds=np.random.SeedSequence(1)
    )
    normals = np.random.default_rng(2).standard_normal((count, world.starts))
    coin = Coin(world, Blind(), 0.5, missed)
    driven = coin.drive(scenes, normals)
    states, failed = world.begin(normals), np.zeros(count, dtype=bool)
    for step in range(world.simulator.states - 1):
        states = world.step(states, coin.look(scenes, None, None, step=step))
        failed |= world.failed(states.signals)
    np.testing.assert_array_equal(driven.failed, failed)
    assert 10 < failed.sum() < 290


def test_splitting_agrees_with_plain_rollouts():
    """False alarm about 1e-4: four standard errors of both together."""
    world = FAR
    coin = Coin(world, Blind(), 0.5, 0.7)
    setting = Setting("coin", world, "fair", 0.0)
    levels_m = np.array([9.0, 6.5, 4.0, 2.0])
    runs = [split_run(setting, coin, levels_m=levels_m, count=300, run=n) for n in range(8)]
    split = np.array([run.probability for run in runs])
    random, count = np.random.default_rng(3), 40_000
    states, failed = world.begin(np.zeros((count, 0))), np.zeros(count, dtype=bool)
    for _ in range(world.simulator.states - 1):
        states = world.step(states, random.random((count, 1)) >= 0.7)
        failed |= world.failed(states.signals)
    plain = failed.mean()
    error = np.hypot(split.std(ddof=1) / np.sqrt(8), np.sqrt(plain * (1 - plain) / count))
    assert abs(split.mean() - plain) < 4.0 * error
    assert error < 0.15 * plain
    mean, low, high = of_runs(list(split))
    assert low < mean < high
