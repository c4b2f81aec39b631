"""Rules that keep the project readable, checked mechanically."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pemviz"
LONGEST_FILE = 400
LONGEST_FUNCTION = 40
DOCUMENTED = ("stl", "pem", "proposals", "simulators", "sampling")

# Longer than 40 lines without its docstring, and why it stays in one piece.
LONG_FUNCTIONS = {
    (
        "cli/serve.py",
        "_serve",
    ): "sets up and takes down in one order: signals, server, browser",
    (
        "runs/experiment.py",
        "build_method",
    ): "one branch a method",
    (
        "runs/model_comparison.py",
        "compare_models",
    ): "draws once for all models",
    ("panel/views/ranking_table.py", "ranking_table"): "one table: its markup reads as one piece",
    ("pem/data/collect.py", "collect"): "the matching of one image, step by step",
    (
        "pem/judging/distance_curve_picture.py",
        "write_picture",
    ): "one picture, back to front",
    ("recording/views.py", "_learning"): "a list of views with their titles",
    ("recording/views.py", "_worst"): "a list of views with their titles",
    (
        "sampling/estimates/estimate.py",
        "mixture_estimate",
    ): "one formula after the other",
    (
        "sampling/mixture/balance_heuristic.py",
        "extended",
    ): "every field of the pool",
    ("stl/semantics.py", "evaluate"): "one case for each kind of formula",
}


def files():
    return sorted(PACKAGE.rglob("*.py"))


def functions(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def length(function):
    """Lines without the docstring."""
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        lines -= function.body[0].end_lineno - function.body[0].lineno + 1
    return lines


def test_no_file_is_long():
    everything = [*files(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in everything}
    assert {path: size for path, size in sizes.items() if size > LONGEST_FILE} == {}


def test_long_functions_are_few_and_say_why():
    long = {
        (path.relative_to(PACKAGE).as_posix(), function.name)
        for path in files()
        for function in functions(path)
        if length(function) > LONGEST_FUNCTION
    }
    assert long - set(LONG_FUNCTIONS) == set(), "split them, or list them with a reason"
    assert set(LONG_FUNCTIONS) - long == set(), "no longer long: take them off the list"


def public_definitions(path):
    """Public functions and classes; methods are ruff's to check."""
    return [
        node
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
    ]


@pytest.mark.parametrize("part", DOCUMENTED)
def test_public_names_are_documented(part):
    bare = [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in sorted((PACKAGE / part).rglob("*.py"))
        for node in public_definitions(path)
        if not ast.get_docstring(node)
    ]
    assert bare == []


@pytest.mark.parametrize("part", DOCUMENTED)
def test_errors_that_public_functions_raise_are_documented(part):
    """A function that raises says so."""
    silent = [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in sorted((PACKAGE / part).rglob("*.py"))
        for node in public_definitions(path)
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(n, ast.Raise) and n.exc is not None for n in ast.walk(node))
        and "Raises" not in (ast.get_docstring(node) or "")
    ]
    assert silent == []


def test_every_path_and_name_in_contributing_exists():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.S))
    paths = [s for s in spans if re.fullmatch(r"[\w./-]+(\.(py|md|toml)|/)(:[\w.]+)?", s)]
    assert len(paths) > 20
    missing = [path for path in paths if not is_there(path)]
    assert missing == []


def is_there(named):
    """Whether ``file.py``, ``folder/`` or ``file.py:Name.member`` is in the checkout."""
    file, _, name = named.partition(":")
    found = [root / file for root in (ROOT, PACKAGE) if (root / file).exists()]
    if not found or not name:
        return bool(found)
    tree = ast.parse(found[0].read_text(encoding="utf-8"))
    targets = {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
    }
    named_parts = {
        node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef)
    }
    return set(name.split(".")) <= targets | named_parts


def test_every_module_and_name_that_a_docstring_points_to_exists():
    sources = [*files(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]
    named = {
        (name, path.relative_to(ROOT).as_posix())
        for path in sources
        for name in re.findall(r"`(pemviz(?:\.\w+)+)`", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert {pair for pair in named if not is_defined(pair[0])} == set()


def is_defined(dotted):
    """Whether a dotted name below the package is a module, or a name in one."""
    place, names = ROOT, dotted.split(".")
    while names and (place / names[0]).is_dir():
        place /= names.pop(0)
    module = place / (f"{names[0]}.py" if names else "__init__.py")
    if names and module.is_file():
        names.pop(0)
    elif names:
        module = place / "__init__.py"
    return not names or re.search(rf"\b{names[0]}\b", module.read_text(encoding="utf-8"))


def test_no_docstring_points_to_a_document_that_is_not_here():
    beyond = [
        path.relative_to(ROOT).as_posix()
        for path in [*files(), *(ROOT / "tests").rglob("*.py")]
        if path != Path(__file__).resolve()
        and re.search(r"\bDESIGN\b", path.read_text(encoding="utf-8"))
    ]
    assert beyond == []
