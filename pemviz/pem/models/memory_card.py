"""A model's memory of misses in its card: as JSON, read back with suspicion, and as markdown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from pemviz.errors import PemError
from pemviz.pem.models.memory import FRAILTY_MEANS, TAU_MEANS, Memory

FLATTERY_IF = (
    "If the detector was trained on these drives or on ones like them, its misses close by are "
    "fewer than on new roads. How misses follow each other close by rests on the misses counted "
    "under 'plain view'."
)
CAUTION = (
    "What P(missed | state) leaves out and what lasts from frame to frame passes for memory: "
    "another model of it gives another memory time, a shorter or a longer one."
)


CLEARLY = 0.05
"""Difference of correlations that a card speaks of."""


@dataclass(frozen=True)
class FittedMemory:
    """What a model's card says of its memory.

    Attributes:
        memory: As fitted.
        tau_interval_s: Of the memory time [s].
        frailty_interval: Of the frailty; ``None`` where it was not fitted.
        confidence: Of each interval.
        sequences: Independent sequences it rests on.
        observations: Outcomes it rests on.
        rate_hz: Frames a second of the video.
    """

    memory: Memory
    tau_interval_s: tuple[float, float]
    frailty_interval: tuple[float, float] | None
    confidence: float
    sequences: int
    observations: int
    rate_hz: float


def memory_of(pem: object) -> Memory | None:
    """The memory that a model carries; ``None`` if it has none.

    A model of one's own carries one as its attribute ``memory``.

    Args:
        pem: Any error model.

    Raises:
        PemError: Its attribute ``memory`` is neither ``None`` nor a :class:`Memory`.
    """
    memory: object = getattr(pem, "memory", None)
    if memory is None or isinstance(memory, Memory):
        return memory
    name = getattr(pem, "name", type(pem).__name__)
    raise PemError(f"{name}: its memory is a {type(memory).__name__}, must be a Memory")


def fitted_memory(card_memory: Mapping[str, Any], *, where: str) -> FittedMemory | None:
    """The fitted memory of a card; ``None`` if the model has none.

    Args:
        card_memory: The card's table.
        where: The file, for the message.

    Raises:
        PemError: The table is not as ``pemviz.pem.judging.memory_report`` writes it.
    """
    if not card_memory:
        return None
    try:
        fit = cast(Mapping[str, Any], card_memory["fit"])
        memory = cast(Mapping[str, Any], fit["memory"])
        frailty = fit["frailty_interval"]
        return FittedMemory(
            memory=Memory(tau_s=_number(memory["tau_s"]), frailty=_number(memory["frailty"])),
            tau_interval_s=_pair(fit["tau_interval_s"]),
            frailty_interval=None if frailty is None else _pair(frailty),
            confidence=_number(fit["confidence"]),
            sequences=int(_number(fit["sequences"])),
            observations=int(_number(fit["observations"])),
            rate_hz=_number(card_memory["rate_hz"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise PemError(f"{where}: metadata field 'memory' is not as pemviz writes it") from error


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        message = f"{value!r} is no number"
        raise ValueError(message)
    return float(value)


def _pair(value: Any) -> tuple[float, float]:
    low, high = value
    return _number(low), _number(high)


def memory_markdown(memory: Mapping[str, Any]) -> str:
    """The card's section on memory; empty for a model without one.

    Raises:
        PemError: The table is not as ``pemviz.pem.judging.memory_report`` writes it.
    """
    if not memory:
        return ""
    tables = (_lag_table, _run_table, _group_table, _plain_view_table)
    try:
        parts = [_facts(memory), *(table(memory) for table in tables)]
    except (KeyError, TypeError, ValueError) as error:
        raise PemError("metadata field 'memory' is not as pemviz writes it") from error
    return "\n\n".join(["## Memory of misses", *("\n".join(part) for part in parts if part)]) + "\n"


def _facts(memory: Mapping[str, Any]) -> list[str]:
    fit: Mapping[str, Any] = memory["fit"]
    low, high = fit["tau_interval_s"]
    frailty = "not fitted"
    if fit["frailty_interval"] is not None:
        least, most = fit["frailty_interval"]
        frailty = f"{fit['memory']['frailty']:.2f} ({least:.2f} to {most:.2f})"
    return [
        f"- Memory time tau {fit['memory']['tau_s']:.3f} s ({low:.3f} to {high:.3f}), frailty f "
        f"{frailty}; {fit['confidence']:.0%} intervals, {fit['sequences']} "
        f"sequences taken as independent, {fit['observations']} observations at "
        f"{memory['rate_hz']:g} Hz, P(missed | state) cross-fitted by sequence.",
        f"- Memory time tau: {TAU_MEANS}. Frailty f: {FRAILTY_MEANS} (0: not at all). A burst: "
        "misses in one frame after the other.",
        f"- Negative log-likelihood of an outcome: {fit['nats_independent']:.3f} nats if misses "
        f"are independent, {fit['nats']:.3f} with this memory.",
        "- The model's own answer is P(missed | state) without this memory.",
        f"- {memory['gaps']} gaps in tracks, {memory['rate_changes']} changes of rate.",
        *_misfit(memory),
        f"- {CAUTION}",
        f"- {memory['flattery']}",
    ]


def _misfit(memory: Mapping[str, Any]) -> list[str]:
    """A line on the lags at which the fitted model has less correlation than the data."""
    lags = [
        f"{row['lag_s']:g} s"
        for row in memory["correlations"]
        if None not in (row["measured"], row["fitted"])
        and row["measured"] > row["fitted"] + CLEARLY
    ]
    if not lags:
        return []
    return [
        f"- At {', '.join(lags)} residuals hang together more than in the fitted model (below): "
        "one memory time and one frailty do not tell all, and bursts may last longer than they say."
    ]


def _lag_table(memory: Mapping[str, Any]) -> list[str]:
    rows = [
        (f"{row['lag_s']:g} s", str(row["pairs"]), _shown(row["measured"]), _shown(row["fitted"]))
        for row in memory["correlations"]
    ]
    return _table(("lag", "pairs", "correlation of residuals", "in the fitted model"), rows)


def _group_table(memory: Mapping[str, Any]) -> list[str]:
    rows = [
        (
            row["name"],
            str(row["observations"]),
            str(row["misses"]),
            _shown(row["missed_after_miss"]),
            _shown(row["missed_after_hit"]),
            _tau(row),
        )
        for row in memory["groups"]
    ]
    return _table(("observations", "n", "missed", "after a miss", "after a hit", "tau alone"), rows)


def _plain_view_table(memory: Mapping[str, Any]) -> list[str]:
    rows = [
        (row["name"], *(str(row[key]) for key in ("observations", "misses", "misses_after_miss")))
        for row in memory["plain_view"]
    ]
    if not rows:
        return []
    header = ("plain view: not occluded, not truncated", "n", "missed", "of them after a miss")
    return _table(header, rows)


def _run_table(memory: Mapping[str, Any]) -> list[str]:
    lengths = memory["run_lengths"]
    names = [str(length) for length in range(1, len(lengths))] + [f"{len(lengths)} or more"]
    rows = [
        (name, str(count), f"{fitted:.1f}", f"{independent:.1f}")
        for name, count, fitted, independent in zip(
            names,
            lengths,
            memory["expected_run_lengths"],
            memory["independent_run_lengths"],
            strict=True,
        )
    ]
    return _table(("misses in a row", "runs", "in the fitted model", "if independent"), rows)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        f"| {' | '.join(header)} |",
        f"|{'---|' * len(header)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _tau(row: Mapping[str, Any]) -> str:
    if row["tau_s"] is None:
        return "too few misses"
    low, high = row["tau_interval_s"]
    return f"{row['tau_s']:.2f} s ({low:.2f} to {high:.2f})"
