"""The first words of an answer: how likely, with memories of misses too, and what decides it.

Two numbers come first where misses are taken as independent of each other: the answer with the
memory that was measured on video, and if they are independent. Then the range that is honest to act
on, and the doubt that decides it.
"""

from collections.abc import Iterator, Mapping, Sequence

from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.reports import estimate_words as estimates
from pemviz.reports.document import Block, Headline, Paragraph, Table
from pemviz.reports.estimate_words import end_text, range_text
from pemviz.runs.answers import Answer, OpenRange, answers
from pemviz.runs.result import MeasuredAnswer, RunMemory, RunResult
from pemviz.runs.uncertainty import SourceKind, ends_of
from pemviz.simulators.detector_loop import DETECTOR_ITSELF

IMPOSSIBLE = "cannot be broken here"
BECAUSE = (
    "what is simulated never brakes for nothing, as perception reports nothing that is not there "
    "and places without error"
)
SHORT: Mapping[SourceKind, str] = {
    "sampling": "the sampling",
    "lost": "rollouts that could not be simulated",
    "reference": "the reference",
    "refits": "refits",
    "model-classes": "other model classes",
    "memory": "memory of misses",
    "data": "the training data",
}
NOT_KNOWN = "not known"
NOT_LOOKED_AT = "not looked at"
UNBOUNDED = f"how high is {NOT_KNOWN}"
ACT_ON, DECIDED_BY = "To act on: ", "decided by "


def headline_blocks(result: RunResult, *, running: bool = False) -> Iterator[Block]:
    """The first answer with its range, and a line for each memory that was measured."""
    first = answers(result)[0]
    words = f"{_subject(first, result)}: {_two_numbers(first, result.memory)}"
    yield Headline(words, _given(result))
    if running:
        return
    range_line = ", ".join(range_words(first.open, result))
    yield Paragraph(range_line, tone="large")
    memory = result.memory
    asked = memory is not None and memory.is_independent and not memory.curve
    unknown = memory.unmeasured if memory is not None and asked else ""
    if unknown not in range_line:
        yield Paragraph(f"with a memory of misses: {NOT_KNOWN}, {unknown}", tone="quiet")
    for line in _measured_lines(first, result.memory):
        yield Paragraph(line, tone="quiet")


def _subject(answer: Answer, result: RunResult) -> str:
    logical_scenario = result.config.encounter.logical_scenario
    is_encounter = logical_scenario != NO_LOGICAL_SCENARIO
    occasion = f"encounter of {logical_scenario}" if is_encounter else "run"
    if answer.rule is None:
        return f"Failure probability in one {occasion}"
    return f"Probability that rule {answer.rule.name} is broken in one {occasion}"


def _measured_lines(answer: Answer, memory: RunMemory | None) -> Iterator[str]:
    """A line for each detector; of the answer's own memory one over its intervals."""
    own = None if memory is None else memory.fitted
    if memory is None or own is None or not memory.is_own:
        yield from (f"with the memory of {measured_text(one)}" for one in answer.measured)
    elif answer.measured:
        over = f"{own.low_s:.2g} to {own.high_s:.2g} s"
        if own.frailty_low is not None and own.frailty_high is not None:
            over += f", frailty {own.frailty_low:.2g} to {own.frailty_high:.2g}"
        ends = range_text(*ends_of(one.point for one in answer.measured))
        yield f"over the intervals of its memory ({over}): {ends}"


def _two_numbers(answer: Answer, memory: RunMemory | None) -> str:
    """The answer with what it takes of how misses hang together; beside it, as measured."""
    own = estimates.short_probability(answer.estimate).removeprefix("0: ")
    found = sorted(one.point.probability for one in answer.measured if one.point.low is not None)
    if memory is None:
        return own
    if not memory.is_independent:
        return f"{own} {_with_memory(memory)}"
    ends = [end_text(value) for value in dict.fromkeys((*found[:1], *found[-1:]))]
    whose = "measured detectors" if memory.fitted is None else "this error model"
    independent = f"{own} if misses are independent"
    if ends:  # first, as it is the one that holds for detectors as they are
        return f"{' to '.join(dict.fromkeys(ends))} with the memory of {whose}, {independent}"
    return f"{independent}, {NOT_KNOWN} with a memory" if memory.unmeasured else independent


