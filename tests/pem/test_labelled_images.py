"""COCO's and FiftyOne's boxes in images, with tracks: matched, refused, fitted."""

import json

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.pem import load_pem, own_features_of
from pemviz.pem.data.coco import collect_coco
from pemviz.pem.data.collect import CollectOptions
from pemviz.pem.data.fiftyone import collect_fiftyone
from pemviz.pem.data.table import load_tracks
from tests.pem.helpers import assert_refused, rows_of

VIDEOS, FRAMES, TRACKS = 4, 40, 3


def is_seen(video, frame, track):
    """Independent of each other, the smaller box the rarer."""
    random = np.random.default_rng((video, frame, track))
    return random.random() < 0.5 + 0.15 * track


def box(frame, track):
    return [100.0 * track + 2.0 * frame, 50.0, 40.0 + 10 * track, 20.0 + 5 * track]


def coco_files(tmp_path, change=lambda truth, found: None):
    """Ground truth of videos as an object, results as the list that COCO's evaluation takes."""
    truth = {
        "videos": [{"id": video, "name": f"drive-{video}"} for video in range(VIDEOS)],
        "images": [],
        "annotations": [],
        "categories": [{"id": 3, "name": "car"}],
    }
    found = []
    for video in range(VIDEOS):
        for frame in range(FRAMES):
            image = 1000 * video + frame
            name = f"drive-{video}/{frame:06d}.jpg"
            entry = {"id": image, "video_id": video, "frame_id": frame, "file_name": name}
            truth["images"].append({**entry, "width": 640, "height": 480})
            for track in range(TRACKS):
                given = {"image_id": image, "category_id": 3, "bbox": box(frame, track)}
                more = {"track_id": track, "attributes": {"occluded": track == 1}, "iscrowd": 0}
                truth["annotations"].append({"id": len(truth["annotations"]), **given, **more})
                if is_seen(video, frame, track):
                    found.append({**given, "score": 0.9})
    change(truth, found)
    paths = {"labels": tmp_path / "truth.json", "detections": tmp_path / "found.json"}
    paths["labels"].write_text(json.dumps(truth))
    paths["detections"].write_text(json.dumps(found))
    return {**paths, "out": tmp_path / "boxes.csv"}


def fiftyone_file(tmp_path):
    """The same data as FiftyOne exports a data set."""
    samples = []
    for video in range(VIDEOS):
        for frame in range(FRAMES):
            truth, found = [], []
            for track in range(TRACKS):
                left, top, width, height = box(frame, track)
                shares = [left / 640, top / 480, width / 640, height / 480]
                one = {"_cls": "Detection", "label": "car", "bounding_box": shares, "tags": []}
                truth.append({**one, "index": track, "occluded": track == 1, "confidence": None})
                if is_seen(video, frame, track):
                    found.append({**one, "index": None, "confidence": 0.9})
            samples.append(
                {
                    "filepath": f"data/drive-{video}/{frame:06d}.jpg",
                    "metadata": {"_cls": "ImageMetadata", "width": 640, "height": 480},
                    "ground_truth": {"_cls": "Detections", "detections": truth},
                    "predictions": {"_cls": "Detections", "detections": found},
                }
            )
    path = tmp_path / "samples.json"
    path.write_text(json.dumps({"samples": samples}))
    return path


def test_annotations_of_coco_meet_its_results(tmp_path):
    files = coco_files(tmp_path)
    counts = collect_coco(**files)
    assert (counts.sequences, counts.tracks, counts.gaps) == (VIDEOS, VIDEOS * TRACKS, 0)
    tracks = load_tracks(files["out"], needs_state=False)
    expected = [
        is_seen(video, frame, track)
        for video in range(VIDEOS)
        for track in range(TRACKS)
        for frame in range(FRAMES)
    ]
    np.testing.assert_array_equal(tracks.detected, expected)
    assert counts.missed == len(expected) - sum(expected)
    first = rows_of(files["out"])[0]
    assert (first["sequence"], first["occluded"], first["width_px"]) == ("drive-0", "false", "40")


