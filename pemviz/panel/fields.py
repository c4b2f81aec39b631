"""Hints for controls, taken from where the fields are declared, so that both say the same."""

import ast
import inspect
import textwrap
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, get_args, get_origin, get_type_hints

from pemviz.config import ExperimentConfig
from pemviz.ranges import Range


@lru_cache(maxsize=8)
def field_docs(kind: type) -> dict[str, str]:
    """The text beneath each field of a dataclass, on one line."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    docs: dict[str, str] = {}
    for field, after in zip(body, body[1:], strict=False):
        named = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if (
            named
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
            and isinstance(after.value.value, str)
        ):
            assert isinstance(field, ast.AnnAssign)
            assert isinstance(field.target, ast.Name)
            docs[field.target.id] = " ".join(after.value.value.split())
    return docs


@dataclass(frozen=True)
class Limits:
    """Bounds of a number; an open bound is moved inwards by a step."""

    low: float | None
    high: float | None


def limits(name: str, *, step: float) -> Limits:
    """Bounds of a number field of the experiment."""
    annotation = get_type_hints(ExperimentConfig, include_extras=True)[name]
    found = [a for a in get_args(annotation) if isinstance(a, Range)]
    if get_origin(annotation) is not Annotated or not found:
        return Limits(None, None)
    limit = found[0]
    low = None if limit.low is None else limit.low + (step if limit.low_open else 0.0)
    high = None if limit.high is None else limit.high - (step if limit.high_open else 0.0)
    return Limits(low, high)


def hint(name: str) -> str:
    """What a field of the experiment means, with unit and range."""
    return field_docs(ExperimentConfig)[name]