def _with_memory(memory: RunMemory) -> str:
    if memory.hidden:
        return f"with {' and '.join(memory.hidden)}"
    parts = [f"{memory.tau_s:.2g} s"] if memory.tau_s else []
    parts += [f"frailty {memory.frailty:.2g}"] if memory.frailty else []
    whose = "the model's own memory of misses" if memory.is_own else "an assumed memory of misses"
    return f"with {whose} ({', '.join(parts)})"


def _given(result: RunResult) -> str:
    """What the probability takes for granted."""
    beside = estimates.beyond_default_text(result)
    if result.is_of_detector_itself:
        return (
            f"with the {DETECTOR_ITSELF} on rendered images{f'; with {beside}' if beside else ''}"
        )
    return f"if error model {result.pem.name} is right{f'; with {beside}' if beside else ''}"


def range_words(found: OpenRange, result: RunResult) -> tuple[str, str]:
    """The range to act on, its upper end first, and what decides it."""
    source = found.decided_by
    if source.kind == "sampling" and source.note:
        return f"{ACT_ON}nothing yet", f"the sampling does not hold: {source.note}"
    least = f", at least {end_text(found.low)}" if found.low else ""
    if found.high is not None:
        return f"{ACT_ON}at most {end_text(found.high)}{least}", f"{DECIDED_BY}{source.name}"
    why = "" if result.memory is None else result.memory.unmeasured
    why = f" ({why})" if why else ""
    ends = f"{least}, {UNBOUNDED}".removeprefix(", ")
    return f"{ACT_ON}{ends}", f"{DECIDED_BY}{source.name}, {NOT_LOOKED_AT}{why}"


def measured_text(one: MeasuredAnswer) -> str:
    """Whose memory, what it is, and the answer with it."""
    point = one.point
    memory = f"{point.tau_s:.2g} s"
    memory += f", frailty {point.frailty:.2g}" if point.frailty else ""
    return f"{one.name} ({memory}): {measured_number(one)}"


def measured_number(one: MeasuredAnswer) -> str:
    """The answer with a memory that was measured, and its interval or why that is none."""
    point = one.point
    if point.low is None or point.high is None:
        return estimates.NONE_SEEN
    words = f"{end_text(point.probability)}, {range_text(point.low, point.high)}"
    return f"{words} (not a 95 % interval: {point.caveats[0]})" if point.caveats else words


def answers_table(result: RunResult) -> Table:
    """A row for each rule, collisions first, and one for any of them, each with its own range."""
    found = answers(result)
    rows = tuple(_row(one, result, against_all=found[-1].caveats) for one in found)
    columns = ("rule", "is broken with probability", "sampling", "to act on", "decided by")
    note = f"{IMPOSSIBLE}: {BECAUSE}" if any(one.impossible for one in found) else ""
    return Table(columns, rows, name="Each rule by itself", note=note)


def _row(answer: Answer, result: RunResult, *, against_all: Sequence[str]) -> tuple[str, ...]:
    name = "any of them" if answer.rule is None else answer.rule.name
    if answer.impossible:
        return name, IMPOSSIBLE, "", "", ""
    act_on, _ = range_words(answer.open, result)
    return (
        name,
        estimates.probability_text(answer.estimate),
        _sampling(answer, against_all),
        act_on.removeprefix(ACT_ON).removesuffix(f", {UNBOUNDED}"),
        SHORT[answer.open.decided_by.kind],
    )


def _sampling(answer: Answer, against_all: Sequence[str]) -> str:
    """A rule's interval; what speaks against that of the whole answer too is not told again."""
    estimate = answer.estimate
    own = [text for text in answer.caveats if answer.rule is None or text not in against_all]
    words = estimates.interval_text(estimate, caveats=own)
    if own or not answer.caveats or estimate.ci_low is None:
        return words
    return f"{words}, {estimates.no_interval_text(estimate)} either"
