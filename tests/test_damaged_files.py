"""What random damage found in the readers that all parts share, each as a small case."""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from pemviz.config.toml_files import load_config
from pemviz.errors import LONGEST_MESSAGE, ConfigError, InputError
from pemviz.files.array_files import load_tensors, read_arrays
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.json_text import parse_json
from pemviz.runs.rollout_files import finished_stage, write_part
from pemviz.types import Signal


def entry(text: str, data: bytes) -> bytes:
    header = text.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def archive_of(path, name: str, content: bytes, *, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as made:
        made.writestr(name, content)
    return path


@pytest.mark.parametrize(
    "message", ["two\nlines", "esc\x1b[2J", "\u202etxet", "\ud800", "x" * 9000]
)
def test_a_message_is_one_short_line_that_can_be_printed(message):
    shown = str(InputError(f"config {message}: must be a number"))
    assert shown.isprintable()
    assert shown.startswith("config ")
    assert shown.endswith("must be a number")
    assert len(shown) <= LONGEST_MESSAGE + 10
    shown.encode()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seed = " + "9" * 5000, "not valid TOML"),
        ("alpha = 1" + "0" * 400, "alpha = "),
        ("seed" + ".a" * 150 + " = 1", "seed = "),
        ("seed" + ".a" * 5000 + " = 1", "nested too deeply"),
        ("pem = " + "[" * 3000, "nested too deeply"),
        ("scenario = 1", "must be a table"),
        ("# " + "x" * 1_000_001, "at most 1000000 bytes"),
        ("x" * 3000 + " = 1", "no such field"),
        ("[scenario]\ncamera_height_m = 1e308", "at most 100"),
        ("[scenario]\nspeed_gain_per_s = 1e308", "at most 1,000,000"),
    ],
)
def test_a_damaged_configuration_is_refused(tmp_path, text, words):
    path = tmp_path / "damaged.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words) as caught:
        load_config(path)
    assert str(caught.value).startswith("config ")
    assert len(str(caught.value)) < 1200


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nested more than 100 levels"),
        ("[" * 150 + "]" * 150, "nested more than 100 levels"),
        ("9" * 5000, "5000 digits"),
        ("[NaN]", "NaN is not a JSON number"),
        ("1e999", "beyond what a float64 holds"),
        ("{", "Expecting"),
    ],
)
def test_json_is_strict(text, words):
    with pytest.raises(ValueError, match=words):
        parse_json(text)


def test_json_of_others_may_hold_nan():
    assert np.isnan(parse_json("[NaN, 1]", strict=False)[0])
    assert parse_json('{"a": [1, 2.5, null, "x"]}') == {"a": [1, 2.5, None, "x"]}


def test_arrays_are_read_back(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array([True, False]),
        "c": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "d": np.zeros((0, 4)),
        "e": np.array(2.5),
        "f": np.arange(3, dtype=">f4"),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "some.npz", **arrays)
        found = read_arrays(tmp_path / "some.npz")
        assert list(found) == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array, strict=True)


def test_a_large_array_is_read_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr("pemviz.files.array_files.PIECE_BYTES", 64)
    array = np.random.default_rng(1).normal(size=(50, 3))
    np.savez(tmp_path / "some.npz", a=array)
    np.testing.assert_array_equal(read_arrays(tmp_path / "some.npz")["a"], array)


FORGED = {
    "asks for more": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
    "overflows": "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999, 99999), }",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "large type": "{'descr': '|V99999999999', 'fortran_order': False, 'shape': (1,), }",
    "pickle": "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "text": "{'descr': '<U2', 'fortran_order': False, 'shape': (1,), }",
    "deep": "-" * 5000 + "1",
    "code": "__import__('os')",
}


@pytest.mark.parametrize("header", FORGED.values(), ids=FORGED)
@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_forged_header_reserves_nothing(tmp_path, header, compression):
    path = archive_of(tmp_path / "a.npz", "a.npy", entry(header, bytes(8)), compression=compression)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"arrays .*a\.npz: cannot be read"):
            read_arrays(path)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_a_flipped_bit_does_not_pass(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.arange(100.0))
    content = bytearray(path.read_bytes())
    content[400] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="CRC"):
        read_arrays(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.npy", b"plain bytes", "no array of numpy's format"),
        ("a.npy", b"", "no array of numpy's format"),
        ("note.txt", b"x", "is no array"),
    ],
)
def test_an_entry_that_is_no_array_is_refused(tmp_path, name, content, words):
    with pytest.raises(InputError, match=words):
        read_arrays(archive_of(tmp_path / "a.npz", name, content))


def test_an_array_twice_is_refused(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.arange(3.0))
    path = archive_of(tmp_path / "a.npz", "a.npy", stream.getvalue())
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as made:
        made.writestr("a.npy", stream.getvalue())
    with pytest.raises(InputError, match="holds 'a' twice"):
        read_arrays(path)


def test_tensors_that_are_no_numbers_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    for kind, size in (("BF16", 2), ("C64", 8), ("F8_E4M3", 1)):
        header = f'{{"a":{{"dtype":"{kind}","shape":[1],"data_offsets":[0,{size}]}}}}'.encode()
        path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(size))
        with pytest.raises(InputError, match=r"tensors .*a\.safetensors"):
            load_tensors(path)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("pem_logit", np.full((2, 3), -1e308)),
        ("proposal_logit", np.full((2, 3), np.inf)),
        ("gap_m", np.full((2, 4), np.nan)),
        ("gap_m", np.zeros((2, 4), dtype=np.int64)),
        ("detected", np.zeros((2, 3))),
        ("robustness", np.full(2, np.nan)),
    ],
)
def test_a_stage_that_holds_no_rollouts_is_refused(tmp_path, name, values):
    arrays = {
        "gap_m": np.zeros((2, 4)),
        "detected": np.zeros((2, 3), dtype=np.bool_),
        "pem_logit": np.zeros((2, 3)),
        "proposal_logit": np.zeros((2, 3)),
        "robustness": np.zeros(2),
        "violated": np.zeros(2, dtype=np.bool_),
    }
    signals = (Signal(name="gap", key="gap_m", unit="m", low=0.0, high=1.0),)
    write_part(tmp_path / "whole.npz", arrays)
    assert finished_stage(tmp_path / "whole.npz", signals).scored.rollouts.count == 2
    write_part(tmp_path / "damaged.npz", {**arrays, name: values})
    with pytest.raises(InputError, match="holds what is no number"):
        finished_stage(tmp_path / "damaged.npz", signals)


def test_names_that_no_file_can_have_are_no_files(tmp_path):
    for name in ("x" * 300, "a\0b", ""):
        assert not is_file(tmp_path / name)
    assert is_folder(tmp_path)
    assert not is_folder(tmp_path / ("x" * 300))
