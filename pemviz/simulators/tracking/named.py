"""Trackers as options and files have them: ``2/3,coast=0.5,filter=kalman``."""

from collections.abc import Mapping

from pemviz.config.tracker_text import read_tracker
from pemviz.simulators.tracking.filters import AlphaBeta, Kalman, LastPosition
from pemviz.simulators.tracking.tracker import Tracker


def tracker_of_text(text: str, *, dt_s: float, axes: int) -> Tracker | None:
    """The tracker that a text spells out; ``None`` for ``none``.

    Args:
        text: As ``pemviz.config.tracker_text`` reads it.
        dt_s: Time between two outcomes [s].
        axes: Along how many axes positions are measured.

    Raises:
        ConfigError: One line: what is wrong, and what is allowed.
    """
    settings = read_tracker(text)
    if settings is None:
        return None
    gains = {name: getattr(settings, name) for name in ("alpha", "beta")}
    spreads = {
        "position_sd_m": settings.position_sd,
        "acceleration_sd_mps2": settings.acceleration_sd,
        "first_speed_sd_mps": settings.speed_sd,
    }
    filters = {
        "none": LastPosition,
        "alpha-beta": lambda: AlphaBeta(**_given(gains)),
        "kalman": lambda: Kalman(**_given(spreads)),
    }
    return Tracker(
        dt_s=dt_s,
        hits=settings.hits,
        window=settings.window,
        coast_s=settings.coast,
        axes=axes,
        filter=filters[settings.filter](),
    )


def _given(options: Mapping[str, float | None]) -> dict[str, float]:
    return {name: value for name, value in options.items() if value is not None}
