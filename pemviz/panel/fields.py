"""Hints for controls, taken from where the fields are declared, so that both say the same."""

import ast
import inspect
import textwrap
from functools import lru_cache
from itertools import pairwise
from typing import get_args, get_type_hints

from pemviz.config import ExperimentConfig
from pemviz.config.ranges import Range


@lru_cache(maxsize=8)
def field_docs(kind: type) -> dict[str, str]:
    """The text beneath each field of a dataclass, on one line."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    docs: dict[str, str] = {}
    for field, after in pairwise(body):
        match field, after:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(words))),
            ):
                docs[name] = " ".join(words.split())
            case _:
                pass
    return docs


def limits(name: str, *, step: float) -> tuple[float, float]:
    """Bounds of a number field of the experiment; an open bound is moved inwards by a step.

    Raises:
        ValueError: The field declares no bounds.
    """
    annotation = get_type_hints(ExperimentConfig, include_extras=True)[name]
    arms = (annotation, *get_args(annotation))  # what may be left out is a union with None
    for limit in (part for arm in arms for part in get_args(arm)):
        if isinstance(limit, Range) and limit.low is not None and limit.high is not None:
            low = limit.low + (step if limit.low_open else 0.0)
            return low, limit.high - (step if limit.high_open else 0.0)
    message = f"{name} declares no bounds"
    raise ValueError(message)


def hint(name: str) -> str:
    """What a field of the experiment means, with unit and range."""
    return field_docs(ExperimentConfig)[name]
