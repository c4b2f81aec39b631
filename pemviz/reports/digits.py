"""Numbers of words and tables in as many digits everywhere."""


def end_text(value: float) -> str:
    """An end of a range with two digits, also where the second is 0, so that both ends match."""
    return "0" if value == 0.0 else f"{value:#.2g}".rstrip(".")
