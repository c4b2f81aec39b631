"""Salient variables, files of obstacles and detections, and the command that collects them."""

import csv
import re

import numpy as np
from hypothesis import strategies as st

from pemviz.cli.main import main
from pemviz.files.shipped import asset_path
from pemviz.pem import SALIENT_COLUMNS
from pemviz.pem.model_files import ASSET_FOLDER


def braking_rows(gaps_m) -> np.ndarray:
    """Salient variables [n, 11] of the braking scenario at the given gaps."""
    gaps_m = np.asarray(gaps_m, dtype=float)
    z = gaps_m + 2.5
    rows = np.zeros((len(z), len(SALIENT_COLUMNS)))
    rows[:, 3] = -np.pi / 2 - np.arctan2(0.0, z)
    rows[:, 4:7] = (1.53, 1.63, 5.0)
    rows[:, 8] = 1.65
    rows[:, 9] = z
    rows[:, 10] = -np.pi / 2
    return rows


def random_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    """Salient variables [count, 11] over all that the models accept."""
    rows = np.empty((count, len(SALIENT_COLUMNS)))
    rows[:, 0] = rng.integers(0, 7, count)
    rows[:, 1] = rng.random(count)
    rows[:, 2] = rng.integers(0, 3, count)
    rows[:, 3] = rng.uniform(-np.pi, np.pi, count)
    rows[:, 4:7] = rng.uniform(0.5, 6.0, (count, 3))
    rows[:, 7] = rng.normal(0, 10, count)
    rows[:, 8] = rng.normal(1.6, 0.4, count)
    rows[:, 9] = rng.uniform(-30, 90, count)
    rows[:, 10] = rng.uniform(-np.pi, np.pi, count)
    return rows


seeds = st.integers(0, 2**32 - 1)


def shipped_file(name):
    return asset_path(ASSET_FOLDER, f"{name}.safetensors")


def rows_of(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def collect_command(log_format, paths, *options):
    """Exit code of ``pemviz pem collect`` with the paths by their options."""
    given = [word for name, path in paths.items() for word in (f"--{name}", str(path))]
    return main(["pem", "collect", "--format", log_format, *given, *options])


def assert_refused(capsys, log_format, paths, words):
    """The command says in one line what is wrong, and writes nothing."""
    assert collect_command(log_format, paths) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(words, line), line
    assert not paths["out"].exists()
