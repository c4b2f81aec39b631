"""Rules that keep the project readable, checked mechanically."""

import ast
import re
from pathlib import Path

import pytest

from pemviz.sampling.registry import SHIPPED
from tests.method_names import all_comparisons, parsed

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pemviz"
LONGEST_FILE = 700


def files():
    return sorted(PACKAGE.rglob("*.py"))


@pytest.fixture(scope="module")
def trees():
    """Every file of the package, parsed once."""
    return parsed(files())


def test_no_file_is_long():
    everything = [*files(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in everything}
    assert {path: size for path, size in sizes.items() if size > LONGEST_FILE} == {}


def test_errors_that_public_functions_raise_are_documented(trees):
    """A function that raises says so; that it is documented at all is the linter's to check."""
    silent = [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and any(isinstance(n, ast.Raise) and n.exc is not None for n in ast.walk(node))
        and "Raises" not in (ast.get_docstring(node) or "")
    ]
    assert silent == []


def homes():
    """The folder of each shipped method."""
    return {
        method.name: PACKAGE.joinpath(*method.build.__module__.split(".")[1:-1])
        for method in SHIPPED
    }


def test_no_method_is_asked_for_by_name_outside_its_folder(trees):
    """What differs between methods stands in their descriptions."""
    foreign = {  # 'auto' is a word elsewhere, too
        path: {n for n, home in homes().items() if home not in path.parents and n != "auto"}
        for path in files()
    }
    assert all(len(names) >= len(SHIPPED) - 3 for names in foreign.values())
    assert all_comparisons(foreign, root=ROOT, trees=trees) == []


def test_descriptions_are_asked_for_through_the_registry(trees):
    """Comparing with a description would be comparing with its method's name."""
    strangers = [
        f"{path.relative_to(ROOT)}: {node.module}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and re.fullmatch(r"pemviz\.sampling\.\w+\.description", node.module or "")
        and path != PACKAGE / "sampling" / "registry.py"
        and path.parent != PACKAGE.joinpath(*node.module.split(".")[1:-1])
    ]
    assert strangers == []


@pytest.mark.parametrize(
    "code",
    [
        "config.method == 'splitting'",
        "'naive' != method",
        "method in ('adaptive', 'mixture')",
        "method not in {'x', *['monte-carlo']}",
        "{'zero-variance': 1}",
        "{'naive' if x else y: 1 for x in z}",
        "TABLE['naive']",
        "TABLE.get('naive', 0)",
        "{'naive', 'x'}.__contains__(method)",
        "method.startswith('mixture')",
        "DIRECT = ('naive', 'x')\nmethod in DIRECT",
        "WORDS = {}\nFIRST = 'adaptive'\nWORDS.get(FIRST)",
        "match method:\n    case 'splitting' | 'x':\n        pass",
    ],
)
def test_comparisons_with_a_methods_name_are_found(code, tmp_path):
    path = tmp_path / "code.py"
    path.write_text(code, encoding="utf-8")
    (found,) = all_comparisons({path: set(homes())}, root=tmp_path)
    assert found.startswith(f"{path}:")


def test_a_constant_that_holds_a_name_is_followed_where_it_is_imported(tmp_path):
    (tmp_path / "a.py").write_text("FIRST = 'naive'", encoding="utf-8")
    (tmp_path / "b.py").write_text("from a import FIRST\n\nx == FIRST", encoding="utf-8")
    (tmp_path / "c.py").write_text("from d import FIRST\n\nx == FIRST", encoding="utf-8")
    everywhere = {path: set(homes()) for path in sorted(tmp_path.iterdir())}
    assert all_comparisons(everywhere, root=tmp_path) == [f"{tmp_path / 'b.py'}:3"]


@pytest.mark.parametrize(
    "code",
    [
        "replace(config, method='adaptive')",
        "methods: tuple[str, ...] = ('zero-variance', 'mixture')",
        "monte_carlo_estimate(drawn, method='monte-carlo')",
        "kind == 'restarts'",
        "Choice = Literal['naive', 'mixture']",
        "{'adaptively': 1}",
    ],
)
def test_naming_a_method_is_no_comparison(code, tmp_path):
    path = tmp_path / "code.py"
    path.write_text(code, encoding="utf-8")
    assert all_comparisons({path: set(homes())}, root=tmp_path) == []


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
