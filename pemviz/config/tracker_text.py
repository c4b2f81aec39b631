"""A tracker as it is written in options and files: ``none``, or ``2/3,coast=0.5,filter=kalman``.

Many at once, for a sweep, are ``hits=1:3,window=3:5,coast=0:1:0.5``.
"""

import itertools
import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args, get_type_hints

from pemviz.config.ranges import Range, check_value, optional_value, shown
from pemviz.errors import ConfigError

NO_TRACKER = "none"
ALPHA = 0.7
"""Of an alpha-beta filter, unless it is given."""
Hits = Annotated[int, Range(low=1, high=30)]
Spread = Annotated[float, Range(low=0.0, high=1e6)]
FilterName = Literal["none", "alpha-beta", "kalman"]


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """A tracker between perception and controller; what is ``None`` is the filter's own.

    Attributes:
        hits: Needed for a confirmation.
        window: Outcomes that they are counted over.
        coast: How long a confirmed track stays without a hit [s].
        filter: Of its position and speed.
        alpha: Of an alpha-beta filter.
        beta: Likewise.
        position_sd: Of a measured position's error, of a Kalman filter [m].
        acceleration_sd: Of accelerations, likewise [m/s^2].
        speed_sd: Of the speed before the first hit, likewise [m/s].
    """

    hits: Hits
    window: Hits
    coast: Annotated[float, Range(low=0.0, high=1e6)] = 0.0
    filter: FilterName = "none"
    alpha: Annotated[float, Range(low=0.0, low_open=True, high=1.0)] | None = None
    beta: Annotated[float, Range(low=0.0, low_open=True, high=4.0)] | None = None
    position_sd: Annotated[float, Range(low=0.0, low_open=True, high=1e6)] | None = None
    acceleration_sd: Spread | None = None
    speed_sd: Spread | None = None


OPTIONS = tuple(f.name for f in fields(TrackerSettings) if f.name not in ("hits", "window"))
OF_FILTER = {
    "none": (),
    "alpha-beta": ("alpha", "beta"),
    "kalman": ("position_sd", "acceleration_sd", "speed_sd"),
}


def read_tracker(text: str) -> TrackerSettings | None:
    """What ``M/N`` and options behind it, ``NAME=VALUE``, say; ``None`` for ``none``.

    Raises:
        ConfigError: One line: what is wrong, and what is allowed.
    """
    words = [word.strip() for word in text.split(",")]
    if words == [NO_TRACKER]:
        return None
    where = f"tracker = {shown(text)}"
    hits, slash, window = words[0].partition("/")
    if not (slash and hits.isascii() and hits.isdecimal() and window.isascii()):
        raise ConfigError(f"{where}: must be none, or M/N for M hits of N outcomes, then options")
    given: dict[str, str] = {}
    for word in words[1:]:
        name, equals, value = (part.strip() for part in word.partition("="))
        name = name.replace("-", "_")
        if not equals or name not in OPTIONS or name in given:
            allowed = ", ".join(option.replace("_", "-") for option in OPTIONS)
            raise ConfigError(f"{where}: {shown(word)} must be NAME=VALUE, each once, of {allowed}")
        given[name] = value
    values = {"hits": hits, "window": window, **given}
    settings = TrackerSettings(**{name: _value(name, word) for name, word in values.items()})
    if settings.hits > settings.window:
        message = f"{where}: {settings.hits} hits of {settings.window} outcomes: must be no more"
        raise ConfigError(message)
    check_stable(ALPHA if settings.alpha is None else settings.alpha, settings.beta)
    of_others = {name for names in OF_FILTER.values() for name in names}
    for name in given:
        if name in of_others - {*OF_FILTER[settings.filter]}:
            option = name.replace("_", "-")
            raise ConfigError(f"{where}: {option} is no option of filter {settings.filter}")
    return settings


GRID_BEGINS = "hits="
MOST_OF_A_RANGE = 1000
ROUNDING = 1e-9
"""Of a range's steps: an end that is missed by so little of one is still in it."""


def tracker_grid(text: str) -> tuple[str, ...]:
    """Every tracker of ``hits=1:3,window=3:5,coast=0:1:0.5``, as :func:`read_tracker` takes them.

    ``LOW:HIGH`` are values 1 apart, ``LOW:HIGH:STEP`` others; what stands without a colon is as it
    is. Settings of more hits than outcomes are left out. One hit confirms whatever the window is,
    so that of trackers of one hit the first window's alone is there.

    Raises:
        ConfigError: One line: what is wrong, and what is allowed.

    Example:
        >>> from pemviz.config.tracker_text import tracker_grid
        >>> tracker_grid("hits=2:3,window=3,coast=0:0.5:0.5")
        ('2/3,coast=0', '2/3,coast=0.5', '3/3,coast=0', '3/3,coast=0.5')
    """
    where = f"tracker = {shown(text)}"
    ranges: dict[str, tuple[str, ...]] = {}
    for word in text.split(","):
        name, equals, listed = (part.strip() for part in word.partition("="))
        if not equals or name in ranges:
            raise ConfigError(f"{where}: {shown(word)} must be NAME=VALUE or NAME=LOW:HIGH, once")
        ranges[name] = _range_values(listed, where=where)
    if "window" not in ranges:
        raise ConfigError(f"{where}: window is missing: must say hits=..., window=...")
    found: dict[str, None] = {}
    for values in itertools.product(*ranges.values()):
        given = dict(zip(ranges, values, strict=True))
        hits, window = given.pop("hits"), given.pop("window")
        if hits == "1":
            window = ranges["window"][0]
        one = ",".join((f"{hits}/{window}", *(f"{n}={v}" for n, v in given.items())))
        if not (hits.isdecimal() and window.isdecimal() and int(hits) > int(window)):
            read_tracker(one)
            found[one] = None
    if not found:
        raise ConfigError(f"{where}: all have more hits than outcomes in their window")
    return tuple(found)


def _range_values(listed: str, *, where: str) -> tuple[str, ...]:
    """The values of ``LOW:HIGH:STEP``, both ends included; others as they are."""
    if ":" not in listed:
        return (listed,)
    try:
        low, high, step = (*map(float, listed.split(":")), 1.0)[:3]
    except ValueError:
        low, high, step = 0.0, -1.0, 1.0
    count = math.floor((high - low) / step + ROUNDING) + 1 if step > 0.0 <= high - low else 0
    if not 0 < count <= MOST_OF_A_RANGE or listed.count(":") > 2:
        raise ConfigError(
            f"{where}: {shown(listed)} must be LOW:HIGH or LOW:HIGH:STEP, rising, of at most "
            f"{MOST_OF_A_RANGE} values"
        )
    return tuple(f"{low + place * step:.9g}" for place in range(count))


def _value(name: str, word: str) -> Any:
    """The option's value, of the type that its field has."""
    annotation = optional_value(get_type_hints(TrackerSettings, include_extras=True)[name])
    kind = get_args(annotation)[0] if name != "filter" else str
    try:
        value = kind(word)
    except ValueError:
        value = word
    return check_value(
        name=f"tracker: {name.replace('_', '-')}", value=value, annotation=annotation
    )


def check_stable(alpha: float, beta: float | None) -> None:
    """Refuse gains of an alpha-beta filter under which errors grow (Kalata 1984).

    Raises:
        ConfigError: ``beta`` is not below 4 - 2 alpha.
    """
    if beta is not None and beta >= 4.0 - 2.0 * alpha:
        message = f"tracker: beta = {beta:g}: must be below {4.0 - 2.0 * alpha:g}, 4 - 2 alpha"
        raise ConfigError(message)
