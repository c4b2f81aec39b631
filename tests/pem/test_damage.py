"""What random damage found in the readers of models, labels and detections."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from pemviz.pem import PemCard, PemError, load_pem, load_table, save_pem
from pemviz.pem.data.collect import collect
from pemviz.pem.model_files import METADATA_KEY, read_tensors
from pemviz.pem.models.network import PAPER_INPUTS, Layer, NetworkPem
from pemviz.pem.models.tabulated import TabulatedPem
from pemviz.pem.models.trees import LEAF, TreesPem
from tests.fuzz.valid import authors_tensors, label_file, result_file

CARD = PemCard(name="made up", model="ml-nn")


@pytest.fixture
def stored(tmp_path):
    """Writes a small network's file with its metadata changed; gives the path."""
    network = NetworkPem(
        CARD, np.zeros(4), np.ones(4), (Layer(np.ones((1, len(PAPER_INPUTS))), np.ones(1)),)
    )
    save_pem(network, tmp_path / "own.safetensors")
    tensors, metadata = read_tensors(tmp_path / "own.safetensors")

    def write(change, *, extra=None):
        words = json.loads(metadata[METADATA_KEY])
        text = change(words) if callable(change) else json.dumps({**words, **change})
        save_file({**tensors, **(extra or {})}, tmp_path / "own.safetensors", {METADATA_KEY: text})
        return str(tmp_path / "own.safetensors")

    return write


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda _: "[" * 100_000, "metadata is not JSON"),
        (lambda _: "9" * 5000, "metadata is not JSON"),
        (lambda words: json.dumps({**words, "x": float("nan")}), "NaN is not a JSON number"),
        ({"kind": "trees", "options": {"feature_set": ["paper"]}}, "'feature_set' is"),
        ({"card": {**vars(CARD), "seed": "x"}}, "'seed' must be a whole number"),
        ({"card": {**vars(CARD), "scores": {"bce": "x"}}}, "'scores' must hold numbers"),
    ],
)
def test_damaged_metadata_is_refused(stored, change, words):
    with pytest.raises(PemError, match=words) as caught:
        load_pem(stored(change))
    assert str(caught.value).isprintable()


def test_a_member_with_a_superscript_for_a_number_is_refused(stored):
    change = {"kind": "ensemble", "options": {"member_kind": "network"}}
    with pytest.raises(PemError, match="unknown tensor"):
        load_pem(stored(change, extra={"members.².pose.mean": np.zeros(4)}))


def test_tensors_that_are_no_real_numbers_are_refused(stored):
    with pytest.raises(PemError, match="must be real numbers"):
        load_pem(stored({}, extra={"pose.mean": np.zeros(4, dtype=np.complex64)}))


def test_a_network_whose_answers_overflow_is_refused():
    weight = np.full((1, len(PAPER_INPUTS)), 1e300)
    with pytest.raises(PemError, match="answers overflow"):
        NetworkPem(CARD, np.zeros(4), np.full(4, 1e-6), (Layer(weight, np.zeros(1)),))


def test_an_authors_checkpoint_that_overflows_is_refused(tmp_path):
    tensors = {name: array.astype(np.float64) for name, array in authors_tensors().items()}
    tensors["ff_nn.0.weight"][0, 0] = 1e308
    tensors["ff_nn.1.weight"][0] = 1e308
    save_file(tensors, tmp_path / "own.safetensors")
    with pytest.raises(PemError, match="not finite"):
        load_pem(str(tmp_path / "own.safetensors"))


def trees(**changes):
    arrays = {
        "feature": np.array([0, LEAF, LEAF], dtype=np.uint8),
        "number": np.array([0.5, -1.0, 1.0]),
        "left": np.array([1, 0, 0], dtype=np.int32),
        "root": np.array([0], dtype=np.int32),
        "calibration": np.array([1.0, 0.0]),
    }
    return TreesPem(CARD, "paper", **{**arrays, **changes})


