"""Imports point one way, and the core works where optional parts cannot be imported."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pemviz"
ROW = re.compile(r"^\| \d+ \| (?P<parts>[^|]+) \|", re.M)


def layers(contributing):
    """The table of layers in CONTRIBUTING: their parts, and which of these stand apart."""
    rows = [match["parts"] for match in ROW.finditer(contributing)]
    named = [set(re.findall(r"`(\w+)`", row)) for row in rows]
    apart = [parts for parts, row in zip(named, rows, strict=True) if " / " in row]
    assert len(named) > 5
    assert len(apart) == 2
    return named, apart


# Each layer may import from those before it, and within itself.
LAYERS, APART = layers((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
ONLY_IN = {
    "rerun": {"recording"},
    "rerun_bindings": {"recording"},
    "viser": {"panel"},
    "highway_env": {"simulators"},
    "pygame": {"simulators"},
    "dask": {"sweep"},
    "distributed": {"cluster", "sweep"},
    "rosbags": {"pem"},
    "yaml": {"files"},
    "pyarrow": {"sweep", "export", "recording", "pem"},
    "scenariogeneration": {"export"},
    "commonroad": {"export"},
    "libsumo": {"simulators"},
    "carla": {"simulators"},
    "multiprocessing": {"processes"},
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    """The name below ``pemviz`` that a module belongs to."""
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


@cache
def imported(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            names.add(node.module)
            if node.module == "pemviz":
                names.update(f"pemviz.{alias.name}" for alias in node.names)
    return names


def layer_of(part: str) -> int:
    for number, layer in enumerate(LAYERS):
        if part in layer:
            return number
    pytest.fail(f"pemviz/{part} stands in no layer: add it to LAYERS")


def test_imports_point_one_way():
    wrong = [
        f"{path.relative_to(ROOT)} must not import {name}"
        for path in modules()
        for name in imported(path)
        if name.startswith("pemviz.") and not may_import(part_of(path), name.split(".")[1])
    ]
    assert wrong == []


def may_import(part, other):
    """Whether a part may import another one: from its own layer or one before, if not apart."""
    apart = part != other and any({part, other} <= group for group in APART)
    return layer_of(other) <= layer_of(part) and not apart


def test_some_libraries_are_imported_in_one_place():
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules()
        for name in imported(path)
        if part_of(path) not in ONLY_IN.get(name.split(".")[0], {part_of(path)})
    ]
    assert wrong == []


def test_modules_named_for_it_import_highway_env_and_no_others():
    users = {p for p in modules() if any(n.split(".")[0] == "highway_env" for n in imported(p))}
    assert users == {p for p in modules() if p.stem.startswith("highway_env_")}
    assert users


def module_name(path: Path) -> str:
    """``pemviz/stl/formulas.py`` as ``pemviz.stl.formulas``, a folder by its own name."""
    pieces = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(pieces[:-1] if pieces[-1] == "__init__" else pieces)


def import_graph(sources: dict[str, str]) -> dict[str, set[str]]:
    """For every module the others that its source imports: at the top of the file, inside a
    function or for type checkers alone."""
    graph: dict[str, set[str]] = {}
    for module, source in sources.items():
        graph[module] = imports = set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                imports.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    imports.add(inner if inner in sources else str(node.module))
        imports &= sources.keys() - {module}
    return graph


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Names that lead from one back to itself; none if there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@pytest.mark.parametrize(
    "back",
    [
        "import a",
        "from a import x",
        "def late():\n    from a import x",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from a import x",
    ],
)
def test_the_search_for_circles_finds_them(back):
    sources = {"a": "import folder.b", "folder.b": "from folder import c", "folder.c": back}
    assert set(circle(import_graph(sources))) == set(sources)
    assert circle(import_graph(sources | {"folder.c": "import json"})) == []


@pytest.fixture(scope="module")
def package() -> dict[str, set[str]]:
    return import_graph({module_name(path): path.read_text(encoding="utf-8") for path in modules()})


def test_no_module_imports_itself_by_way_of_others(package):
    assert circle(package) == []


PARTS_IN_FOLDERS = sorted({path.parts[-3] for path in PACKAGE.glob("*/*/*.py")})


def test_no_folder_of_a_part_imports_itself_by_way_of_its_siblings(package):
    """As ``pem/models`` and ``pem/data`` would; what lies in ``pem`` itself may know them all."""
    circles = {}
    for part in PARTS_IN_FOLDERS:
        graph: dict[str, set[str]] = {}
        for module, imports in package.items():
            if (home := sibling(module, part)) is not None:
                siblings = {sibling(name, part) for name in imports} - {None, home}
                graph.setdefault(home, set()).update(siblings)
        circles[part] = circle(graph)
    assert {part: found for part, found in circles.items() if found} == {}
    assert len(circles) > 2


def sibling(module: str, part: str) -> str | None:
    """``models`` for ``pemviz.pem.models.cards``, ``pem``; none for what is in no such folder."""
    pieces = module.split(".")
    folder = PACKAGE / part / pieces[2] if len(pieces) > 2 else None
    return pieces[2] if pieces[1:2] == [part] and folder is not None and folder.is_dir() else None


BLOCKED_RUN = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"rerun", "rerun_bindings", "viser", "pygame", "highway_env"}:
            raise ImportError(f"{name} is blocked")
        return None

sys.meta_path.insert(0, Blocker())
import pemviz
from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run_experiment

result = run_experiment(
    ExperimentConfig(method="naive", final_rollouts=20, measured_memory=False)
)
assert result.status == "done", result
assert result.estimate.failures > 0
print("ran")
"""


def test_engine_runs_with_optional_libraries_blocked():
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKED_RUN],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "ran"


def test_import_alone_loads_nothing_heavy():
    heavy = "{'torch', 'rerun', 'viser', 'pygame', 'highway_env', 'sklearn', 'matplotlib',"
    heavy += " 'distributed', 'dask', 'pyarrow'}"
    code = f"import sys, pemviz; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"
