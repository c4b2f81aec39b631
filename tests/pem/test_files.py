"""Files of models: what is refused, and in what words; tables, objects, shipped models."""

import json
import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from pemviz.files.text_files import check_columns
from pemviz.pem import (
    Pem,
    PemEnsemble,
    PemError,
    ensemble_of,
    load_ensemble,
    load_pem,
    save_pem,
    shipped_pems,
)
from pemviz.pem.model_files import METADATA_KEY, read_tensors
from pemviz.pem.models.tabulated import TabulatedPem
from tests.pem.helpers import braking_rows, random_rows, shipped_file


def rewritten(tmp_path, name, *, tensors=None, metadata=None, drop=()):
    """A shipped model's file with some tensors or its metadata changed."""
    original, words = read_tensors(shipped_file(name))
    changed = {**original, **(tensors or {})}
    for key in drop:
        del changed[key]
    path = tmp_path / "changed.safetensors"
    save_file(changed, path, metadata=words if metadata is None else metadata)
    return path


def header(**changes):
    words = json.loads(read_tensors(shipped_file("ml-nn"))[1][METADATA_KEY])
    return {METADATA_KEY: json.dumps({**words, **changes})}


@pytest.mark.parametrize("name", shipped_pems())
def test_every_shipped_model_loads_with_a_card_and_a_licence(name):
    pem = load_pem(name)
    assert isinstance(pem, Pem)
    assert pem.name == name
    assert "KITTI" in pem.data
    assert "CC BY-NC-SA 3.0" in pem.licence
    assert len(pem.digest) == 64
    page = shipped_file(name).with_suffix(".md").read_text()
    assert pem.digest in page
    assert "CC BY-NC-SA 3.0" in page
    logit = pem.logit(braking_rows(np.linspace(-30, 25, 1101)))
    assert np.isfinite(logit).all()
    assert np.ptp(logit) > (0.01 if name == "lr" else 0.1)


def test_the_shipped_ensemble_has_twenty_members_and_belongs_to_its_model():
    ensemble = ensemble_of("ml-nn")
    assert isinstance(ensemble, PemEnsemble)
    assert len(ensemble.members) == 20
    assert ensemble.name == "ml-nn-ensemble"
    assert shipped_file("ml-nn-ensemble").stat().st_size < 1_000_000
    assert ensemble_of("lr") is None
    with pytest.raises(PemError, match="'ml-nn' is a single model"):
        load_ensemble("ml-nn")


def test_an_ensemble_answers_with_the_mean_probability():
    ensemble = load_pem("ml-nn-ensemble")
    rows = random_rows(np.random.default_rng(1), 300)
    probabilities = [1 / (1 + np.exp(-member.logit(rows))) for member in ensemble.members]
    mean = np.mean(probabilities, axis=0)
    np.testing.assert_allclose(ensemble.logit(rows), np.log(mean / (1 - mean)), atol=1e-9)


def test_an_ensemble_file_beside_a_model_is_found(tmp_path):
    own = tmp_path / "own.safetensors"
    save_pem(load_pem("ml-nn"), own)
    assert ensemble_of(str(own)) is None
    save_pem(load_pem("ml-nn-ensemble"), tmp_path / "own-ensemble.safetensors")
    assert len(ensemble_of(str(own)).members) == 20


