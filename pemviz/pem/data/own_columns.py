"""Columns of a table that a model of one's own features sees: numbers, or categories."""

from collections.abc import Sequence

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.data.columns import SHOWN, Columns, numbers_of
from pemviz.pem.models.own_features import (
    MOST_CATEGORIES,
    MOST_FEATURES,
    Feature,
    OwnFeatures,
    feature_of,
)

CATEGORY = ":category"
"""Behind a name: its numbers are codes of a category."""
MOST_INPUTS = 250
"""Numbers and categories in all: what a tree can name."""
TAKEN = ("detected", "sequence", "track", "frame")
"""Columns that say who, when and what came out."""


def bare_names(features: Sequence[str]) -> tuple[str, ...]:
    """Columns that features name.

    Raises:
        PemError: There are none, too many, or one twice, or one says what came out.
    """
    names = tuple(one.removesuffix(CATEGORY) for one in features)
    if not 0 < len(names) <= MOST_FEATURES or "" in names:
        raise PemError(f"features: must be 1 to {MOST_FEATURES} names between commas")
    if len(set(names)) < len(names):
        raise PemError(f"features: {next(n for n in names if names.count(n) > 1)!r} is there twice")
    if taken := [name for name in names if name in TAKEN]:
        raise PemError(f"features: {taken[0]!r} is no state that an outcome can depend on")
    return names


def named_columns(own: OwnFeatures) -> tuple[str, ...]:
    """What names the columns of a model's features, as :func:`own_columns` takes them."""
    return tuple(f"{one.name}{CATEGORY * bool(one.categories)}" for one in own.features)


def own_columns(columns: Columns, features: Sequence[str]) -> tuple[FloatArray, OwnFeatures]:
    """Salient variables ``[n, D]`` of a table's own columns, and what they are.

    A column of numbers alone is a number, one of words a category.

    Raises:
        PemError: A column holds both, or what is not finite, nothing, or too many categories.
    """
    names = bare_names(features)
    salient = np.empty((len(columns), len(names)))
    found: list[Feature] = []
    if not len(columns):
        raise PemError(f"{columns.path}: the table has no rows")
    for place, (name, asked) in enumerate(zip(names, features, strict=True)):
        values, wrong = numbers_of(columns.table.column(name))
        is_truth = str(columns.table.column(name).type) == "bool"
        if asked.endswith(CATEGORY) or is_truth or wrong.all():
            salient[:, place], categories = _codes(columns, name)
            found.append(feature_of(name, salient[:, place], categories))
            continue
        wrong |= ~np.isfinite(values)
        if wrong.any():
            row = int(np.argmax(wrong))
            cell = str(columns.texts(name)[row])[:SHOWN]
            raise PemError(
                f"{columns.where(row, name)} is {cell!r}, allowed: numbers alone, or words alone "
                f"(a category; of numbers too as {name}{CATEGORY})"
            )
        salient[:, place] = values
        found.append(feature_of(name, values))
    own = OwnFeatures(tuple(found))
    if len(own.input_names) > MOST_INPUTS:
        count = len(own.input_names)
        raise PemError(f"features: {count} numbers and categories, allowed: at most {MOST_INPUTS}")
    return salient, own


def _codes(columns: Columns, name: str) -> tuple[FloatArray, tuple[str, ...]]:
    texts = columns.texts(name)
    if (texts == "").any():
        row = int(np.argmax(texts == ""))
        raise PemError(f"{columns.where(row, name)} is empty, allowed: a category's name")
    categories, codes = np.unique(texts, return_inverse=True)
    if categories.size > MOST_CATEGORIES:
        raise PemError(
            f"{columns.path}: column {name!r} has {categories.size} different words, allowed for a "
            f"category: at most {MOST_CATEGORIES}"
        )
    return codes.astype(np.float64), tuple(str(one) for one in categories)
