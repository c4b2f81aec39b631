"""What settings trade violations of one rule for those of another, and which are not dominated.

A setting is dominated by one that breaks neither rule more often and one less often. By estimates
that is decided for all; for sure it is where the 95 % intervals of both rules lie apart. What all
settings have in common, such as the error model, is not in these intervals.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pemviz.errors import ConfigError
from pemviz.reports.document import Block, Caution, Paragraph, Section, Table
from pemviz.reports.estimate_words import interval_text, number_text
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.plan import RULE, Setting, Variation, setting_label, value_text
from pemviz.types import Estimate

Standing = Literal["front", "small gain", "perhaps dominated", "dominated", "not known"]
STANDINGS: Mapping[Standing, str] = {
    "front": "not dominated",
    "small gain": "not dominated; its gain is within the intervals over",
    "perhaps dominated": "perhaps dominated by",
    "dominated": "dominated by",
    "not known": "not known",
}
"""From the best on, in words; those that end in 'over' and 'by' are followed by a setting."""
ON_FRONT: tuple[Standing, ...] = ("front", "small gain")
MEANS = (
    "Dominated: another setting breaks both rules less often, by intervals that do not overlap; "
    "perhaps dominated: by the estimates alone. Gain within the intervals: another breaks one rule "
    "less often for sure, and is worse in the other by less than the intervals tell. The intervals "
    "are those of sampling: the error model is taken as right, in all settings alike."
)


@dataclass(frozen=True)
class TradePoint:
    """One setting, and how likely it breaks either rule.

    Attributes:
        name: Of the setting.
        first: Of the first rule; ``None`` where its run is not done.
        second: Of the second, likewise.
        standing: Beside all others; not known where an interval is none at its level.
        by: The setting that dominates it, or that it has no measured gain over.
    """

    name: str
    first: Estimate | None
    second: Estimate | None
    standing: Standing = "not known"
    by: str = ""


@dataclass(frozen=True)
class Trade:
    """Two rules, and the points of all settings, in the sweep's order."""

    rules: tuple[str, str]
    points: tuple[TradePoint, ...]


def trade_variation(text: str, *, seeds: int, varied: Sequence[str]) -> Variation:
    """What is varied to see a trade between the rules of ``RULE,RULE``: runs of one rule each.

    Raises:
        ConfigError: They are not two, or the sweep has several seeds, or varies rules itself.
    """
    rules = tuple(word.strip() for word in text.split(","))
    if len(rules) != 2 or len(set(rules)) != 2 or "" in rules:
        message = f"trade = {text!r}: must be two rules of the configuration, RULE,RULE"
        raise ConfigError(message)
    if seeds > 1 or "seed" in varied or RULE in varied:
        message = f"trade = {text!r}: has one seed and varies rule itself; leave seeds and rule out"
        raise ConfigError(message)
    return Variation(field=RULE, values=rules)


def trade_of(states: Sequence[RunState], rules: tuple[str, str]) -> Trade:
    """Where every setting of a sweep that varies these rules stands."""
    found: dict[Setting, dict[object, Estimate | None]] = {}
    for state in states:
        setting = tuple(one for one in state.planned.setting if one[0] != RULE)
        rule = dict(state.planned.setting)[RULE]
        found.setdefault(setting, {})[rule] = state.estimate
    points = [
        TradePoint(name, of_rules.get(rules[0]), of_rules.get(rules[1]))
        for name, of_rules in zip(_names(list(found)), found.values(), strict=True)
    ]
    return Trade(rules, tuple(_placed(point, points) for point in points))


def _names(settings: Sequence[Setting]) -> Iterator[str]:
    """Each in a few words: what all have in common is left out."""
    common = set(settings[0]).intersection(*settings) if len(settings) > 1 else set[Any]()
    for setting in settings:
        own = tuple(one for one in setting if one not in common)
        yield value_text(own[0][1]) if len(own) == 1 else setting_label(own) or "all"


def is_known(estimate: Estimate | None) -> bool:
    """Whether there is an estimate whose interval is one at its level."""
    return (
        estimate is not None
        and None not in (estimate.ci_low, estimate.ci_high)
        and not interval_caveats(estimate)
    )


def _placed(point: TradePoint, points: Sequence[TradePoint]) -> TradePoint:
    """The point with its standing among all of them."""
    if not (is_known(point.first) and is_known(point.second)):
        return point
    better: dict[Standing, list[TradePoint]] = {
        "dominated": [], "perhaps dominated": [], "small gain": []
    }  # fmt: skip
    for other in points:
        if not (is_known(other.first) and is_known(other.second)):
            continue
        gains = _below(other.first, point.first), _below(other.second, point.second)
        losses = _below(point.first, other.first), _below(point.second, other.second)
        if all(gains):
            better["dominated"].append(other)
        if _is_behind(_place(point), _place(other)):
            better["perhaps dominated"].append(other)
        if any(gains) and not any(losses):
            better["small gain"].append(other)
    for standing, others in better.items():
        if others:
            by = min(others, key=lambda one: math.prod(_place(one)))
            return replace(point, standing=standing, by=by.name)
    return replace(point, standing="front")


def _is_behind(place: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether the other is less in one and no more in the other, by estimates."""
    return place != other and all(b <= a for a, b in zip(place, other, strict=True))


def _place(point: TradePoint) -> tuple[float, float]:
    return _probability(point.first), _probability(point.second)


def _below(one: Estimate | None, other: Estimate | None) -> bool:
    """Whether the first is less by more than the intervals leave open."""
    if one is None or other is None or one.ci_high is None or other.ci_low is None:
        return False
    return one.ci_high < other.ci_low


def _probability(estimate: Estimate | None) -> float:
    return 1.0 if estimate is None else estimate.probability


def trade_section(trade: Trade) -> Section:
    """Settings in rows, along the front and then those behind it: P(broken) of both rules."""
    order = list(STANDINGS)
    ranked = sorted(
        trade.points,
        key=lambda one: (max(order.index(one.standing), len(ON_FRONT) - 1), _place(one)),
    )
    rows = tuple(
        (
            point.name,
            _cell(point.first),
            _cell(point.second),
            f"{STANDINGS[point.standing]} {point.by}".rstrip(),
        )
        for point in ranked
    )
    best = [point.name for point in ranked if point.standing in ON_FRONT]
    said: list[Block] = [Paragraph(f"Not dominated: {'; '.join(best) or 'none is known'}.")]
    unknown = sum(point.standing == "not known" for point in ranked)
    if unknown:
        said.append(
            Caution(
                f"{unknown} of {len(ranked)} settings are not known, and not compared: a run of "
                "theirs is missing, or its interval is none. More rollouts may tell: --vary "
                "max-rollouts=50000"
            )
        )
    table = Table(("setting", *trade.rules, "standing"), rows, note=MEANS)
    title = f"Trade between {trade.rules[0]} and {trade.rules[1]}"
    return Section("trade", title, (*said, table), (*said, table))


def _cell(estimate: Estimate | None) -> str:
    if estimate is None:
        return "not run"
    interval = interval_text(estimate, caveats=interval_caveats(estimate))
    return f"{number_text(estimate.probability)} ({interval})"
