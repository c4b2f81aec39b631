"""The uncertainty budget: one row a source, what leaves the answer open and what narrows it."""

from pemviz.reports.numbers import UNKNOWN, digits_of, end_text
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import UncertaintySource, uncertainty_budget

UNCERTAINTY_TITLE = "How far the answer is open"
UNCERTAINTY_COLUMNS = ("by", "from", "to", "narrowed by")
NOT_ADDED_UP = (
    "Each bar is one source of doubt; they are not added up, as each takes for granted what the "
    "others doubt."
)


def uncertainty_rows(result: RunResult) -> list[tuple[str, str, str, str]]:
    """Name, both ends and what would narrow it, of each source."""
    return [
        (source_name(source), *ends_text(source), source.narrowed_by)
        for source in uncertainty_budget(result)
    ]


def ends_text(source: UncertaintySource) -> tuple[str, str]:
    """Both ends with as many digits as tell them apart, in words where one is not known."""
    digits = digits_of(source.low, source.high)
    return _end(source.low, digits), _end(source.high, digits)


def _end(value: float | None, digits: int) -> str:
    return UNKNOWN if value is None else end_text(value, digits=digits)


def source_name(source: UncertaintySource) -> str:
    """Its name, and what is to be said of its ends; an interval's caveats stand elsewhere."""
    return (
        f"{source.name}; {source.note}"
        if source.note and source.kind != "sampling"
        else source.name
    )
