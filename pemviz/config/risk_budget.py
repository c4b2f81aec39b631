"""A risk budget as its TOML file states it: what is accepted, hazards, their factors, sources.

For each hazard::

    harm an hour = encounters an hour x P(violation | encounter) x P(harm | violation)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pemviz.config.ranges import Range
from pemviz.config.records import read_record
from pemviz.config.toml_files import read_table
from pemviz.errors import ConfigError

Positive = Annotated[float, Range(low=1e-100, high=1e100)]
Chance = Annotated[float, Range(low=1e-100, high=1.0)]
Events = Annotated[int, Range(low=0, high=10**12)]
Trials = Annotated[int, Range(low=1, high=10**12)]
Coefficient = Annotated[float, Range(low=-1e6, high=1e6)]
StdError = Annotated[float, Range(low=0.0, high=1e6)]
Correlation = Annotated[float, Range(low=-1.0, high=1.0)]
SpeedUnit = Literal["m/s", "km/h", "mph"]
Uncertainty = Literal["all", "sampling"]
PER_MPS: dict[SpeedUnit, float] = {"m/s": 1.0, "km/h": 3.6, "mph": 3600.0 / 1609.344}
MOST_HAZARDS = 100
ANY_RULE = "any"
MEDIAN = ("median", "low", "high")
COUNTED, DRIVEN = ("events", "trials"), ("events", "hours")
CURVE = ("intercept", "slope")


@dataclass(frozen=True, kw_only=True)
class EncounterRate:
    """Encounters an hour: events that were counted in hours driven, or an interval.

    Attributes:
        source: Where the numbers are from.
        events: Encounters that were counted.
        hours: Of driving in which they were [h].
        median: Encounters an hour [1/h].
        low: Lower end of its 95 % interval [1/h].
        high: Upper end [1/h].
    """

    source: str
    events: Events | None = None
    hours: Positive | None = None
    median: Positive | None = None
    low: Positive | None = None
    high: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class StatedProbability:
    """A probability: events among trials, or a median with a 95 % interval.

    Attributes:
        source: Where the numbers are from.
        events: How often it happened.
        trials: Of so many.
        median: The probability.
        low: Lower end of its 95 % interval.
        high: Upper end; all three equal: taken as known exactly.
    """

    source: str
    events: Events | None = None
    trials: Trials | None = None
    median: Chance | None = None
    low: Chance | None = None
    high: Chance | None = None


@dataclass(frozen=True, kw_only=True)
class HarmProbability(StatedProbability):
    """P(harm | violation): as any probability, or an injury-risk curve.

    With it P(harm) = 1 / (1 + exp(-(intercept + slope v))), v the impact speed.

    Attributes:
        intercept: Of the curve.
        slope: Of the curve, per unit of speed.
        intercept_std_error: Of the intercept; 0: taken as known exactly.
        slope_std_error: Of the slope, likewise.
        correlation: Of the two estimates.
        speed_unit: Of the curve's speeds.
        share: What the curve takes of the speed at which ego and other close in: 1 that speed
            itself, 0.5 the change of speed of either of two equal masses that stick together.
        impact_speed: The same speed for all violations, in the curve's unit, in place of those at
            which the run's violating rollouts hit.
    """

    intercept: Coefficient | None = None
    slope: Coefficient | None = None
    intercept_std_error: StdError = 0.0
    slope_std_error: StdError = 0.0
    correlation: Correlation = 0.0
    speed_unit: SpeedUnit = "km/h"
    share: Annotated[float, Range(low=0.0, low_open=True, high=1.0)] = 1.0
    impact_speed: Annotated[float, Range(low=0.0, high=1000.0)] | None = None


@dataclass(frozen=True, kw_only=True)
class Hazard:
    """One way in which harm comes about.

    Attributes:
        name: What it is called; no other hazard is.
        encounters: How often it may come about.
        harm: P(harm | violation).
        runs: Run folders, seen from the budget's, whose answer is P(violation | encounter); of
            several the one that reaches highest, or lowest, counts at either end.
        rule: Of the runs' rules, or ``any``; left out where there is one.
        uncertainty: Whether all that leaves the runs' answer open counts, as the range to act on
            has it, or the ``sampling`` alone, which takes the error model for right.
        violation: P(violation | encounter) from elsewhere, in place of runs.
    """

    name: str
    encounters: EncounterRate
    harm: HarmProbability
    runs: tuple[str, ...] = ()
    rule: str | None = None
    uncertainty: Uncertainty = "all"
    violation: StatedProbability | None = None


@dataclass(frozen=True, kw_only=True)
class RiskBudget:
    """A risk budget.

    Attributes:
        accepted_harm_per_hour: How often harm is accepted [1/h], of all hazards together.
        source: Where that is from.
        hazards: Those that add up.
        name: What the budget is called.
    """

    accepted_harm_per_hour: Positive
    source: str
    hazards: tuple[Hazard, ...]
    name: str = "Risk budget"


def load_budget(path: Path) -> RiskBudget:
    """Read and check a budget.

    Raises:
        ConfigError: The file cannot be read, or one line that names the field and what is allowed.
    """
    try:
        budget = read_record(RiskBudget, read_table(path, kind="risk budget"))
        _check(budget)
    except ConfigError as error:
        message = f"budget {path}: {error}"
        raise ConfigError(message) from error
    return budget


def _check(budget: RiskBudget) -> None:
    _check_text("source", budget.source)
    _check_text("name", budget.name)
    if not 1 <= len(budget.hazards) <= MOST_HAZARDS:
        message = f"hazards: must be 1 to {MOST_HAZARDS}, are {len(budget.hazards)}"
        raise ConfigError(message)
    names = set[str]()
    for place, hazard in enumerate(budget.hazards):
        where = f"hazards[{place}]"
        _check_text(f"{where}.name", hazard.name)
        if hazard.name in names:
            message = f"{where}.name = {hazard.name!r}: is the name of another hazard"
            raise ConfigError(message)
        names.add(hazard.name)
        _check_hazard(hazard, where)


def _check_hazard(hazard: Hazard, where: str) -> None:
    if bool(hazard.runs) == (hazard.violation is not None):
        message = f"{where}: must have either runs or violation, has {_which(hazard)}"
        raise ConfigError(message)
    if len(set(hazard.runs)) < len(hazard.runs):
        message = f"{where}.runs: names a run twice"
        raise ConfigError(message)
    if not hazard.runs and hazard.rule is not None:
        message = f"{where}.rule = {hazard.rule!r}: only of runs; violation states its probability"
        raise ConfigError(message)
    _check_factor(hazard.encounters, f"{where}.encounters", (DRIVEN, MEDIAN))
    harm, place = hazard.harm, f"{where}.harm"
    _check_factor(harm, place, (COUNTED, MEDIAN, CURVE))
    if harm.intercept is None:
        of_curve = ("intercept_std_error", "slope_std_error", "correlation", "impact_speed")
        stray = next((name for name in of_curve if getattr(harm, name)), None)
        if stray is not None:
            message = f"{place}.{stray}: only of a curve, which has intercept and slope"
            raise ConfigError(message)
    elif not hazard.runs and harm.impact_speed is None:
        message = f"{place}.impact_speed: is missing: without runs there are no impact speeds"
        raise ConfigError(message)
    if hazard.violation is not None:
        _check_factor(hazard.violation, f"{where}.violation", (COUNTED, MEDIAN))


def _which(hazard: Hazard) -> str:
    return "both" if hazard.runs else "neither"


def _check_factor(factor: Any, where: str, ways: Iterable[tuple[str, ...]]) -> None:
    """One way of stating it, whole, and no field of another."""
    _check_text(f"{where}.source", factor.source)
    ways = tuple(ways)
    fields = {name for way in ways for name in way}
    given = {name for name in fields if getattr(factor, name) is not None}
    if not any(given == set(way) for way in ways):
        allowed = " or ".join(", ".join(way) for way in ways)
        message = f"{where}: must have {allowed}; has {', '.join(sorted(given)) or 'none'}"
        raise ConfigError(message)
    if factor.median is not None and not factor.low <= factor.median <= factor.high:
        message = f"{where}: must have low <= median <= high"
        raise ConfigError(message)
    if "trials" in given and factor.events > factor.trials:
        message = f"{where}.events = {factor.events}: must be at most trials, {factor.trials}"
        raise ConfigError(message)


def _check_text(where: str, text: str) -> None:
    if not text.strip():
        message = f"{where} = {text!r}: must say something"
        raise ConfigError(message)
