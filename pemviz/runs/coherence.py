"""Does a result agree with itself? Bounds in order, logarithms, counts, the mean of repetitions."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np

from pemviz.errors import ConfigError
from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

TOLERANCE = 1e-9
"""Relative: other versions of libraries may differ in last digits."""
LEAST = 1e-300
"""Below this a double loses digits."""
NOT_FIGURES = ("config", "versions", "timings_s")
AS_WRITTEN = {
    "explanation": "causes",
    "unbiased_probability": "unbiased.probability",
    "unbiased_std_error": "unbiased.std_error",
}
"""Fields that ``result.json`` has under other names."""
MIDDLES = ("probability", "median")
"""What an interval is about, if its record has it."""
MORE, LESS = "must be at least", "must be at most"


def complaints(result: RunResult) -> Iterator[str]:
    """What is wrong, a line each that names the field; fields of files may come from anywhere."""
    yield from disorders(result)
    if result.estimate is not None and result.repetitions and _is_known(result.estimate):
        try:
            with np.errstate(all="ignore"):
                of_all = summarise_repetitions(result.repetitions)
        except (ArithmeticError, ValueError) as error:
            yield f"repetitions: give no estimate together ({error})"
            return
        yield from differences("estimate", result.estimate, of_all, source="repetitions")


def disorders(value: Any) -> Iterator[str]:
    """What contradicts itself in a record, or in records within it."""
    for name, record in _records(value, ""):
        yield from _out_of_order(name, record)
        yield from _counts(name, record)
        yield from _logarithm(name, record)


def differences(
    name: str,
    said: Estimate,
    found: Estimate,
    *,
    source: str,
    among: tuple[str, ...] | None = None,
) -> Iterator[str]:
    """In which figures an estimate differs from one that was formed again.

    Args:
        name: What the estimate is called.
        said: It.
        found: What it should be.
        source: What ``found`` was formed from.
        among: Which fields are compared; ``None``: all numbers.
    """
    for one in fields(Estimate):
        first, second = getattr(said, one.name), getattr(found, one.name)
        number = not isinstance(first, str | tuple)
        if number and (among is None or one.name in among):
            scale = found.probability if one.name.endswith("std_error") else 0.0
            if not agree(first, second, scale=scale):
                field = AS_WRITTEN.get(one.name, one.name)
                yield f"{name}.{field} = {_shown(first)}: {source} give {_shown(second)}"


def agree(first: float | None, second: float | None, *, scale: float = 0.0) -> bool:
    """Whether two figures are the same but for rounding, of terms as large as ``scale``."""
    if first is None or second is None or not (math.isfinite(first) and math.isfinite(second)):
        return _is_undefined(first) and _is_undefined(second)
    largest = max(abs(first), abs(second), scale)
    return abs(first - second) <= max(TOLERANCE * largest, LEAST)


def _is_undefined(value: float | None) -> bool:
    return value is None or not math.isfinite(value)


def _shown(value: float | None) -> str:
    return "null" if _is_undefined(value) else f"{value!r}"


def _is_known(estimate: Estimate) -> bool:
    """Whether its method is at hand: it says how repetitions are put together."""
    try:
        by_name(estimate.method)
    except ConfigError:
        return False
    return True


def _records(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every record in a result, with the name that it has in ``result.json``."""
    if is_dataclass(value):
        yield name, value
        for one in fields(value):
            if one.name not in NOT_FIGURES:
                inner = AS_WRITTEN.get(one.name, one.name)
                yield from _records(getattr(value, one.name), f"{name}.{inner}" if name else inner)
    elif isinstance(value, tuple):
        for index, item in enumerate(cast(tuple[Any, ...], value)):
            yield from _records(item, f"{name}[{index}]")
    elif isinstance(value, Mapping):
        for key, item in cast(Mapping[str, Any], value).items():
            yield from _records(item, f"{name}.{key}")


def _out_of_order(name: str, record: Any) -> Iterator[str]:
    """Ends of intervals, ``low`` and ``high`` in their names, and what lies between them."""
    names = [one.name for one in fields(record)]
    for low in names:
        high = "_".join("high" if word == "low" else word for word in low.split("_"))
        if high == low or high not in names:
            continue
        ends, middle = (low, high), [m for m in MIDDLES if m in names and _holds_middle(record)]
        chain = [end for end in (low, *middle, high) if getattr(record, end) is not None]
        for lower, upper in itertools.pairwise(chain):
            least, most = getattr(record, lower), getattr(record, upper)
            if "probability" in middle:
                least, most = min(least, 1.0), min(most, 1.0)  # weights may carry a mean above 1
            if least > most and not agree(least, most):
                wrong, other, words = (upper, lower, MORE)
                if upper not in ends:
                    wrong, other, words = (lower, upper, LESS)
                told, limit = getattr(record, wrong), getattr(record, other)
                yield f"{name}.{wrong} = {told!r}: {words} {name}.{other}, {limit!r}"


def _holds_middle(record: Any) -> bool:
    """Whether what an interval is about lies in it.

    That between runs of splitting is around another estimate than their mean.
    """
    if not isinstance(record, Estimate):
        return True
    return _is_known(record) and by_name(record.method).interval_basis != "runs"


def _counts(name: str, record: Any) -> Iterator[str]:
    """Some of all are no more than all; without a failure there is no probability."""
    names = [one.name for one in fields(record)]
    chain = ("failures", "rollouts_in_estimate", "rollouts_simulated")
    if "failures" not in names:
        return
    some = [one for one in (*chain, "rollouts") if one in names]
    for fewer, more in itertools.pairwise(some):
        least, most = getattr(record, fewer), getattr(record, more)
        if least > most:
            yield f"{name}.{fewer} = {least}: {LESS} {name}.{more}, {most}"
    if "log10_probability" in names and not record.failures and record.probability:
        yield f"{name}.probability = {record.probability!r}: must be 0 without failures"


def _logarithm(name: str, record: Any) -> Iterator[str]:
    names = [one.name for one in fields(record)]
    if "probability" not in names or "log10_probability" not in names:
        return
    log10, probability = record.log10_probability, record.probability
    power = 0.0 if log10 is None else 10.0**log10
    if not agree(probability, power):
        yield (
            f"{name}.log10_probability = {_shown(log10)}: must be that of "
            f"{name}.probability, {probability!r}"
        )
