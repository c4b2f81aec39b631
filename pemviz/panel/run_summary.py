"""A run in one line: what was asked of which detector, the answer, and what decides it.

The table of runs has a row of it for each, and the page of a run a strip.
"""

from collections.abc import Mapping
from typing import Any

from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.reports import estimate_words as estimates
from pemviz.reports.document import Caution, Headline, Paragraph, headline_text
from pemviz.reports.gate import decide_run
from pemviz.reports.headline_words import ACT_ON, SHORT, headline_blocks, range_words
from pemviz.reports.run_document import run_document
from pemviz.runs.answers import answers
from pemviz.runs.result import RunResult


def summary(result: RunResult, *, running: bool = False) -> Mapping[str, Any]:
    """A run's line by column, as words, with the numbers that it is sorted by."""
    config = result.config
    logical_scenario = config.encounter.logical_scenario
    scenario = logical_scenario if logical_scenario != NO_LOGICAL_SCENARIO else config.simulator
    if config.is_braking_scenario and logical_scenario == NO_LOGICAL_SCENARIO:
        scenario = f"braking lead, {config.scenario.initial_speed_kmh:g} km/h"
    return {
        "scenario": scenario,
        "detector": _detector(result),
        "method": config.method,
        "metric": config.metric,
        "seed": config.seed,
        "status": "running" if running else result.status,
        "message": result.message or "",
        "rollouts": sum(stage.rollouts for stage in result.stages),
        "took_s": result.timings_s.get("total"),
        **_answer(result, running=running),
    }


def _detector(result: RunResult) -> str:
    name = result.pem.name
    return name if result.is_of_detector_itself else f"{name}, {_memory(result)}"


def _memory(result: RunResult) -> str:
    memory = result.memory
    if memory is None or memory.is_independent:
        return "misses independent"
    words = [f"memory {memory.tau_s:.2g} s"] if memory.tau_s else []
    words += [f"frailty {memory.frailty:.2g}"] if memory.frailty else []
    return ", ".join([*words, *memory.hidden])


def _target_words(result: RunResult) -> str:
    """Whether the upper bound is below the target, if there is one."""
    target = result.config.target
    if target is None:
        return ""
    return f"target {target:g}: {decide_run(result, limit=target).sentence}"


def _answer(result: RunResult, *, running: bool) -> Mapping[str, Any]:
    document = run_document(result, running=running)
    doubts = [one.text for one in document.blocks("warnings") if isinstance(one, Caution)]
    if result.estimate is None:
        return {
            "rule": None, "probability": None, "low": None, "high": None, "act_on": "",
            "decided_by": "", "target": "",
            "sampling": "no estimate yet" if running else "no estimate",
            "sampling_holds": False, "warnings": doubts, "headline": "", "beside": (),
        }  # fmt: skip
    first = answers(result)[0]
    act_on, _ = range_words(first.open, result)
    headline, *beside = headline_blocks(result, running=running)
    return {
        "rule": None if first.rule is None else first.rule.name,
        "probability": first.estimate.probability,
        "failures": first.estimate.failures,
        "low": first.open.low,
        "high": first.open.high,
        "act_on": act_on.removeprefix(ACT_ON),
        "decided_by": SHORT[first.open.decided_by.kind],
        "sampling": f"{estimates.interval_text(first.estimate, caveats=first.caveats)}",
        "sampling_holds": not first.caveats,
        "warnings": doubts,
        "target": "" if running else _target_words(result),
        "headline": headline_text(headline) if isinstance(headline, Headline) else "",
        "beside": [block.text for block in beside if isinstance(block, Paragraph)],
    }
