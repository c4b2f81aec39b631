"""A configuration of scenario_simulator_v2 as models of pemviz: of misses, of position errors."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.special import logit

from pemviz.arrays import FloatArray
from pemviz.pem.exchange.autoware import SMALLEST_P, Configuration
from pemviz.pem.exchange.averages import FARTHEST_M
from pemviz.pem.models.binned_position_errors import BinnedPositionErrors
from pemviz.pem.models.cards import UNKNOWN_LICENCE, PemCard, PositionErrorCard
from pemviz.pem.models.position_errors import (
    MEAN_FEATURES,
    SCALE_FEATURES,
    ErrorAxis,
    NoiseMemory,
)
from pemviz.pem.models.tabulated import TabulatedPem

NEVER = SMALLEST_P
"""P(reported) beyond a file's last bin, where the simulator reports nothing."""


def miss_model(
    configuration: Configuration, notes: Mapping[str, str], *, name: str, sensor_ahead_m: float
) -> TabulatedPem:
    """P(detected) by distance, with the memory time; ``notes`` are the file's, for the card."""
    card = PemCard(
        name=notes.get("model", name),
        model="table",
        data=notes.get("data", f"not stated (noise parameters {name})"),
        licence=notes.get("licence", UNKNOWN_LICENCE),
        recipe=notes.get("averages", "read from noise parameters of scenario_simulator_v2"),
    )
    return TabulatedPem(
        card,
        _from_m(configuration),
        logit(_beyond(configuration, configuration.rate, NEVER)),
        between="step",
        measure="nearest-point",
        sensor_ahead_m=sensor_ahead_m,
        tau_s=configuration.tau_s,
    )


def position_model(
    configuration: Configuration, notes: Mapping[str, str], *, name: str, sensor_ahead_m: float
) -> BinnedPositionErrors | None:
    """Errors along and across the line of sight by distance; ``None`` where there are none."""
    along, across = configuration.along, configuration.across
    pairs = [(along.mean, across.mean), (along.deviation, across.deviation)]
    if not np.any(pairs):
        return None
    mean, deviation = (
        np.stack([_beyond(configuration, values, 0.0) for values in pair], axis=1) for pair in pairs
    )
    names: tuple[Literal["range"], Literal["cross_range"]] = ("range", "cross_range")
    axes = tuple(
        ErrorAxis(
            kind,
            np.zeros(len(MEAN_FEATURES)),
            np.zeros(len(SCALE_FEATURES)),
            memory=NoiseMemory(tau_s=axis.tau_s),
        )
        for kind, axis in zip(names, (along, across), strict=True)
    )
    card = PositionErrorCard(
        name=notes.get("model", name),
        data=notes.get("position errors", f"not stated (noise parameters {name})"),
        licence=notes.get("licence", UNKNOWN_LICENCE),
        recipe=notes.get("averages", "read from noise parameters of scenario_simulator_v2"),
    )
    return BinnedPositionErrors(
        axes,
        np.eye(2),
        card=card,
        from_m=_from_m(configuration),
        bin_mean=mean,
        bin_deviation=deviation,
        sensor_ahead_m=sensor_ahead_m,
    )


def _from_m(configuration: Configuration) -> FloatArray:
    radii_m = configuration.radii_m
    ends = radii_m[:-1] if radii_m[-1] >= FARTHEST_M else radii_m
    return np.append(0.0, ends)


def _beyond(configuration: Configuration, values: FloatArray, beyond: float) -> FloatArray:
    """Values by bin ``[B]``, and what holds beyond the last where it ends within reach."""
    is_open = configuration.radii_m[-1] >= FARTHEST_M
    return values if is_open else np.append(values, beyond)
