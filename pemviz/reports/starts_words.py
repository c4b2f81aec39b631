"""Which starts are dangerous."""

from collections.abc import Sequence

from pemviz.analysis.starts import FEWEST, FEWEST_OF_MAP, DangerousStarts, StartValue
from pemviz.reports.numbers import end_text

STARTS_TITLE = "Which starts are dangerous"
START_COLUMNS = (
    "start value",
    "all: median",
    "80 % of all",
    "violations: median",
    "its 95 % interval",
    "80 % of violations",
)
START_NOTE = (
    "Starts of violations, each counted by its part of the answer, against all starts that the "
    "scenario draws."
)
DIGITS = 3
NAMED = 2
LOW, MIDDLE, HIGH = range(3)


def starts_line(found: DangerousStarts) -> str:
    """Where violations start and all starts do not, in a sentence."""
    if not all(one.violations for one in found.values):
        return (
            f"Which starts are dangerous cannot be told from {found.effective:.2g} effective "
            f"violations; {FEWEST:g} are needed"
        )
    shifted = found.shifted()[:NAMED]
    if not shifted:
        return f"Violations start as all do, as far as {found.effective:.2g} effective ones tell"
    return f"Violations start with {'; '.join(map(_against, shifted))}"


def start_rows(found: DangerousStarts) -> list[tuple[str, ...]]:
    """What :data:`START_COLUMNS` name, of each start value; dashes where nothing is told."""
    return [_row(one) for one in found.values]


def starts_title(found: DangerousStarts) -> str:
    """Whose violations, and how many they are worth."""
    whose = "" if found.rule is None else f" of rule {found.rule}"
    return (
        f"{found.violations:,} violations{whose}, worth {found.effective:.3g} equally likely ones "
        "with different starts"
    )


def map_words(found: DangerousStarts) -> str:
    """What the picture of the plane shows, and how far it can be trusted."""
    plane = found.plane
    if plane is None:
        return f"The plane of two start values is drawn from {FEWEST_OF_MAP:g} effective ones on."
    units = {one.name: one.unit for one in found.values}
    reach = " and ".join(
        _with_unit(end_text(width), units[name])
        for width, name in ((plane.across_reach, plane.across), (plane.up_reach, plane.up))
    )
    average = end_text(10.0**found.log10_probability)
    return (
        f"P(violation) for encounters that start there, {average} on average over all starts. "
        f"Averaged over starts within {reach} of it, the nearest most, and told only where "
        f"{FEWEST:g} effective violations lie there, so that its standard error is below a third; "
        "grey: not known, and rarer as a rule. The box holds 80 % of all starts each way."
    )


def _against(one: StartValue) -> str:
    """One value of violations against that of all starts."""
    low, middle, high = (end_text(q.value, digits=DIGITS) for q in one.violations)
    every_low, every, every_high = (end_text(v, digits=DIGITS) for v in one.all_starts)
    return (
        f"{_spoken(one.name)} {_with_unit(middle, one.unit)} (80 % from {low} to {high}), all with "
        f"{_with_unit(every, one.unit)} ({every_low} to {every_high})"
    )


def _row(one: StartValue) -> tuple[str, ...]:
    name = f"{_spoken(one.name)} [{one.unit}]" if one.unit else _spoken(one.name)
    every = [end_text(value, digits=DIGITS) for value in one.all_starts]
    own: Sequence[str] = ("-", "-", "-")
    if one.violations:
        low, middle, high = one.violations
        own = (
            end_text(middle.value, digits=DIGITS),
            _range(middle.low, middle.high),
            _range(low.value, high.value),
        )
    return (name, every[MIDDLE], f"{every[LOW]} to {every[HIGH]}", *own)


def _spoken(name: str) -> str:
    return name.replace("_", " ")


def _range(low: float, high: float) -> str:
    return f"{end_text(low, digits=DIGITS)} to {end_text(high, digits=DIGITS)}"


def _with_unit(number: str, unit: str) -> str:
    return f"{number} {unit}".strip()
