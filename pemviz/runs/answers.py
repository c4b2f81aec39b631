"""What a run answers: each of its questions, and how far each answer is open.

Of several rules each is a question, those about collisions first, and last whether any is broken.
An answer comes with the one doubt that decides it: the source of uncertainty that reaches highest,
or one of which nobody looked how far it reaches.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from pemviz.config import ExperimentConfig, Rule
from pemviz.runs.result import MeasuredAnswer, RuleAnswer, RunResult
from pemviz.runs.uncertainty import (
    UncertaintySource,
    ends_of,
    run_interval_caveats,
    uncertainty_budget,
)
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

Named = TypeVar("Named", Rule, RuleAnswer)
COLLISION = re.compile(r"collision|contact|crash", re.IGNORECASE)
"""In the name of a rule: it is about collisions, and answered first."""
ONLY_FOR_NOTHING = "needless_deceleration"
"""The logical scenarios' signal of braking harder than what is there asks for."""


@dataclass(frozen=True)
class OpenRange:
    """How far an answer is open: what is honest to act on.

    Attributes:
        low: Lowest end of all sources of doubt; ``None`` where none is known.
        high: Highest end; ``None`` where the source that decides has none.
        decided_by: The source that reaches highest, or is not known how far; or the sampling, where
            its interval is none.
    """

    low: float | None
    high: float | None
    decided_by: UncertaintySource


@dataclass(frozen=True)
class Answer:
    """How likely one thing is that must not happen.

    Attributes:
        rule: The rule that is broken; ``None``: the specification, or any of several rules.
        estimate: How likely.
        caveats: Why its interval is none.
        measured: How likely with memories of misses that were measured on video.
        open: How far that is open.
        impossible: Whether nothing that is simulated can bring it about.
    """

    rule: RuleAnswer | None
    estimate: Estimate
    caveats: tuple[str, ...]
    measured: tuple[MeasuredAnswer, ...]
    open: OpenRange
    impossible: bool = False


def answers(result: RunResult) -> tuple[Answer, ...]:
    """A run's answers, the one to read first; none without an estimate."""
    if result.estimate is None:
        return ()
    sources, memory = uncertainty_budget(result), result.memory
    caveats = run_interval_caveats(result)
    every = Answer(
        rule=None,
        estimate=result.estimate,
        caveats=caveats,
        measured=() if memory is None else memory.measured,
        open=_open(sources, caveats),
    )
    return (*(_of_rule(result, rule, sources) for rule in rules_in_order(result.rules)), every)


def rules_in_order(rules: Sequence[Named]) -> Sequence[Named]:
    """Those about collisions first, by their names; the others as they are."""
    return sorted(rules, key=lambda rule: COLLISION.search(rule.name) is None)


def _of_rule(result: RunResult, rule: RuleAnswer, sources: Sequence[UncertaintySource]) -> Answer:
    """Of a single rule the sampling, the refits and the memory of misses are known."""
    caveats, estimate, refits = interval_caveats(rule.estimate), rule.estimate, rule.refits
    own: list[UncertaintySource] = []
    for source in sources:
        if source.kind == "sampling":
            ends = {"low": estimate.ci_low, "high": estimate.ci_high}
            own.append(replace(source, **ends, note=caveats[0] if caveats else ""))
        elif source.kind == "lost" and result.lost is not None:
            low, high = result.lost.ends(estimate.probability)
            own.append(replace(source, low=low, high=high))
        elif source.kind == "refits" and refits is not None:
            own.append(replace(source, low=refits.low or 0.0, high=refits.high))
        elif source.kind == "memory":
            low, high = ends_of(one.point for one in rule.measured)
            own.append(replace(source, low=low, high=high))
    return Answer(
        rule=rule,
        estimate=estimate,
        caveats=caveats,
        measured=rule.measured,
        open=_open(own, caveats),
        impossible=estimate.failures == 0 and _is_impossible(rule.formula, result.config),
    )


def _is_impossible(formula: str, config: ExperimentConfig) -> bool:
    """Whether a rule is about braking for nothing, and perception reports no such thing."""
    names = set(re.findall(r"[A-Za-z_]\w*", formula)) - {"always", "G", "and"}
    alone = config.is_encounter and names == {ONLY_FOR_NOTHING}
    errs = config.encounter.ghost_probability > 0.0 or config.position_errors is not None
    return alone and not errs


def _open(sources: Sequence[UncertaintySource], caveats: Sequence[str]) -> OpenRange:
    known = [source for source in sources if source.high is not None]
    lows = [source.low for source in sources if source.low is not None and source.kind != "data"]
    low, sampling = min(lows, default=None), sources[0]
    unknown = next((one for one in sources if one.kind == "memory" and one.high is None), None)
    highest = max(known, key=lambda one: one.high or 0.0, default=sampling)
    decided_by = sampling if caveats else unknown or highest
    return OpenRange(low, None if unknown is not None else highest.high, decided_by)
