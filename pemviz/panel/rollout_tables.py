"""Tables of rollouts under the keys of ``rollouts.npz``: checked, numbered, thinned."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.files.array_files import let_go
from pemviz.runs.drawn_rollout import slots_of
from pemviz.runs.result import StageSummary
from pemviz.runs.rollout_files import BROKEN, LATENTS, ROLLOUT, latents_of, log_weights
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Simulator

KEPT_ROLLOUTS, MOST_STAGES = 20_000, 1 << 32
FARTHEST = 1e9
"""Beyond any gap [m], speed [m/s] or log likelihood of a step [nats]."""
_KINDS = {"detected": "b", "violated": "b", "repetition": "i", "stage": "i", ROLLOUT: "i"}
_KIND_WORDS = {"b": "truth values", "i": "whole numbers", "f": "floating-point numbers"}
PER_ROLLOUT = ("repetition", "stage", "robustness", "violated")


def thinned(
    parts: Sequence[Mapping[str, AnyArray]],
    *,
    stages: Sequence[StageSummary],
    limit: int = KEPT_ROLLOUTS,
) -> tuple[Mapping[str, AnyArray], ...]:
    """At most ``limit`` rollouts, in their order.

    If there are more: of the final stages' violations those of largest weight, up to half of
    what is kept, and beside them the least robust of all others.
    """
    if sum(part["violated"].shape[0] for part in parts) <= limit:
        return tuple(parts)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in PER_ROLLOUT}
    violations = np.flatnonzero(final_violations(columns, stages=stages))
    log_weight = np.concatenate([log_weights(part) for part in parts])[violations]
    heavy = violations[np.argsort(-log_weight, kind="stable")[: limit // 2]]
    order = np.argsort(columns["robustness"], kind="stable")
    others = order[~np.isin(order, heavy)][: limit - heavy.size]
    chosen = np.sort(np.concatenate([heavy, others]))
    ends = np.cumsum([part["violated"].shape[0] for part in parts])
    pieces = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
    begins = [0, *ends[:-1].tolist()]
    own_rows = [piece - begin for piece, begin in zip(pieces, begins, strict=True)]
    taken = list(zip(parts, own_rows, strict=True))
    return ({name: np.concatenate([part[name][own] for part, own in taken]) for name in parts[0]},)


def by_stage(table: Mapping[str, AnyArray]) -> list[IntArray]:
    """The rows of each stage of each repetition of a table that is not empty, ascending."""
    key = _stage_keys(table)
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def in_stage(table: Mapping[str, AnyArray], stage: StageSummary) -> BoolArray:
    """Which rollouts ``[N]`` of a table belong to a stage."""
    return (table["repetition"] == stage.repetition) & (table["stage"] == stage.stage)


def in_final_stages(table: Mapping[str, AnyArray], *, stages: Sequence[StageSummary]) -> BoolArray:
    """Which rollouts ``[N]`` of a table belong to a final stage."""
    final = [one.repetition * MOST_STAGES + one.stage for one in stages if one.kind == "final"]
    return np.isin(_stage_keys(table), final)


def _stage_keys(table: Mapping[str, AnyArray]) -> IntArray:
    """One number ``[N]`` for each rollout's stage and repetition."""
    return table["repetition"].astype(np.int64) * MOST_STAGES + table["stage"]


def final_violations(
    table: Mapping[str, AnyArray], *, stages: Sequence[StageSummary], rule: str | None = None
) -> BoolArray:
    """Which rollouts ``[N]`` of a table violate, or break a rule, and belong to a final stage."""
    return in_final_stages(table, stages=stages) & verdicts(table, rule=rule)


def verdicts(table: Mapping[str, AnyArray], *, rule: str | None) -> BoolArray:
    """Which rollouts ``[N]`` of a table violate the specification or, if given, break a rule."""
    return np.asarray(table["violated" if rule is None else f"{BROKEN}{rule}"], dtype=np.bool_)