def test_fiftyone_s_export_gives_the_same_outcomes(tmp_path):
    files = coco_files(tmp_path)
    collect_coco(**files)
    fields = {"labels_field": "ground_truth", "detections_field": "predictions"}
    path = fiftyone_file(tmp_path)
    for labels in (path, tmp_path):
        out = tmp_path / "fiftyone.csv"
        collect_fiftyone(labels=labels, out=out, **fields)
        one, other = rows_of(files["out"]), rows_of(out)
        names = ("frame", "track", "type", "occluded", "detected", "iou")
        assert [[row[n] for n in names] for row in one] == [
            [row[n] for n in names] for row in other
        ]
        for name in ("left_px", "bottom_px", "height_px"):
            values = [[float(row[name]) for row in rows] for rows in (one, other)]
            np.testing.assert_allclose(*values, rtol=1e-9)


def test_from_coco_to_a_model_of_what_is_labelled(tmp_path, capsys):
    files = coco_files(tmp_path)
    given = [word for name, path in files.items() for word in (f"--{name}", str(path))]
    assert main(["pem", "collect", "--format", "coco", *given]) == 0
    assert "4 sequences, 12 tracks, 480 boxes" in capsys.readouterr().out
    out = tmp_path / "own.safetensors"
    fit = ["--table", str(files["out"]), "--features", "height_px,occluded", "--model", "lr"]
    assert main(["pem", "fit", *fit, "--folds", "4", "--out", str(out)]) == 0
    model = load_pem(str(out))
    assert own_features_of(model).names == ("height_px", "occluded")
    assert model.logit([30.0, 0.0]) > model.logit([20.0, 0.0])
    memory = ["--table", str(files["out"]), "--model", "guess-mu", "--folds", "4", "--json"]
    assert main(["pem", "memory", *memory]) == 0


def test_results_may_be_an_object_whose_images_have_other_ids(tmp_path):
    files = coco_files(tmp_path)
    counts = collect_coco(**files)
    text = files["out"].read_text()
    truth, found = (json.loads(files[name].read_text()) for name in ("labels", "detections"))
    names = {one["id"]: one["file_name"] for one in truth["images"]}
    images = [{"id": 7 + one, "file_name": name} for one, name in names.items()]
    moved = [{**one, "image_id": one["image_id"] + 7} for one in found]
    whole = {"images": images, "annotations": moved, "categories": truth["categories"]}
    files["detections"].write_text(json.dumps(whole))
    assert collect_coco(**files).missed == counts.missed
    assert files["out"].read_text() == text


def test_crowds_and_low_scores_are_left_out_and_silent_images_told(tmp_path):
    def change(truth, found):
        truth["annotations"][0]["iscrowd"] = 1
        found[:] = [{**one, "score": 0.2} for one in found if one["image_id"] >= 1000][1:]

    files = coco_files(tmp_path, change)
    counts = collect_coco(**files, options=CollectOptions(score_from=0.5))
    assert (counts.dropped, counts.observations) == (1, VIDEOS * FRAMES * TRACKS - 1)
    assert counts.ignored_detections > 0
    assert any("labelled images nothing was reported" in doubt for doubt in counts.doubts)