def test_an_ensemble_that_an_earlier_fit_left_is_refused(tmp_path):
    """Silently used, it would tell how far refits of another model differ."""
    own, beside = tmp_path / "own.safetensors", tmp_path / "own-ensemble.safetensors"
    save_pem(load_pem("ml-nn-ensemble"), beside)
    save_pem(load_pem("lr"), own)
    with pytest.raises(PemError, match="of kind ml-nn, the model lr"):
        ensemble_of(str(own))
    pem = load_pem("ml-nn")
    save_pem(replace(pem, card=replace(pem.card, data_digest="f" * 64)), own)
    with pytest.raises(PemError, match="SHA-256 0c06ad539383e8bf, the model to ffffffffffffffff"):
        ensemble_of(str(own))
    save_pem(replace(pem, card=replace(pem.card, data_digest="")), own)
    assert len(ensemble_of(str(own)).members) == 20  # what no one knows is no difference


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tensors": {"layers.0.weight": np.zeros((20, 13))}}, "maps 13 inputs to 1"),
        ({"tensors": {"layers.1.weight": np.zeros((20, 21))}}, "layer 1 takes 21 inputs"),
        ({"tensors": {"layers.1.bias": np.zeros(3)}}, r"layer 1 has weight \[20, 20\]"),
        ({"tensors": {"layers.2.bias": np.array([np.nan])}}, "'layers.2.bias' holds values"),
        ({"tensors": {"pose.std": np.zeros(4)}}, "deviations must be above 0"),
        ({"drop": ["layers.2.bias"]}, r"lacks tensors \['layers.2.bias'\]"),
        ({"tensors": {"extra": np.zeros(1)}}, r"unknown \['extra'\]"),
        ({"metadata": {}}, "no 'pemviz-pem' metadata"),
        ({"metadata": {METADATA_KEY: "{"}}, "metadata is not JSON"),
        ({"metadata": header(version=2)}, "does not say 'version' 1"),
        ({"metadata": header(kind="oracle")}, "unknown kind of model 'oracle'"),
        ({"metadata": header(card={"name": "x"})}, "lacks .*'licence'"),
        ({"metadata": header(options={"inputs": ["z_m"]})}, r"its inputs are \['z_m'\]"),
    ],
)
def test_a_broken_model_file_is_refused_in_one_line(tmp_path, change, words):
    path = rewritten(tmp_path, "ml-nn", **change)
    with pytest.raises(PemError, match=words) as caught:
        load_pem(str(path))
    assert "\n" not in str(caught.value)


def with_a_loop(tensors):
    left = tensors["trees.left"].copy()
    left[np.flatnonzero(tensors["trees.feature"] != 255)[5]] = 0
    return left


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("trees.left", lambda _: np.zeros(3, dtype=np.int32), "differ in length"),
        ("trees.left", with_a_loop, "child lies outside its tree"),
        ("trees.root", lambda _: np.array([10**6], dtype=np.int32), "root lies outside"),
        ("calibration", lambda _: np.array([-1.0, 0.0]), "slope must be above 0"),
    ],
)
def test_broken_trees_are_refused(tmp_path, name, change, words):
    tensors, _ = read_tensors(shipped_file("gb-raw"))
    with pytest.raises(PemError, match=words):
        load_pem(str(rewritten(tmp_path, "gb-raw", tensors={name: change(tensors)})))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("ff_nn.0.weight", np.zeros((20, 12)), "maps 12 inputs to 1"),
        ("ff_nn.1.running_var", np.full(20, -1.0), "negative variances"),
        (
            "ff_nn.4.running_mean",
            np.zeros(7),
            r"'ff_nn.4.running_mean' has shape \[7\], need \[20\]",
        ),
        ("ff_nn.6.bias", np.array([np.inf]), "'ff_nn.6.bias' holds values that are not finite"),
        ("input_std", None, "'input_std' is missing"),
    ],
)
def test_a_broken_authors_checkpoint_is_refused(tmp_path, authors_checkpoint, key, value, words):
    tensors = load_file(authors_checkpoint)
    tensors[key] = value
    path = tmp_path / "theirs.safetensors"
    save_file({name: array for name, array in tensors.items() if array is not None}, path)
    with pytest.raises(PemError, match=words):
        load_pem(str(path))


class Bomb:
    def __reduce__(self):
        return (sys.exit, (13,))


@pytest.mark.parametrize("suffix", [".pt", ".pkl", ".safetensors"])
def test_pickles_are_refused_unopened(tmp_path, suffix):
    path = tmp_path / f"model{suffix}"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(PemError, match="torch"):
        load_pem(str(path))


def test_torch_files_and_files_cut_short_are_refused(tmp_path):
    torch.save({"weight": torch.zeros(2)}, tmp_path / "torch.safetensors")
    cut = shipped_file("ml-nn").read_bytes()[:-100]
    (tmp_path / "cut.safetensors").write_bytes(cut)
    for path in (tmp_path / "torch.safetensors", tmp_path / "cut.safetensors"):
        with pytest.raises(PemError, match="not a readable safetensors file"):
            load_pem(str(path))


