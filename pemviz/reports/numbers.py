"""Numbers of words and tables in as many digits everywhere."""

FEWEST, MOST = 2, 4


def end_text(value: float, *, digits: int = FEWEST) -> str:
    """An end of a range with so many digits, also where the last is 0, so that both ends match."""
    return "0" if value == 0.0 else f"{value:#.{digits}g}".rstrip(".")


def digits_of(low: float | None, high: float | None) -> int:
    """How many digits tell both ends of a range apart, four at most."""
    digits = FEWEST
    if low is None or high is None or low == high:
        return digits
    while digits < MOST and end_text(low, digits=digits) == end_text(high, digits=digits):
        digits += 1
    return digits


def number_text(value: float | None, *, unit: str = "", digits: int = 3) -> str:
    """A number with its unit, or a dash."""
    return "-" if value is None else f"{value:.{digits}g} {unit}".strip()


def share_text(value: float | None) -> str:
    """A share in per cent, small ones with a digit that counts, or a dash."""
    if value is None:
        return "-"
    per_cent = 100.0 * value
    return f"{per_cent:.0f} %" if per_cent >= 0.95 or value == 0.0 else f"{per_cent:.1g} %"


def range_text(low: float | None, high: float | None) -> str:
    """Both ends with as many digits as tell them apart; 'unknown' where either is not known."""
    if low is None or high is None:
        return UNKNOWN
    digits = digits_of(low, high)
    return f"{end_text(low, digits=digits)} to {end_text(high, digits=digits)}"


UNKNOWN = "unknown"
