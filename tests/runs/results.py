"""Arbitrary results, drawn from what the types of their fields allow."""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from types import NoneType, UnionType
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

from hypothesis import strategies as st

from pemviz.analysis.explanation import Explanation
from pemviz.config import METHODS, ExperimentConfig, ScenarioConfig
from pemviz.config.encounters import EncounterConfig
from pemviz.config.ranges import NamedPart, Range
from pemviz.config.settings import RULE_NAME, SumoConfig
from pemviz.runs.result import RankedRollout, RunResult

TEXTS = st.text(max_size=8)


def anything(annotation):
    """Values of an annotation; a configuration's texts are those that it allows."""
    if annotation is ExperimentConfig:
        return configurations()
    if annotation is Explanation:
        return explanations()
    if annotation is RankedRollout:
        return plainly(RankedRollout).flatmap(infinite_or_not)
    origin = get_origin(annotation)
    if origin in (Union, UnionType):
        return st.one_of(st.none() if a is NoneType else anything(a) for a in get_args(annotation))
    if origin is Annotated:
        base, limits = get_args(annotation)
        if isinstance(limits, NamedPart):
            return st.sampled_from(limits.names())
        return numbers(base, limits)
    if origin is Literal:
        return st.sampled_from(get_args(annotation))
    if origin is tuple:
        return st.lists(anything(get_args(annotation)[0]), max_size=2).map(tuple)
    if origin is Mapping:
        return st.dictionaries(TEXTS, anything(get_args(annotation)[1]), max_size=2)
    if annotation in (bool, str):
        return st.booleans() if annotation is bool else TEXTS
    return plainly(annotation) if annotation not in (int, float) else numbers(annotation, Range())


def numbers(base, limits):
    ends = {"min_value": limits.low, "max_value": limits.high}
    if base is int:
        return st.integers(**ends)
    open_ends = {"exclude_min": limits.low_open, "exclude_max": limits.high_open}
    return st.floats(**ends, **open_ends, allow_nan=False, allow_infinity=False)


def plainly(kind, **chosen):
    """A record of any values, but for the fields chosen."""
    hints = get_type_hints(kind, include_extras=True)
    if hints.get("method") is str:  # of an estimate; the last is of no package here
        chosen.setdefault("method", st.sampled_from((*METHODS.shipped, "moved ☂")))
    drawn = {f.name: anything(hints[f.name]) for f in fields(kind) if f.name not in chosen}
    return st.builds(kind, **drawn, **chosen)


def configurations():
    named = st.text(min_size=1, max_size=8).filter(str.strip)
    trackers = st.sampled_from(("none", "2/3", "1/1,coast=0.5,filter=kalman"))
    scenarios = plainly(ScenarioConfig, tracker=trackers)
    outcomes = {"varying_frailty": st.none(), "varying_frailty_s": st.none()}
    laws = ({"memory_law": st.just("outcomes"), **outcomes},
            {"memory_law": st.just("visibility"), "memory_s": st.none()})  # fmt: skip
    alone = st.one_of([
        plainly(
            ExperimentConfig, pem=named, simulator=named, rules=st.just(()),
            scenario=scenarios, encounter=st.just(EncounterConfig()), start=st.just(()),
            sumo=st.just(SumoConfig()), carla=st.none(), **law,
        )
        for law in laws
    ])  # fmt: skip
    names = st.from_regex(RULE_NAME, fullmatch=True)
    rules = st.dictionaries(names, TEXTS, max_size=2)
    return st.builds(ExperimentConfig.with_rules, alone, rules)


def explanations():
    """With as many sensitivities as bands, and one for all distances."""

    def fit(explanation, one):
        return replace(explanation, sensitivity=(one,) * (len(explanation.misses_by_distance) + 1))

    (band, _) = get_args(get_type_hints(Explanation, include_extras=True)["sensitivity"])
    return st.builds(fit, plainly(Explanation), plainly(band))


def infinite_or_not(rollout):
    """Also infinitely robust, or infinitely far from it if it violates."""
    infinite = -math.inf if rollout.violated else math.inf
    return st.sampled_from((rollout, replace(rollout, robustness=infinite)))


def results():
    """Any result that a run may end with."""
    return plainly(RunResult)
