"""What ``import pemviz`` offers: every name, imported only when asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import pemviz

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("name", pemviz.__all__)
def test_every_public_name_is_there(name):
    assert getattr(pemviz, name) is not None
    assert name in dir(pemviz)


def test_checkers_see_what_is_imported_at_run_time():
    """The imports under TYPE_CHECKING name the same modules as the table used at run time."""
    tree = ast.parse((ROOT / "pemviz" / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module.removeprefix("pemviz.")
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    homes = {name: home for home, names in pemviz._HOMES.items() for name in names.split()}
    assert seen == homes
    assert sorted([*seen, "__version__"]) == sorted(pemviz.__all__)


def test_what_is_cited_is_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == pemviz.__version__


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'simulate_everything'"):
        _ = pemviz.simulate_everything


def test_types_and_configurations_need_only_numpy():
    code = (
        "import sys, pemviz; pemviz.Simulator, pemviz.StateBatch, pemviz.ExperimentConfig();"
        "print(sorted({'scipy', 'torch', 'lark', 'sklearn', 'gymnasium'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"


def test_modules_that_pages_name_are_there_without_an_import():
    code = "import pemviz; pemviz.pem.load_pem; pemviz.figures.causes; pemviz.quantiles.log_normal"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
