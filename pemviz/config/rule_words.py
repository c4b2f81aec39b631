"""What options name: rules NAME=FORMULA, start values NAME=DISTRIBUTION, gate limits NAME=P."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pemviz.config.ranges import Range, check_value
from pemviz.config.settings import Rule
from pemviz.errors import ConfigError


def read_rules(words: Sequence[str]) -> Mapping[str, str]:
    """Name to formula.

    Raises:
        ConfigError: One is not NAME=FORMULA, or a name stands twice.

    Example:
        >>> from pemviz.config.rule_words import read_rules
        >>> read_rules(["no-collision=always[0,90] (gap_lead > 0)"])
        {'no-collision': 'always[0,90] (gap_lead > 0)'}
    """
    return _read_named(words, kind="rule", value="FORMULA")


def read_starts(words: Sequence[str]) -> Mapping[str, str]:
    """Name to distribution.

    Raises:
        ConfigError: One is not NAME=DISTRIBUTION, or a name stands twice.
    """
    return _read_named(words, kind="start", value="DISTRIBUTION")


def _read_named(words: Sequence[str], *, kind: str, value: str) -> Mapping[str, str]:
    found: dict[str, str] = {}
    for word in words:
        name, equals, text = (part.strip() for part in word.partition("="))
        if not equals or not name or not text:
            raise ConfigError(f"{kind} = {word!r}: must be NAME={value}")
        if name in found:
            another = "rule" if kind == "rule" else "start value"
            raise ConfigError(f"{kind} = {word!r}: another {another} has this name")
        found[name] = text
    return found


def rules_text(rules: Sequence[Rule]) -> str:
    """A line for each rule, as :func:`read_rules` takes them."""
    return "\n".join(f"{rule.name} = {rule.formula}" for rule in rules)


Bound = Literal["sampling", "act-on"]
"""Upper end that a gate judges: of the 95 % interval, or of all that leaves an answer open."""


@dataclass(frozen=True)
class GateLimits:
    """Probabilities that must not be exceeded.

    Attributes:
        overall: By the violation of the specification; ``None``: no limit.
        rules: By that of single rules, by name.
        bound: Which upper end must not exceed them.
    """

    overall: float | None = None
    rules: Mapping[str, float] = field(default_factory=dict[str, float])
    bound: Bound = "sampling"


def read_limits(
    words: Sequence[str], *, rules: Sequence[Rule], bound: Bound = "sampling"
) -> GateLimits:
    """What ``P`` and ``NAME=P`` ask for; of several for the same the last holds.

    Raises:
        ConfigError: Something is no probability, or names no rule; or a bound is given for nothing.
    """
    if bound != "sampling" and not words:
        raise ConfigError(f"fail-on = {bound}: must be given with fail-above, whose bound it is")
    names = [rule.name for rule in rules]
    found: dict[str, float] = {}
    for word in words:
        name, equals, text = word.rpartition("=")
        if equals and name not in names:
            known = ", ".join(names) or "there are none"
            raise ConfigError(f"fail-above = {word!r}: must name one of the rules ({known})")
        try:
            found[name] = float(text)
        except ValueError as error:
            message = f"fail-above = {text!r}: must be a number above 0 and at most 1"
            raise ConfigError(message) from error
        probability = Annotated[float, Range(low=0.0, low_open=True, high=1.0)]
        check_value(name="fail-above", value=found[name], annotation=probability)
    return GateLimits(found.pop("", None), found, bound)
