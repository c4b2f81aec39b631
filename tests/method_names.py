"""Finds where code asks for a method by its name instead of asking its description."""

import ast
from collections.abc import Iterable, Iterator, Set
from pathlib import Path

LOOKUPS = {"get", "pop", "setdefault", "index", "count", "startswith", "endswith", "__contains__"}
"""Methods of containers and texts whose first argument is compared with something."""


def names_in(node: ast.AST, wanted: Set[str]) -> bool:
    """Whether a constant of ``wanted`` stands anywhere in an expression."""
    return any(isinstance(n, ast.Constant) and n.value in wanted for n in ast.walk(node))


def holders(tree: ast.Module, wanted: Set[str]) -> Set[str]:
    """Variables, at any depth, that are assigned something which holds one of the names."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            plain = [target.id for target in targets if isinstance(target, ast.Name)]
            if not isinstance(node.value, ast.Call) and names_in(node.value, wanted):
                found.update(plain)
    return found


def compared(tree: ast.AST) -> Iterator[ast.expr]:
    """Every expression whose value is compared with another, or looked up."""
    for node in ast.walk(tree):
        match node:
            case ast.Compare():
                yield node.left
                yield from node.comparators
            case ast.Dict():
                yield from (key for key in node.keys if key is not None)
            case ast.DictComp():
                yield node.key
            case ast.MatchValue():
                yield node.value
            case ast.MatchMapping():
                yield from node.keys
            case ast.Subscript(value=ast.Name(id="Literal")):  # a choice names, it does not ask
                pass
            case ast.Subscript():
                yield node.value
                yield node.slice
            case ast.Call(func=ast.Attribute(value=value, attr=attr)) if attr in LOOKUPS:
                yield value
                yield from node.args[:1]
            case _:
                pass


def comparisons(tree: ast.Module, wanted: Set[str], *, variables: Set[str]) -> list[int]:
    """Lines that compare with a name of ``wanted``, or with a variable that holds one."""
    found: set[int] = set()
    for expression in compared(tree):
        held = {n.id for n in ast.walk(expression) if isinstance(n, ast.Name)} & variables
        if held or names_in(expression, wanted):
            found.add(expression.lineno)
    return sorted(found)


def imported(tree: ast.Module, held: dict[str, Set[str]]) -> Set[str]:
    """Variables that a module imports from where they hold one of the names."""
    return {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name in held.get(node.module or "", set())
    }


def parsed(files: Iterable[Path]) -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}


def all_comparisons(
    files: dict[Path, Set[str]], *, root: Path, trees: dict[Path, ast.Module] | None = None
) -> list[str]:
    """``file:line`` of every comparison in files with the names that are foreign to each."""
    trees = parsed(files) if trees is None else trees
    every = set[str]().union(*files.values())
    held = {
        ".".join(path.relative_to(root).with_suffix("").parts): holders(tree, every)
        for path, tree in trees.items()
    }
    return [
        f"{path}:{line}"
        for path, tree in trees.items()
        for line in comparisons(
            tree, files[path], variables=holders(tree, files[path]) | imported(tree, held)
        )
    ]
