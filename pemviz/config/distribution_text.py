"""Distributions of start values as options and files have them: ``lognormal(30, 0.3) in [5, 80]``.

A value is random by its quantile function (:mod:`pemviz.quantiles`): it increases with a standard
normal latent. What stands behind ``in`` cuts the distribution off; what remains of it is scaled up
to the whole, so that no probability gathers at the ends.
"""

import math
import re
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.ranges import shown
from pemviz.errors import ConfigError

FORMS = {
    "normal": ("MEAN", "SD"),
    "lognormal": ("MEDIAN", "SPREAD"),
    "uniform": ("LOW", "HIGH"),
    "empirical": ("V1", "V2", "..."),
}
"""What stands in their brackets; ``SPREAD`` is the standard deviation of the logarithm."""
ALLOWED = "a number, " + ", ".join(f"{n}({', '.join(words)})" for n, words in FORMS.items())
LONGEST_TEXT = 20_000
"""Characters of a text: some thousand values of a sample."""
LARGEST = 1e6
LARGEST_SPREAD = 5.0
FARTHEST = 30.0
"""Spreads from the middle that an interval may lie at: beyond it is a slip of the pen."""
CALL = re.compile(r"(?P<kind>[a-z]+)\s*\((?P<numbers>[^()]*)\)")


@dataclass(frozen=True)
class Distribution:
    """How one start value is distributed.

    Attributes:
        kind: ``fixed``, or one of :data:`FORMS`.
        parameters: The value, or what stands in the brackets.
        low: Nothing lies below.
        high: Nothing lies above.
    """

    kind: str
    parameters: tuple[float, ...]
    low: float = -math.inf
    high: float = math.inf

    @property
    def fixed(self) -> bool:
        """Whether it is one value, for which no latent is taken."""
        return self.kind == "fixed"

    def of(self, z: FloatArray) -> FloatArray:
        """Values for standard normals, both ``[...]``; they increase with ``z``."""
        from pemviz import quantiles  # noqa: PLC0415  a configuration is read without scipy

        z = np.asarray(z, dtype=np.float64)
        if self.fixed:
            return np.full(z.shape, self.parameters[0])
        if self.kind == "empirical":
            sample = np.array(self.parameters)
            return quantiles.empirical(z, sample=sample, low=self.low, high=self.high)
        first, second = self.parameters
        if self.kind == "uniform":
            low, high = max(first, self.low), min(second, self.high)
            return quantiles.uniform(z, low=low, high=high)
        if not (math.isinf(self.low) and math.isinf(self.high)):
            low, high = self._ends()
            z = quantiles.truncated(z, low=low, high=high)
        if self.kind == "normal":
            values = quantiles.normal(z, mean=first, sd=second)
        else:
            values = quantiles.log_normal(z, median=first, spread=second)
        return np.clip(values, self.low, self.high)

    def __str__(self) -> str:
        numbers = ", ".join(map(_number_text, self.parameters))
        text = numbers if self.fixed else f"{self.kind}({numbers})"
        if math.isinf(self.low) and math.isinf(self.high):
            return text
        return f"{text} in [{_number_text(self.low)}, {_number_text(self.high)}]"

    def _ends(self) -> tuple[float, float]:
        """``low`` and ``high`` in spreads from the middle of a normal or a log-normal."""
        middle, spread = self.parameters
        if self.kind == "normal":
            return (self.low - middle) / spread, (self.high - middle) / spread
        low = math.log(self.low / middle) if self.low > 0.0 else -math.inf
        high = math.log(self.high / middle) if self.high > 0.0 else -math.inf
        return low / spread, high / spread

    @property
    def remains(self) -> bool:
        """Whether what is cut off leaves something that floating-point numbers tell apart."""
        if self.fixed:
            return True
        if self.kind == "uniform":
            low, high = self.parameters
        elif self.kind == "empirical":
            low, high = min(self.parameters), max(self.parameters)
        else:
            low, high = self._ends()
            return low < high and low < FARTHEST and high > -FARTHEST
        return max(low, self.low) < min(high, self.high)


