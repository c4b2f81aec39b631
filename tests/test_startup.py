"""What is asked first answers without the libraries that take long to import."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NEITHER = (
    *("torch", "rerun", "viser", "pygame", "highway_env", "sklearn", "matplotlib", "gymnasium"),
    *("numba", "scipy", "lark", "safetensors"),
)

CODE = """
import sys
from pemviz.cli.main import main
try:
    assert main({words!r}) == 0
except SystemExit as stop:
    assert not stop.code
print("loaded", sorted({watched!r} & set(sys.modules)))
"""


def loaded(code):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True, text=True, check=False, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1]


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["record", "--help"]])
def test_help_needs_no_slow_library(words):
    assert loaded(CODE.format(words=words, watched=set(NEITHER))) == "loaded []"


def test_import_needs_not_even_numpy():
    watched = {*NEITHER, "numpy"}
    code = f"import sys, pemviz; print('loaded', sorted({watched!r} & set(sys.modules)))"
    assert loaded(code) == "loaded []"


def test_what_methods_are_is_told_without_numpy():
    watched = {*NEITHER, "numpy"}
    code = "import sys; from pemviz.sampling.registry import SHIPPED; assert len(SHIPPED) == 8;"
    code += f"print('loaded', sorted({watched!r} & set(sys.modules)))"
    assert loaded(code) == "loaded []"


@pytest.mark.parametrize("command", ["serve", "open", "export", "reproduce", "pem"])
def test_other_commands_explain_themselves_without_torch(command):
    watched = {"torch", "sklearn", "highway_env", "pygame"}
    assert loaded(CODE.format(words=[command, "--help"], watched=watched)) == "loaded []"


def test_a_run_needs_not_all_of_scipy():
    watched = {"torch", "scipy.stats", "scipy.optimize", "pandas", "matplotlib"}
    code = "import sys, pemviz.cli.record_run;"
    code += f"print('loaded', sorted({watched!r} & set(sys.modules)))"
    assert loaded(code) == "loaded []"


def test_commands_of_error_models_explain_themselves_without_runs():
    watched = {"torch", "sklearn", "pemviz.runs.engine", "pemviz.sampling.mixture.method"}
    assert loaded(CODE.format(words=["pem", "memory", "--help"], watched=watched)) == "loaded []"
