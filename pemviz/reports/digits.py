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