def numbered(part: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """The table with each rollout's index in its stage under ``rollout``."""
    if ROLLOUT in part:
        return dict(part)
    index = np.empty(part["repetition"].size, dtype=np.int64)
    for rows in by_stage(part):
        index[rows] = np.arange(rows.size)
    return {**part, ROLLOUT: index}


def check_table(
    table: Mapping[str, AnyArray],
    config: ExperimentConfig,
    *,
    where: str,
    simulator: Simulator | SlotSimulator | None = None,
    mapped: bool = False,
) -> None:
    """Check a table read from disk against what its configuration promises.

    Args:
        table: The table.
        config: The run's.
        where: Where it was read, for the error.
        simulator: The scenario; the braking scenario if it is absent.
        mapped: Whether arrays of two or more dimensions are mapped: of those shapes and types
            alone are checked, and their numbers when they are read (:func:`checked_rows`).

    Raises:
        InputError: An array is absent, or its shape, type or numbers cannot be a run's.
    """
    scenario = VectorizedSimulator(config.scenario) if simulator is None else simulator
    slots = len(slots_of(scenario))
    acted = (scenario.states - 1, slots) if slots > 1 else (scenario.states - 1,)
    shapes = {signal.key: (scenario.states,) for signal in scenario.signals}
    shapes |= dict.fromkeys(("detected", "log_p", "log_q"), acted)
    count = table["violated"].size if "violated" in table else 0
    broken = [f"{BROKEN}{rule.name}" for rule in config.rules]
    numbers = [ROLLOUT] if ROLLOUT in table else []
    for name in (*PER_ROLLOUT, *numbers, *broken, *shapes):
        shape = (count, *shapes.get(name, ()))
        if name not in table or table[name].shape != shape:
            state = "is absent" if name not in table else f"has shape {table[name].shape}"
            message = f"rollouts {where}: {name} {state}, must have shape {shape}"
            raise InputError(message)
        _refuse(name, table[name][:0] if mapped and name in shapes else table[name], where=where)
    try:
        names = latent_names(table) if mapped else ()
        latents_of({name: table[name][:0] for name in names} if mapped else table)
        for name in names:
            if table[name].shape[0] != count:
                message = f"{name} has shape {table[name].shape}, must have {count} rows"
                raise ValueError(message)
    except ValueError as error:
        message = f"rollouts {where}: {error}"
        raise InputError(message) from error


def checked_rows(
    table: Mapping[str, AnyArray], names: Iterable[str], rows: slice | IntArray, *, where: str
) -> dict[str, AnyArray]:
    """Rows of a mapped table's arrays, copied and checked.

    Raises:
        InputError: Their numbers cannot be a run's.
    """
    found = {name: np.array(table[name][rows], order="C") for name in names}
    for name, values in found.items():
        let_go(table[name])
        _refuse(name, values, where=where)
    return found


def latent_names(table: Mapping[str, AnyArray]) -> tuple[str, ...]:
    """The arrays of which :func:`pemviz.runs.rollout_files.latents_of` makes latents."""
    names = tuple(name for name in table if name.startswith(LATENTS))
    return ("detected", *names) if names else ()


def _refuse(name: str, values: AnyArray, *, where: str) -> None:
    """Refuse an array whose type or numbers cannot be a run's."""
    if name.startswith(LATENTS):
        return  # latents_of checks them
    kind = "b" if name.startswith(BROKEN) else _KINDS.get(name, "f")
    fault = None
    if values.dtype.kind != kind:
        fault = f"holds {values.dtype}, must hold {_KIND_WORDS[kind]}"
    elif kind == "i" and not np.all((values >= 0) & (values < 2**31)):
        fault = "must lie between 0 and 2147483647"
    elif name in ("log_p", "log_q") and not np.all((values <= 0.0) & (values >= -FARTHEST)):
        fault = f"must hold logarithms of probabilities, {-FARTHEST:g} to 0"
    elif name == "robustness" and np.any(np.isnan(values)):
        fault = "must hold numbers, not NaN"
    elif name not in PER_ROLLOUT and kind == "f" and not np.all(np.abs(values) <= FARTHEST):
        fault = f"must hold numbers between {-FARTHEST:g} and {FARTHEST:g}"
    if fault is not None:
        message = f"rollouts {where}: {name} {fault}"
        raise InputError(message)