@pytest.mark.parametrize("name", ["ml-mm", "missing.safetensors", "none.csv", "../x.safetensors"])
def test_an_unknown_model_is_named(name):
    with pytest.raises(PemError, match=name.replace(".", r"\.")):
        load_pem(name)


def test_a_table_of_distances_interpolates_its_logit(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("distance_m,p_detected\n5,0.9\n10,0.99\n20,0.5\n")
    pem = load_pem(str(path))
    at = braking_rows(np.array([0.0, 5.0, 7.5, 10.0, 15.0, 50.0]) - 2.5)
    nine, hundred = np.log(9.0), np.log(99.0)
    expected = [nine, nine, (nine + hundred) / 2, hundred, hundred / 2, 0.0]
    np.testing.assert_allclose(pem.logit(at), expected, atol=1e-12)
    save_pem(pem, tmp_path / "table.safetensors")
    assert load_pem(str(tmp_path / "table.safetensors")).digest == pem.digest


def test_a_step_table_keeps_its_value_up_to_the_next_distance():
    card = load_pem("lr").card
    pem = TabulatedPem(card, np.array([-1e6, 0.0, 5.0]), np.array([-1.0, 1.0, 2.0]), between="step")
    at = braking_rows(np.array([-3.0, 0.0, 4.999, 5.0, 99.0]) - 2.5)
    np.testing.assert_array_equal(pem.logit(at), [-1.0, 1.0, 1.0, 2.0, 2.0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("z,p\n1,0.5\n", ":1: the header must be distance_m,p_detected"),
        ("distance_m,p_detected\n1,0.5\n2,x\n", r":3: column 2 \(p_detected\) is 'x'"),
        ("distance_m,p_detected\n1,0.5\n2\n", ":3: 1 column where 2 are needed: distance_m, p_de"),
        ("distance_m,p_detected\n1,1.0\n", "strictly between 0 and 1"),
        ("distance_m,p_detected\n2,0.5\n1,0.5\n", "increase"),
        ("distance_m,p_detected\n", "distances must be there"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(PemError, match=words):
        load_pem(str(path))


def test_a_python_object_runs_only_if_allowed(tmp_path, monkeypatch):
    module = tmp_path / "their_detector.py"
    module.write_text(
        "import numpy as np\n"
        "class Model:\n"
        "    name, digest, data, licence = 'theirs', '0' * 64, 'own drives', 'own'\n"
        "    def logit(self, salient):\n"
        "        return 3.0 + 0.0 * np.asarray(salient)[..., 9]\n"
        "NOT_A_MODEL = 3\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(PemError, match="would run Python code"):
        load_pem("their_detector:Model")
    assert "their_detector" not in sys.modules
    pem = load_pem("their_detector:Model", allow_python=True)
    np.testing.assert_array_equal(pem.logit(braking_rows([1.0])), [3.0])
    for name, words in (
        ("their_detector:NOT_A_MODEL", "is no perception error model"),
        ("their_detector:missing", "cannot be imported: AttributeError"),
        ("no_such_module_here:x", "cannot be imported: ModuleNotFoundError"),
    ):
        with pytest.raises(PemError, match=words):
            load_pem(name, allow_python=True)


@pytest.mark.parametrize(
    ("cells", "names", "words"),
    [
        (["1", "2"], ["gap"], "t.csv:2: 2 columns where 1 is needed: gap"),
        (["1"], list("abc"), "t.csv:2: 1 column where 2 or 3 are needed: a, b, c"),
        ([], [f"{n}" for n in range(99)], "where 98 or 99 are needed: 0, .*, 75, ..."),
    ],
)
def test_a_line_of_other_columns_says_which_ones_are_needed(cells, names, words):
    with pytest.raises(PemError, match=f"{words}$"):
        check_columns(cells, names, where="t.csv:2", optional=len(names) > 1)
