"""A run folder as the panel's data."""

import re
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
from scipy.special import expit

from pemviz.analysis.detection_curves import gap_grid, initial_states, pem_curve
from pemviz.arrays import AnyArray, FloatArray
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_FAMILY
from pemviz.errors import InputError
from pemviz.files.array_files import load_tensors
from pemviz.panel.run_data import (
    ProposalCurve,
    RunData,
    check_table,
    detection_probability,
    numbered,
    own_scenario,
    thinned,
)
from pemviz.pem import load_pem
from pemviz.proposals.gap_network import gap_network_from_arrays
from pemviz.runs.back_ends import build_back_end
from pemviz.runs.result_file import RESULT_FILE
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.same_run import read_whole_run
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.slots import SlotSimulator, UnrolledSimulator
from pemviz.types import Simulator, StageKind

LARGEST_ROLLOUTS_BYTES = 4 * 1024**3
BIN_M = 0.25
DRAWN_BACK_END = "vectorized"
_INDEX = re.compile("[0-9]{1,9}")


class LoadedRuns:
    """Runs read from folders; browsers that look at the same one share its arrays."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._runs: WeakValueDictionary[tuple[Path, int], RunData] = WeakValueDictionary()

    def get(self, folder: Path) -> RunData:
        """The run in a folder, read unless some browser holds it.

        Raises:
            InputError: Something in it is absent or damaged.
        """
        with self._lock:
            try:
                key = (folder, (folder / RESULT_FILE).stat().st_mtime_ns)
            except OSError as error:
                message = f"run {folder}: cannot be read ({error.strerror or error})"
                raise InputError(message) from error
            run = self._runs.get(key)
            if run is None:
                self._runs[key] = run = load_run(folder)
            return run


def load_run(folder: Path) -> RunData:
    """Read a run folder.

    Raises:
        InputError: Something in it is absent or damaged.
    """
    result = read_whole_run(folder)
    config = result.config
    own = _own_scenario(config)
    table = _rollouts(folder, config, own)
    parts = thinned((numbered(table),), stages=result.stages) if table else ()
    drawn = sum(stage.rollouts for stage in result.stages)
    simulated = max(drawn, table["violated"].size) if table else 0  # a folder may keep fewer
    if own is not None:  # no gap to draw curves against
        return RunData(
            result=result, gap_m=np.empty(0), pem_detection=np.empty(0), parts=parts,
            simulated=simulated, folder=folder, own=own,
        )  # fmt: skip
    simulator = VectorizedSimulator(config.scenario)
    gap_m = gap_grid(simulator)
    try:
        pem = load_pem(config.pem)
        pem_detection = pem_curve(simulator=simulator, pem=pem, gap_m=gap_m)
        curves = _learned_curves(folder, config, gap_m=gap_m)
    except InputError:  # the error model's file may be elsewhere by now: the rollouts tell too
        pem_detection = _visited_curve(table, "log_p", gap_m=gap_m)
        curves = _learned_curves(folder, config, gap_m=gap_m)
    if not curves and table:
        curves = _visited_curves(table, gap_m=gap_m)
    return RunData(
        result=result,
        gap_m=gap_m,
        pem_detection=pem_detection,
        curves=curves,
        parts=parts,
        simulated=simulated,
        folder=folder,
    )


def _own_scenario(config: ExperimentConfig) -> Simulator | SlotSimulator | None:
    """The scenario that ``config`` names, if it is another than the braking scenario.

    Raises:
        InputError: There is none of that name here, or nothing to draw.
    """
    if config.is_braking_scenario:
        return None
    if config.encounter.family != NO_FAMILY:  # the same states on every back end
        config = replace(config, simulator=DRAWN_BACK_END)
    found = build_back_end(config).simulator
    return own_scenario(found.scenario if isinstance(found, UnrolledSimulator) else found, config)


def _rollouts(
    folder: Path, config: ExperimentConfig, own: Simulator | SlotSimulator | None
) -> dict[str, AnyArray]:
    whole = folder / "rollouts.npz"
    if whole.exists() and whole.stat().st_size > LARGEST_ROLLOUTS_BYTES:
        message = f"rollouts {whole}: larger than 4 GB, too large to show here"
        raise InputError(message)
    if not whole.exists() and not any((folder / "stages").glob("*.npz")):
        return {}
    table = load_rollouts(folder)
    check_table(table, config, where=str(folder), simulator=own)
    return table


def _learned_curves(
    folder: Path, config: ExperimentConfig, *, gap_m: FloatArray
) -> tuple[ProposalCurve, ...]:
    """Curves of the proposals kept, as far as they are the paper's networks."""
    path = folder / "proposals.safetensors"
    if not path.is_file():
        return ()
    tensors = load_tensors(path)
    groups: dict[tuple[int, int], dict[str, AnyArray]] = {}
    for name, values in tensors.items():
        parts = name.split(".", 4)
        if len(parts) == 5 and _INDEX.fullmatch(parts[1]) and _INDEX.fullmatch(parts[3]):
            key = (int(parts[1]), int(parts[3]))
            groups.setdefault(key, {})[parts[4]] = values
    simulator = VectorizedSimulator(config.scenario)
    curves: list[ProposalCurve] = []
    for (repetition, stage), arrays in sorted(groups.items()):
        try:
            proposal = gap_network_from_arrays(arrays)
            logit = proposal.logit(initial_states(simulator, gap_m=gap_m), np.zeros(gap_m.size))
            detection = np.asarray(expit(logit), dtype=np.float64)
        except (KeyError, ValueError):
            return ()
        kind: StageKind = "learn" if stage else "pretrain"
        curves.append(ProposalCurve(repetition, stage, kind, gap_m, detection))
    return tuple(curves)


def _visited_curves(
    table: Mapping[str, AnyArray], *, gap_m: FloatArray
) -> tuple[ProposalCurve, ...]:
    """What every stage's rollouts were drawn from, where they have been."""
    curves: list[ProposalCurve] = []
    keys = np.unique(np.stack([table["repetition"], table["stage"]], axis=1), axis=0)
    for repetition, stage in keys[-200:].tolist():
        chosen = (table["repetition"] == repetition) & (table["stage"] == stage)
        part = {name: table[name][chosen] for name in ("gap_m", "detected", "log_p", "log_q")}
        detection = _visited_curve(part, "log_q", gap_m=gap_m)
        curves.append(ProposalCurve(repetition, stage, "learn", gap_m, detection))
    return tuple(curves)


def _visited_curve(
    table: Mapping[str, AnyArray], likelihood: str, *, gap_m: FloatArray
) -> FloatArray:
    """Mean P(detected) ``[G]`` at the gaps visited; NaN elsewhere."""
    if not table:
        return np.full(gap_m.size, np.nan)
    detection = detection_probability(table[likelihood], table["detected"]).ravel()
    gaps = table["gap_m"][:, :-1].ravel()
    edges = np.arange(gap_m[0] - BIN_M / 2, gap_m[-1] + BIN_M, BIN_M)
    inside = (gaps >= edges[0]) & (gaps < edges[-1]) & np.isfinite(detection)
    index = np.digitize(gaps[inside], edges) - 1
    count = np.bincount(index, minlength=edges.size - 1)
    total = np.bincount(index, weights=detection[inside], minlength=edges.size - 1)
    filled = count > 0
    if not np.any(filled):
        return np.full(gap_m.size, np.nan)
    centres = (edges[:-1] + edges[1:]) / 2
    mean = total[filled] / count[filled]
    return np.interp(gap_m, centres[filled], mean, left=np.nan, right=np.nan)