def first_image(truth):
    return truth["images"][0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t, f: t.pop("annotations"), "ground truth must be an object with 'images'"),
        (lambda t, f: t.pop("images"), "no 'images'"),
        (
            lambda t, f: first_image(t).pop("file_name"),
            "an entry of 'images' lacks 'id' or",
        ),
        (lambda t, f: first_image(t).update(id=1), "an id of 'images' is there twice"),
        (
            lambda t, f: first_image(t).update(frame_id=1),
            "2 images are frame 1 of",
        ),
        (lambda t, f: first_image(t).update(frame_id="x"), "must have a frame number from 0 on"),
        (lambda t, f: t["annotations"][5].pop("track_id"), "1 of 480 labels have no track"),
        (
            lambda t, f: t["annotations"][0].update(track_id=1),
            "track 1 .* is there twice in",
        ),
        (lambda t, f: t["annotations"][0].update(image_id=77777), "image_id 77777 is none"),
        (lambda t, f: t["annotations"][0].update(bbox=[0, 0, -4, 4]), "negative side"),
        (lambda t, f: f[0].update(image_id=99999), "entry 0: image_id 99999 is none of the ground"),
        (lambda t, f: f[0].pop("bbox"), "found.json: entry 0: field 'bbox' is missing"),
        (lambda t, f: t["annotations"].clear(), "no obstacle of any class"),
    ],
)
def test_a_damaged_file_of_coco_is_told_in_one_line(tmp_path, capsys, change, words):
    assert_refused(capsys, "coco", coco_files(tmp_path, change), words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"samples"', '"sample"', "needs 'samples', a list"),
        (
            '"predictions"',
            '"preds"',
            "has a field 'predictions', of Detections are: ground",
        ),
        ('"width": 640', '"width": null', r"compute_metadata\(\)"),
        ('"bounding_box": [0', '"bounding_box": [9', "allowed: shares of the image"),
        ('"filepath"', '"path"', "sample 0: must be an object with a 'filepath'"),
        ("000000.jpg", "first.jpg", "'data/drive-0/first.jpg': must have a frame number"),
        ('"samples": [', '"samples": [[', "samples.json:1: column"),
    ],
)
def test_a_damaged_file_of_fiftyone_is_told_in_one_line(tmp_path, capsys, old, new, words):
    path = fiftyone_file(tmp_path)
    path.write_text(path.read_text().replace(old, new, 480 if old == '"predictions"' else 1))
    files = {"labels": path, "detections": path, "out": tmp_path / "boxes.csv"}
    files |= {"labels-field": "ground_truth", "detections-field": "predictions"}
    assert_refused(capsys, "fiftyone", files, words)


def test_pycocotools_sees_the_same_misses(tmp_path):
    """Results as that program writes them, and each annotation matched or not by its evaluation."""
    coco = pytest.importorskip("pycocotools.coco")
    evaluation = pytest.importorskip("pycocotools.cocoeval")

    def change(truth, found):  # COCO's ids begin at 1, and areas are given; one box lies apart
        for number, one in enumerate(truth["annotations"], start=1):
            width, height = one["bbox"][2:]
            one.update(id=number, area=width * height)
        for number, one in enumerate(found):
            left, top, width, height = one["bbox"]
            one["bbox"] = [left + (number % 4) * 0.2 * width, top, width, height]

    files = coco_files(tmp_path, change)
    truth = coco.COCO(str(files["labels"]))
    results = truth.loadRes(str(files["detections"]))
    files["detections"].write_text(json.dumps(results.dataset))
    collect_coco(**files, options=CollectOptions(iou_above=0.5))
    judge = evaluation.COCOeval(truth, results, "bbox")
    judge.params.iouThrs = np.array([0.5])
    judge.params.areaRng, judge.params.areaRngLbl = [[0, 1e10]], ["all"]
    judge.evaluate()
    matched = {}
    for image in judge.evalImgs:
        pairs = zip(image["gtIds"], image["gtMatches"][0].tolist(), strict=True)
        matched |= {who: found > 0 for who, found in pairs}
    assert len(matched) == VIDEOS * FRAMES * TRACKS
    rows = {(row["sequence"], row["frame"], row["track"]): row for row in rows_of(files["out"])}
    for annotation in truth.dataset["annotations"]:
        image = truth.imgs[annotation["image_id"]]
        video = f"drive-{image['video_id']}"
        who = video, str(image["frame_id"]), str(annotation["track_id"])
        assert rows[who]["detected"] == str(int(matched[annotation["id"]])), who
    assert 0 < sum(matched.values()) < len(matched)
