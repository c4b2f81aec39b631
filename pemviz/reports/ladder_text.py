"""The ladder of uncertainty in words: one row a rung, the same on the terminal and in reports."""

from pemviz.reports.digits import digits_of, end_text
from pemviz.runs.ladder import Rung, uncertainty_ladder
from pemviz.runs.result import RunResult

LADDER_TITLE = "How far the answer is open"
UNKNOWN = "unknown"
LADDER_COLUMNS = ("by", "from", "to", "narrowed by")


def ladder_rows(result: RunResult) -> list[tuple[str, str, str, str]]:
    """Name, both ends and what would narrow it, of each rung."""
    return [
        (rung_name(rung), *ends_text(rung), rung.narrowed_by) for rung in uncertainty_ladder(result)
    ]


def ends_text(rung: Rung) -> tuple[str, str]:
    """Both ends with as many digits as tell them apart, in words where one is not known."""
    digits = digits_of(rung.low, rung.high)
    return _end(rung.low, digits), _end(rung.high, digits)


def _end(value: float | None, digits: int) -> str:
    return UNKNOWN if value is None else end_text(value, digits=digits)


def rung_name(rung: Rung) -> str:
    """Its name, and what is to be said of its ends; an interval's caveats stand elsewhere."""
    return f"{rung.name}; {rung.note}" if rung.note and rung.kind != "sampling" else rung.name
