"""What predictive checks found of an error model: figures, verdicts, and the words for both.

A model is checked by what decides a violation: how long a track is missed, how often close by, from
where on it is seen. For each quantity stands what was observed beside what the model itself draws
along the same tracks (Gelman, Meng & Stern 1996, Statistica Sinica 6:733), in up to five variants:
the model as it is, with a memory time, with a frailty, with both, and with a visibility that comes
and goes. The quantities of a variant share one false-alarm rate (Holm 1979, Scandinavian Journal of
Statistics 6:65).

A card keeps this as JSON; who reads it back gets these types.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pemviz.config.ranges import AtLeastZero, Count, Share
from pemviz.config.records import read_record
from pemviz.errors import InputError, PemError

Variant = Literal["independent", "memory", "frailty", "both", "visibility"]
VARIANT_WORDS: Mapping[Variant, str] = {
    "independent": "as it is",
    "memory": "with memory",
    "frailty": "with frailty",
    "both": "with both",
    "visibility": "with visibility",
}
ANSWER_WORDS: Mapping[Variant, str] = {
    "independent": "with misses independent",
    "memory": "with a memory time alone",
    "frailty": "with a frailty alone",
    "both": "with its memory time and frailty",
    "visibility": "with its visibility that comes and goes",
}
DISTANCE_BANDS_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0), (50.0, 200.0))
QuantityName = Literal[
    "longest_run_s", "missed_0.5_s", "missed_1_s", "missed_2_s", "close_misses",
    "close_misses_sd", "first_m", "lasting_m",
    "after_hit", "after_hit_0_15", "after_hit_15_30", "after_hit_30_50", "after_hit_50_200",
    "after_miss", "after_miss_0_15", "after_miss_15_30", "after_miss_30_50", "after_miss_50_200",
    "largest_error_m", "largest_of_all_m",
]  # fmt: skip
MISSED_FOR_S: Mapping[QuantityName, float] = {
    "missed_0.5_s": 0.5, "missed_1_s": 1.0, "missed_2_s": 2.0,
}  # fmt: skip
AFTER_HIT: tuple[QuantityName, ...] = (
    "after_hit", "after_hit_0_15", "after_hit_15_30", "after_hit_30_50", "after_hit_50_200",
)  # fmt: skip
AFTER_MISS: tuple[QuantityName, ...] = (
    "after_miss", "after_miss_0_15", "after_miss_15_30", "after_miss_30_50", "after_miss_50_200",
)  # fmt: skip
"""At any distance, where none is known, and by :data:`DISTANCE_BANDS_M`."""
POSITION_QUANTITIES: tuple[QuantityName, ...] = ("largest_error_m", "largest_of_all_m")
CLOSE_M = 40.0
"""Misses nearer than this are counted on approach."""
DRAWS = 999
FEWEST_DRAWS, MOST_DRAWS = 799, 100_000
"""Data sets of each variant. With fewer nothing can be refuted: the least p-value of B draws is
2 / (B + 1), and 20 quantities are judged together at 0.05."""
FAMILY_WISE = 0.05
"""Chance that any quantity of a right model is refuted."""

CHECK_MEANS = (
    "In each variant: the mean of data sets sampled from it along the same tracks, the middle 95 % "
    "of them, and the two-sided p-value of what was observed. 'Refuted' by Holm's procedure: of a "
    f"right model any quantity is refuted in at most {FAMILY_WISE:.0%} of cases. That none is does "
    "not show that a model is right: these tracks do not distinguish it from one that is."
)

Unit = Literal["s", "m", "share", "count"]
SYMBOLS: Mapping[Unit, str] = {"s": " s", "m": " m", "share": " %", "count": ""}


@dataclass(frozen=True)
class Quantity:
    """What is compared.

    Attributes:
        title: As the head of a row.
        subject: In a sentence, as what a model gets wrong.
        less: What the subject is where the model gives less of it than was observed.
        more: What it is where the model gives more.
    """

    title: str
    subject: str
    less: str
    more: str
    unit: Unit


OFTEN, FEW = ("too rare", "too frequent"), ("too few", "too many")
SIZE, LONG = ("too small", "too large"), ("too short", "too long")
CLOSE = f"within {CLOSE_M:g} m on approach"


def _after(names: Sequence[QuantityName], after: str) -> dict[QuantityName, Quantity]:
    """Misses after a hit or a miss, at any distance and by bands."""
    found: dict[QuantityName, Quantity] = {}
    for name, band in zip(names, (None, *DISTANCE_BANDS_M), strict=True):
        where = "" if band is None else f" at {band[0]:g} to {band[1]:g} m"
        title = f"misses after a {after}{where}"
        found[name] = Quantity(title, title, *OFTEN, "share")
    return found


QUANTITIES: Mapping[QuantityName, Quantity] = {
    "longest_run_s": Quantity(
        "longest run of misses of a track, mean", "the longest runs of misses", *LONG, "s"
    ),
    **{
        name: Quantity(
            f"tracks missed for {least_s:g} s or more at a time",
            f"runs of misses of {least_s:g} s or more", *OFTEN, "share",
        )
        for name, least_s in MISSED_FOR_S.items()
    },
    "close_misses": Quantity(
        f"misses of a track {CLOSE}, mean", f"misses {CLOSE}", *FEW, "count"
    ),
    "close_misses_sd": Quantity(
        f"misses of a track {CLOSE}, standard deviation",
        f"differences between tracks in misses {CLOSE}", *SIZE, "count",
    ),
    "first_m": Quantity(
        "distance at which a track is first detected, mean", "the distance of first detection",
        *SIZE, "m",
    ),
    "lasting_m": Quantity(
        "distance from which on it stays detected, mean", "the distance of lasting detection",
        *SIZE, "m",
    ),
    **_after(AFTER_HIT, "hit"),
    **_after(AFTER_MISS, "miss"),
    "largest_error_m": Quantity(
        "largest error of a track along the line of sight, mean",
        "the largest position errors of tracks", *SIZE, "m",
    ),
    "largest_of_all_m": Quantity(
        "largest error of all tracks", "the largest position error of all", *SIZE, "m"
    ),
}  # fmt: skip
FIRST = (*MISSED_FOR_S, "longest_run_s", "close_misses", "close_misses_sd")
"""What a verdict names before all else: it decides a violation most directly."""
MOST_NAMED = 5


@dataclass(frozen=True)
class CheckedQuantity:
    """A quantity as observed, beside the same of data sets drawn from the model.

    In the unit of :data:`QUANTITIES`. ``None``: nothing was there to compute it from.

    Attributes:
        name: Which quantity.
        observed: Of the tracks.
        expected: Mean over the draws.
        low: 2.5 % quantile of the draws.
        high: 97.5 % quantile.
        p_value: Two-sided.
        refuted: Whether Holm's procedure refuses it among all of the variant.
    """

    name: QuantityName
    observed: AtLeastZero | None
    expected: AtLeastZero | None
    low: AtLeastZero | None
    high: AtLeastZero | None
    p_value: Share
    refuted: bool


@dataclass(frozen=True)
class CheckedVariant:
    """A model's variant, with the law that its misses were drawn with.

    Attributes:
        name: Which variant.
        tau_s: Memory time [s]; where parts of the sequences had one each, their median. 0 with a
            visibility that comes and goes.
        frailty: Likewise; of a visibility that comes and goes, the part that lasts.
        quantities: What was compared.
        varying: Of such a visibility, the part that comes and goes; 0: there is none.
        varying_s: Its correlation time [s].
    """

    name: Variant
    tau_s: AtLeastZero
    frailty: AtLeastZero
    quantities: tuple[CheckedQuantity, ...]
    varying: AtLeastZero = 0.0
    varying_s: AtLeastZero = 0.0

    @property
    def refuted(self) -> tuple[CheckedQuantity, ...]:
        """What it does not reproduce, the worst first."""
        return tuple(sorted((one for one in self.quantities if one.refuted), key=_gravity))


@dataclass(frozen=True)
class ModelCheck:
    """Predictive checks of a model.

    Attributes:
        tracks: So many tracks.
        approaching: Of these come nearer.
        sequences: In so many sequences of video.
        observations: Outcomes.
        draws: Data sets drawn from each variant.
        folds: Parts of the sequences, each told by a model of the others; 0: by one that is given.
        same_data: Whether the model's card says that it was fitted to these data.
        variants: Those that were checked, by the same quantities.
    """

    tracks: Count
    approaching: Count
    sequences: Count
    observations: Count
    draws: Count
    folds: Count
    same_data: bool
    variants: tuple[CheckedVariant, ...]


def check_from_mapping(table: Mapping[str, Any], *, where: str) -> ModelCheck | None:
    """The check on a card; ``None`` if the model was not checked.

    Raises:
        PemError: The table is not as pemviz writes it; begins with ``where``.
    """
    if not table:
        return None
    try:
        return read_record(ModelCheck, dict(table), name="check")
    except InputError as error:
        raise PemError(f"{where}: metadata field {error}") from error


def check_table(check: ModelCheck) -> dict[str, Any]:
    """A check as JSON values for the card."""
    return asdict(check)


def _gravity(one: CheckedQuantity) -> tuple[int, float]:
    """What decides a violation first, by its factor; distances last."""
    if QUANTITIES[one.name].unit == "m":
        return 2, one.p_value
    ratio = _ratio(one)
    return int(one.name not in FIRST), -math.inf if not ratio else -abs(math.log(ratio))


def _ratio(one: CheckedQuantity) -> float | None:
    """Observed over expected; ``None`` if infinite or unknown."""
    return one.observed / one.expected if one.observed is not None and one.expected else None


def value_words(value: float | None, unit: Unit) -> str:
    """A quantity with its unit."""
    return "none" if value is None else f"{_digits(value, unit)}{SYMBOLS[unit]}"


def _digits(value: float, unit: Unit) -> str:
    if unit == "share":
        value *= 100.0
        return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}" if value >= 1.0 else f"{value:.2g}"


def wrong_words(one: CheckedQuantity) -> str:
    """What a model gets wrong: the subject, the direction and by how much."""
    quantity = QUANTITIES[one.name]
    if one.observed is None or one.expected is None:
        return quantity.subject
    too = quantity.less if one.observed > one.expected else quantity.more
    if quantity.unit == "m":
        apart = value_words(abs(one.observed - one.expected), "m")
        return f"{quantity.subject} {too} by {apart}"
    ratio = _ratio(one)
    if ratio is None:
        return f"{quantity.subject} {too}: it never has any"
    if ratio == 0.0:
        return f"{quantity.subject} {too}: there were none"
    factor = max(ratio, 1.0 / ratio)
    digits = f"{factor:.2g}" if factor < 100.0 else f"{factor:.0f}"
    return f"{quantity.subject} {too} by a factor {digits}"


def data_words(check: ModelCheck) -> str:
    """On how many tracks it was checked, and what these are to it."""
    seen = "which are not the table that it was fitted to"
    if check.same_data:
        seen = "which are the data that it was fitted to, so that they flatter it"
    elif check.folds:
        seen = f"each judged by a model of the other sequences ({check.folds} parts)"
    return f"{check.tracks:,} tracks of {check.sequences} sequences, {seen}"


def _in_an_answer(variant: CheckedVariant) -> str:
    """A variant's verdict in a sentence."""
    name, wrong = ANSWER_WORDS[variant.name], variant.refuted
    count = len(variant.quantities)
    if not wrong:
        return f"{name} none of {count} quantities is refuted"
    first, *others = wrong
    more = f", and {len(others)} more of {count} quantities wrong" if others else ""
    return f"{name} it gets {wrong_words(first)}{more}"