def read_distribution(text: str, *, name: str) -> Distribution:
    """The distribution that a text spells out.

    Args:
        text: ``30``, ``normal(MEAN, SD)``, ``lognormal(MEDIAN, SPREAD)``, ``uniform(LOW, HIGH)``
            or ``empirical(V1, V2, ...)``; behind all but a number may stand ``in [LOW, HIGH]``,
            where ``-inf`` and ``inf`` leave a side open.
        name: What is distributed so, for messages.

    Raises:
        ConfigError: One line: what is wrong, and what is allowed.

    Example:
        >>> from pemviz.config.distribution_text import read_distribution
        >>> gap = read_distribution("lognormal(30, 0.3) in [5, 80]", name="gap")
        >>> gap.kind, gap.parameters, gap.low, gap.high
        ('lognormal', (30.0, 0.3), 5.0, 80.0)
    """
    where = f"{name} = {shown(text)}"
    if len(text) > LONGEST_TEXT:
        _refuse(where, f"must be at most {LONGEST_TEXT} characters")
    body, bracket, bounds = (part.strip() for part in text.partition("["))
    if not bracket:
        return Distribution(*_body(body, where))
    if not (body.endswith("in") and bounds.endswith("]")):
        _refuse(where, f"must be {ALLOWED}, and 'in [LOW, HIGH]' behind it to cut it off")
    kind, numbers = _body(body.removesuffix("in").rstrip(), where)
    if kind == "fixed":
        _refuse(where, "a single number cannot be cut off")
    ends = _numbers(bounds.removesuffix("]"), where, infinite=True)
    if len(ends) != 2 or not ends[0] < ends[1]:
        _refuse(where, "behind 'in' must be [LOW, HIGH] with LOW below HIGH")
    found = Distribution(kind, numbers, *ends)
    if not found.remains:
        _refuse(where, "nothing of it lies in the interval that it is cut to")
    return found


def _body(body: str, where: str) -> tuple[str, tuple[float, ...]]:
    call = CALL.fullmatch(body)
    if call is None:
        try:
            float(body)
        except ValueError:
            _refuse(where, f"must be {ALLOWED}")
        return "fixed", _numbers(body, where)
    kind = call["kind"]
    if kind not in FORMS:
        _refuse(where, f"must be {ALLOWED}")
    numbers, form = _numbers(call["numbers"], where), FORMS[kind]
    if len(numbers) < 2 or (len(numbers) > 2 and kind != "empirical"):
        _refuse(where, f"{kind} takes ({', '.join(form)}), not {len(numbers)} number(s)")
    _check_numbers(kind, numbers, where)
    return kind, numbers


def _check_numbers(kind: str, numbers: tuple[float, ...], where: str) -> None:
    first, second = numbers[:2]
    if kind == "normal" and second <= 0.0:
        _refuse(where, f"SD = {second:g}: must be above 0")
    if kind == "lognormal" and first <= 0.0:
        _refuse(where, f"MEDIAN = {first:g}: must be above 0")
    if kind == "lognormal" and not 0.0 < second <= LARGEST_SPREAD:
        _refuse(where, f"SPREAD = {second:g}: must be above 0 and at most {LARGEST_SPREAD:g}")
    if kind == "uniform" and not first < second:
        _refuse(where, f"LOW = {first:g}: must be below HIGH = {second:g}")
    if kind == "empirical" and min(numbers) == max(numbers):
        _refuse(where, "must hold two different values; for one value, give it alone")


def _numbers(text: str, where: str, *, infinite: bool = False) -> tuple[float, ...]:
    """What stands between commas; without any, none."""
    found = list[float]()
    for word in text.split(",") if text.strip() else []:
        try:
            value = float(word)
        except ValueError:
            _refuse(where, f"{shown(word.strip())} is no number")
        if not (abs(value) <= LARGEST or (infinite and math.isinf(value))):
            _refuse(where, f"{shown(word.strip())}: must be from -{LARGEST:g} to {LARGEST:g}")
        found.append(value)
    return tuple(found)


def _number_text(value: float) -> str:
    """As short as it can be while it is read back to the same number."""
    return repr(int(value)) if value.is_integer() else repr(value)


def _refuse(where: str, message: str) -> NoReturn:
    raise ConfigError(f"{where}: {message}")
