"""Features of one's own that an error model sees, numbers and categories, in place of a car's.

A model of a drone, an arm or a ship is fitted to columns of a table by their names, and asked about
salient variables ``[..., D]`` that are these, in their order; a category is given by its place
among the categories, see :meth:`OwnFeatures.code`. A simulator says that it gives them by an
attribute ``salient_names``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import FloatArray
from pemviz.errors import PemError

MOST_FEATURES = 100
MOST_CATEGORIES = 50
LEAST_SPREAD = 1e-9
"""Of a column, or of its mean: below it a column does not vary."""


@dataclass(frozen=True)
class Feature:
    """A column that a model sees.

    Attributes:
        low: Smallest number in the training data; of a category 0.
        high: Largest number; of a category the last one's place.
        categories: Its values, if it is a category.
    """

    name: str
    low: float
    high: float
    categories: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.categories:
            return f"{self.name} ({', '.join(self.categories)})"
        return f"{self.name} ({self.low:.4g} to {self.high:.4g})"


@dataclass(frozen=True)
class OwnFeatures:
    """The columns that a model sees, in the order of its salient variables."""

    features: tuple[Feature, ...]

    def __str__(self) -> str:
        return ", ".join(str(one) for one in self.features)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the salient variables, in order."""
        return tuple(one.name for one in self.features)

    @cached_property
    def coded(self) -> tuple[str, ...]:
        """Names of the inputs that say whether a category is there."""
        return tuple(f"{one.name}={value}" for one in self.features for value in one.categories)

    @cached_property
    def numeric(self) -> tuple[int, ...]:
        """Which salient variables are numbers."""
        return tuple(i for i, one in enumerate(self.features) if not one.categories)

    @property
    def input_names(self) -> tuple[str, ...]:
        """What models see: categories one by one, then numbers."""
        return (*self.coded, *(self.features[index].name for index in self.numeric))

    def code(self, name: str, category: str) -> float:
        """What stands for a category in salient variables.

        Raises:
            PemError: There is no such feature, or it has no such category.
        """
        found = next((one for one in self.features if one.name == name), None)
        if found is None:
            raise PemError(f"{name!r} must be one of {', '.join(self.names)}")
        if category not in found.categories:
            allowed = ", ".join(found.categories) or "none, it is a number"
            raise PemError(f"{name}: no category {category!r}, allowed: {allowed}")
        return float(found.categories.index(category))

    def as_rows(self, salient: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
        """Rows ``[n, D]`` of salient variables ``[..., D]``, and the leading shape.

        Raises:
            PemError: There are not as many, a number is not finite, or a category is unknown.
        """
        array = np.asarray(salient, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != len(self.features):
            raise PemError(
                f"salient variables have shape {list(array.shape)}, need "
                f"[..., {len(self.features)}]: {', '.join(self.names)}"
            )
        rows = array.reshape(-1, len(self.features))
        for values, one in zip(rows.T, self.features, strict=True):
            if one.categories:
                wrong = ~np.isin(values, np.arange(len(one.categories)))
                allowed = ", ".join(f"{index} {name}" for index, name in enumerate(one.categories))
            else:
                wrong, allowed = ~np.isfinite(values), "finite numbers"
            if wrong.any():
                row = int(np.argmax(wrong))
                message = f"salient row {row}: {one.name} is {values[row]:g}, allowed: {allowed}"
                raise PemError(message)
        return rows, array.shape[:-1]

    def inputs(
        self, rows: FloatArray, *, mean: FloatArray, std: FloatArray, multiple: int = 1
    ) -> FloatArray:
        """What models see ``[K, n]`` of rows ``[n, D]``; columns of zeros follow to a multiple.

        Args:
            rows: Salient variables.
            mean: What is taken off each number, in order.
            std: What each number is divided by.
            multiple: Of how many there are columns.
        """
        count = len(rows)
        inputs = np.zeros((len(self.input_names), count + -count % multiple), dtype=rows.dtype)
        place = 0
        for values, one in zip(rows.T, self.features, strict=True):
            for code in range(len(one.categories)):
                inputs[place, :count] = values == code
                place += 1
        numbers = rows.T[list(self.numeric)]
        inputs[place:, :count] = (numbers - mean[:, None]) / std[:, None]
        return inputs

    def statistics(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and deviation of each number over rows ``[n, D]``; 1 where it does not vary."""
        numbers = rows[:, list(self.numeric)]
        mean = numbers.mean(axis=0)
        std = numbers.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(self.numeric))
        varies = std > LEAST_SPREAD * np.maximum(np.abs(mean), LEAST_SPREAD)
        return mean, np.where(varies, std, 1.0)

    def beyond(self, salient: FloatArray) -> Iterator[str]:
        """Where salient variables ``[..., D]`` leave what the training data held, in words."""
        rows, _ = self.as_rows(salient)
        for values, one in zip(rows.T, self.features, strict=True):
            outside = (values < one.low) | (values > one.high)
            if outside.any():
                yield (
                    f"{one.name} is {values.min():.4g} to {values.max():.4g} in the scenario, but "
                    f"{one.low:.4g} to {one.high:.4g} in the training data: beyond that P(missed) "
                    "is a guess"
                )

    def to_json(self) -> list[dict[str, Any]]:
        """As plain values."""
        return [
            {"name": one.name, "categories": list(one.categories)}
            if one.categories
            else {"name": one.name, "low": one.low, "high": one.high}
            for one in self.features
        ]


def features_from_json(values: object, *, where: str) -> OwnFeatures | None:
    """Read back what :meth:`OwnFeatures.to_json` wrote; ``None`` of nothing.

    Raises:
        PemError: It is not as pemviz writes it.
    """
    if values is None:
        return None
    if not isinstance(values, list) or not 0 < len(values) <= MOST_FEATURES:
        raise PemError(f"{where}: metadata option 'features' must be a list of 1 to 100 features")
    features = tuple(_feature(one, where=where) for one in values)
    if len({one.name for one in features}) < len(features):
        raise PemError(f"{where}: metadata option 'features' names one twice")
    return OwnFeatures(features)


def _feature(values: object, *, where: str) -> Feature:
    entry: Mapping[str, Any] = values if isinstance(values, dict) else {}
    name, categories = entry.get("name"), entry.get("categories", [])
    numbers = [entry.get(end, 0.0) for end in ("low", "high")]
    sound = (
        isinstance(name, str)
        and isinstance(categories, list)
        and len(categories) <= MOST_CATEGORIES
        and all(isinstance(each, str) for each in categories)
        and len(set(categories)) == len(categories)
        and all(type(each) in (int, float) and np.isfinite(each) for each in numbers)
        and numbers[0] <= numbers[1]
    )
    if not sound:
        raise PemError(f"{where}: metadata option 'features' is not as pemviz writes it")
    return _named(str(name), numbers, tuple(categories))


def _named(name: str, ends: Sequence[float], categories: tuple[str, ...]) -> Feature:
    if categories:
        return Feature(name, 0.0, len(categories) - 1.0, categories)
    return Feature(name, float(ends[0]), float(ends[1]))


def feature_of(name: str, values: FloatArray, categories: Sequence[str] = ()) -> Feature:
    """A feature of training data: numbers ``[n]``, or codes of categories."""
    return _named(name, (float(values.min()), float(values.max())), tuple(categories))


def own_features_of(pem: object) -> OwnFeatures | None:
    """The features of one's own that a model sees; ``None``: a road user's, or it does not say."""
    own: object = getattr(pem, "own", None)
    return own if isinstance(own, OwnFeatures) else None