def check_line(check: ModelCheck) -> str:
    """What an answer says of the variant that it rests on, in a line."""
    checked = f"this error model was checked on {check.tracks:,} tracks"
    if check.same_data:
        checked += " that it was fitted to"
    if not check.variants:
        return f"{checked}, but not with a memory of misses as this answer assumes"
    return f"{checked}; {'; '.join(map(_in_an_answer, check.variants))}"


def check_rows(check: ModelCheck) -> tuple[Sequence[str], list[tuple[str, ...]]]:
    """Head and rows of a table: a quantity, as observed, and in each variant.

    Of a variant: the mean, the middle 95 % of its draws, the p-value, and whether that refutes it.
    """
    head = ("quantity", "observed", *(VARIANT_WORDS[one.name] for one in check.variants))
    return head, [(*title_words(each[0]), *map(_cell, each)) for each in by_quantity(check)]


def by_quantity(check: ModelCheck) -> list[tuple[CheckedQuantity, ...]]:
    """Each quantity in all variants."""
    return list(zip(*(one.quantities for one in check.variants), strict=False))


def title_words(one: CheckedQuantity) -> tuple[str, str]:
    """The head of a quantity's row, and what was observed."""
    quantity = QUANTITIES[one.name]
    return quantity.title, value_words(one.observed, quantity.unit)