def chain(levels):
    """One tree, each inner node's left child the next inner node."""
    nodes = 2 * levels + 1
    feature = np.full(nodes, LEAF, dtype=np.uint8)
    left = np.zeros(nodes, dtype=np.int32)
    for level in range(levels):
        node = 0 if level == 0 else 2 * level - 1
        feature[node], left[node] = 0, 2 * level + 1
    return {"feature": feature, "left": left, "number": np.zeros(nodes)}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": np.array([2**31 - 1, 0, 0], dtype=np.int32)}, "child lies outside"),
        ({"left": np.array([127, 0, 0], dtype=np.int8)}, "child lies outside"),
        ({"left": np.array([2**63 - 1, 0, 0])}, "child lies outside"),
        ({"root": np.zeros(10_001, dtype=np.int32)}, "at most 10000"),
        ({"number": np.array([0.5, 1e300, 1.0])}, "leaf values must be multiples"),
        ({"number": np.array([0.5, 1 / 3, 1.0])}, "leaf values must be multiples"),
        ({"calibration": np.array([1e308, 0.0])}, "at most 1e\\+100"),
        (chain(201), "deeper than 200 levels"),
    ],
)
def test_trees_that_cannot_be_evaluated_are_refused(changes, words):
    with pytest.raises(PemError, match=words):
        trees(**changes)


def test_deep_trees_are_fine_up_to_the_limit():
    assert trees(**chain(199)).logit(np.zeros((2, 11))).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("distance_m", "logit"),
    [([0.0, 1e-300], [-1.0, 1e10]), ([-1.7e308, 1.7e308], [0.0, 1.0]), ([0, 1], [-1e308, 1e308])],
)
def test_a_table_whose_lines_overflow_is_refused(distance_m, logit):
    with pytest.raises(PemError, match="overflow"):
        TabulatedPem(CARD, np.array(distance_m, dtype=float), np.array(logit))


@pytest.fixture
def collected(tmp_path, rng_text):
    """Collects one frame with the texts given; ``None`` leaves the valid one."""
    (tmp_path / "labels").mkdir()

    def run(*, labels=None, found=None, detection_format="kitti", sizes=None):
        (tmp_path / "labels" / "000000.txt").write_text(labels or rng_text[0])
        if detection_format == "coco":
            target = tmp_path / "found.json"
            target.write_text(found)
        else:
            target = tmp_path / "found"
            target.mkdir(exist_ok=True)
            (target / "000000.txt").write_text(rng_text[1] if found is None else found)
        (tmp_path / "sizes.csv").write_text(sizes or "frame,width_px,height_px\n000000,1242,375\n")
        return collect(
            labels=tmp_path / "labels",
            detections=target,
            out=tmp_path / "out.csv",
            detection_format=detection_format,
            image_sizes=tmp_path / "sizes.csv",
        )

    return run


@pytest.fixture
def rng_text():
    import random  # noqa: PLC0415

    rng = random.Random(1)  # noqa: S311
    return label_file(rng), result_file(rng)


BOX = "Car 0 0 0 {} 0 {} 10 1 1 1 0 1 9 0\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"labels": BOX.format("-1e308", "1e308")}, "beyond any image"),
        ({"found": BOX.format("0", "1e7")}, "beyond any image"),
        ({"labels": "Car 0 0 0 " + "9" * 5000 + " 0 1 1 1 1 1 1 1 1 1\n"}, "not a number"),
        ({"detection_format": "coco", "found": "[" * 5000}, "nested more than"),
        ({"detection_format": "coco", "found": "9" * 5000}, "digits"),
        (
            {"detection_format": "coco",
             "found": '[{"image_id": 0, "category_id": "²", "bbox": [0, 0, 1, 1]}]'},
            "'category_id' must be",
        ),
        ({"detection_format": "yolo", "found": "0 .5 .5 .1 .1\n",
          "sizes": "frame,width_px,height_px\n000000,nan,375\n"}, "a size must be above 0"),
        ({"detection_format": "yolo", "found": "0 .5 .5 .1 .1\n",
          "sizes": "frame,width_px,height_px\n000000," + "9" * 200_000 + ",1\n"}, "not CSV"),
    ],
)  # fmt: skip
def test_damaged_labels_and_detections_are_refused(collected, arguments, words):
    with pytest.raises(PemError, match=words) as caught:
        collected(**arguments)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1200


def test_what_cannot_be_read_is_not_said_to_be_unwritable(tmp_path, collected):
    (tmp_path / "labels" / "000001.txt").mkdir()
    with pytest.raises(PemError, match=r"000001\.txt: cannot be read"):
        collected()


@pytest.mark.parametrize("ending", ["", ".csv", ".safetensors"])
def test_a_name_too_long_for_a_file_is_no_model(ending):
    with pytest.raises(PemError):
        load_pem("x" * 300 + ending)
    with pytest.raises(PemError, match="no table"):
        load_table("x" * 300 + ending)
