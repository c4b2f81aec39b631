"""Files of noise parameters that are damaged, of another version, or beyond what pemviz can say."""

import time

import pytest
import yaml

from pemviz.cli.main import main
from pemviz.pem import load_pem
from pemviz.pem.exchange.autoware import TOPIC

CAR = "noise.v4.car"
RATES = f"{CAR}.true_positive.rate.values"
CORRELATION = f"{CAR}.true_positive.autocorrelation_coefficient"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("noise") / "noise.yaml"
    assert main(["pem", "export", "pointrcnn", "--format", "autoware", "--out", str(path)]) == 0
    return path.read_text()


def changed(text, name, value):
    """The file with another value of a dotted name; ``...``: without it."""
    document = yaml.safe_load(text)
    *folders, last = name.split(".")
    inner = document["/**"]["ros__parameters"][TOPIC]
    for folder in folders:
        inner = inner[folder]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return yaml.safe_dump(document)


def imported(tmp_path, text, *options):
    path, out = tmp_path / "noise.yaml", tmp_path / "out.safetensors"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return main(["pem", "import", str(path), "--out", str(out), *options]), out


def assert_refused(capsys, tmp_path, text, words, *options):
    capsys.readouterr()
    began = time.monotonic()
    code, out = imported(tmp_path, text, *options)
    assert code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
    assert not out.exists()
    assert time.monotonic() - began < 60  # a file that hangs would take hours


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("noise.model.version", 3, "noise.model.version is 3, this reads version 4"),
        ("noise.v4", {}, "noise.v4 has no configuration"),
        (RATES, ..., "rate.values is missing"),
        (RATES, [0.9, 0.8], "has 2 values, need 11"),
        (RATES, [0.9] * 10 + [1.0], "strictly between 0 and 1"),
        (RATES, [0.9] * 10 + [1.2], "rate.values is 1.2, allowed: 0 to 1"),
        (RATES, [0.9] * 10 + [float("nan")], "rate.values is nan, allowed: 0 to 1"),
        (RATES, [0.9] * 10 + ["much"], "is 'much', must be a number"),
        (RATES, [0.9] * 10 + [True], "is True, must be a number"),
        (RATES, 0.9, "is 0.9, must be a list with values"),
        (
            f"{CAR}.ellipse_y_radii",
            [10.0] * 11,
            "must increase from 0 on, by 0.01 m at least: ranges overlap",
        ),
        (f"{CAR}.ellipse_y_radii", [5.0, 20.0, 10.0], "ranges overlap"),
        (f"{CAR}.position.x.standard_deviation.values", [-0.1] * 11, "is -0.1, allowed: 0 to 1000"),
        (f"{CAR}.position.y.mean.ellipse_normalized_x_radius", 2.0, "which is 1"),
        (f"{CAR}.position", [], "position is [], must be a table"),
        (f"{CAR}.distance", {}, "unknown 'distance', allowed: noise_application_entities"),
        (f"{CAR}.noise_application_entities.names", [3], "names must be a list of words"),
        (f"{CAR}.yaw_flip.rate", -1.0, "yaw_flip.rate is -1, allowed: 0 to 1"),
        (f"{CORRELATION}.offset", 0.2, "another correlation at another frame rate"),
        (f"{CORRELATION}.decay", 0.0, "another correlation at another frame rate"),
        (f"{CORRELATION}.decay", 1e-3, "a memory time above 60 s"),
        (f"{CORRELATION}.decay", float("inf"), "decay is inf, allowed: 0 to 1e+09"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(name, value, words, sound, tmp_path, capsys):
    assert_refused(capsys, tmp_path, changed(sound, name, value), words)


BOMB = "a: &a [x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [*{chr(97 + k)}, *{chr(97 + k)}]\n" for k in range(24)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "an alias in line 2"),
        ("[" * 100_000, "nested more than 30 levels deep"),
        ("{a: " * 60_000, "nested more than 30 levels deep"),
        ("a: 1\n" * 40_000, "'a' is there twice"),
        ("x" * 300_000, "over 256 kB"),
        ("a: [1, 2", "no YAML: line 1: "),
        ("a: !!python/object/apply:os.system [ls]", "no YAML: line 1: could not determine"),
        ("a: 2024-13-45", "no YAML: month must be in 1..12"),
        (f"a: {'9' * 5000}", "no YAML: Exceeds the limit"),
        ("? [1]\n: 2", "no YAML: line 1: found unhashable key"),
        (b"\xff\xfe\x00", "not UTF-8 text"),
        (b"a: \x00", "no YAML: "),
        ("", "'/**' is missing"),
        ("- 1", "'/**' is missing"),
        ("/**: 3", "/** is 3, must be a table"),
        ("/**: {ros__parameters: {}}", f"{TOPIC} is missing"),
    ],
    ids=range(16),
)
def test_what_is_no_file_of_parameters_is_refused_at_once(text, words, tmp_path, capsys):
    assert_refused(capsys, tmp_path, text, words)


def test_a_file_cut_anywhere_is_refused_or_says_the_same(sound, tmp_path, capsys):
    """Comments at the end of a line may be lost, nothing else."""
    _, whole = imported(tmp_path, sound)
    whole = load_pem(str(whole)).digest
    for cut in range(0, len(sound), 97):
        capsys.readouterr()
        code, out = imported(tmp_path, sound[:cut])
        if code == 0:
            assert load_pem(str(out)).digest == whole, sound[:cut][-80:]
        else:
            assert code == 2
            assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_correlation_that_depends_on_the_rate_is_taken_at_the_rate(sound, tmp_path, capsys):
    text = changed(sound, f"{CORRELATION}.offset", 0.2)
    text = text.replace("amplitude: 1.0", "amplitude: 0.5")
    assert_refused(capsys, tmp_path, text, "--rate-hz")
    code, out = imported(tmp_path, text, "--rate-hz", "10")
    assert code == 0
    assert load_pem(str(out)).memory.tau_s > 0.0


def test_configurations_are_chosen_by_name(sound, tmp_path, capsys):
    document = yaml.safe_load(sound)
    named = document["/**"]["ros__parameters"][TOPIC]["noise"]["v4"]
    named["far"] = named["car"] | {"ellipse_y_radii": [float(k) for k in range(20, 31)]}
    text = yaml.dump(document, Dumper=_Plain)
    assert_refused(capsys, tmp_path, text, "choose one of the file's configurations: car, far")
    assert_refused(capsys, tmp_path, text, "config is 'near'", "--config", "near")
    assert imported(tmp_path, text, "--config", "far")[0] == 0
    printed = capsys.readouterr().out
    assert "left in the file: configurations car" in printed
    assert "beyond 30 m nothing is reported" in printed


class _Plain(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True


def test_numbers_as_rosss_own_reader_takes_them(sound, tmp_path):
    text = changed(sound, RATES, [0.5] * 11).replace("- 0.5\n", "- 5e-1\n")
    assert "5e-1" in text
    code, out = imported(tmp_path, text)
    assert code == 0
    assert (load_pem(str(out)).table_logit == 0.0).all()