def expected_words(one: CheckedQuantity) -> str:
    """What a variant gives in the mean."""
    return value_words(one.expected, QUANTITIES[one.name].unit)


def _cell(one: CheckedQuantity) -> str:
    unit, mean = QUANTITIES[one.name].unit, expected_words(one)
    if one.low is None or one.high is None:
        return mean
    ends = f"{_digits(one.low, unit)} to {_digits(one.high, unit)}"
    return f"{mean} ({ends}), {p_words(one.p_value)}{': refuted' if one.refuted else ''}"


def p_words(p_value: float) -> str:
    """A p-value with the digits that count."""
    return f"p {p_value:.2f}" if p_value >= 0.095 else f"p {p_value:.2g}"


def verdict_lines(check: ModelCheck) -> list[str]:
    """What is to be said of a check, a line each: on what, and each variant's verdict."""
    drawn = f"{check.draws} data sets sampled from each variant"
    return [f"Checked on {data_words(check)}; {drawn}.", *map(_verdict, check.variants)]


def _verdict(variant: CheckedVariant) -> str:
    name = VARIANT_WORDS[variant.name]
    if variant.name == "visibility":
        law = f"time-varying frailty {variant.varying:.2f} over {variant.varying_s:.2f} s"
        name += f" that comes and goes ({law}, lasting frailty {variant.frailty:.2f})"
    elif variant.name != "independent":
        name += f" (memory time {variant.tau_s:.2f} s, frailty {variant.frailty:.2f})"
    count, wrong = len(variant.quantities), variant.refuted
    said = f"{name[0].upper()}{name[1:]} the model reproduces"
    if not wrong:
        return f"{said} all {count} quantities: none is refuted."
    named = "; ".join(map(wrong_words, wrong[:MOST_NAMED]))
    more = f"; and {len(wrong) - MOST_NAMED} more, see the table" if len(wrong) > MOST_NAMED else ""
    return f"{said} {count - len(wrong)} of {count} quantities. Refuted: {named}{more}."
