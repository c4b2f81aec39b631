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
from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.errors import InputError
from pemviz.files.array_files import LARGEST_READ_BYTES, load_tensors, map_arrays
from pemviz.panel.rollout_tables import by_stage, check_table, checked_rows, numbered, thinned
from pemviz.panel.run_data import ProposalCurve, RunData, detection_probability, own_scenario
from pemviz.pem import load_pem
from pemviz.proposals.gap_network import gap_network_from_arrays
from pemviz.runs.back_ends import build_back_end
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result_file import RESULT_FILE
from pemviz.runs.rollout_files import load_rollouts, stage_files
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.slots import SlotSimulator, UnrolledSimulator
from pemviz.types import Simulator

READ_BYTES = 64 * 1024**2
"""Larger files of rollouts stay on disk."""
VISITED_ROLLOUTS, OF_A_STAGE = 20_000, 4_000
"""Of which curves are means, those of all stages together and of one: a hundred states of each."""
GROUP_ROWS = 20
MOST_CURVES = 200
BIN_M = 0.25
DRAWN_BACK_END = "vectorized"
_INDEX = re.compile("[0-9]{1,9}")


class LoadedRuns:
    """Runs read from folders; browsers that look at the same one share its arrays."""

    def __init__(self) -> None:
        self._lock, self._looking = threading.Lock(), threading.Lock()
        self._looked_at = set[tuple[Path, int]]()
        self._runs: WeakValueDictionary[tuple[Path, int], RunData] = WeakValueDictionary()

    def get(self, folder: Path) -> RunData:
        """The run in a folder, read unless some browser holds it.

        Raises:
            InputError: Something in it is absent or damaged.
        """
        with self._lock:
            key = _state_of(folder)
            run = self._runs.get(key)
            if run is None:
                self._runs[key] = run = load_run(folder)
            return run

    def disagreement(self, folder: Path) -> InputError | None:
        """What a look at all of a large run's files finds wrong; it takes some seconds a run."""
        with self._looking:
            try:
                if (key := _state_of(folder)) not in self._looked_at:
                    read_whole_run(folder)
                    self._looked_at.add(key)
            except InputError as error:
                return error
        return None


def _state_of(folder: Path) -> tuple[Path, int]:
    """A run's folder, and when its result was last changed."""
    try:
        return folder, (folder / RESULT_FILE).stat().st_mtime_ns
    except OSError as error:
        message = f"run {folder}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error


def load_run(folder: Path, *, most_read_bytes: int = READ_BYTES) -> RunData:
    """Read a run folder.

    Args:
        folder: The folder.
        most_read_bytes: A larger ``rollouts.npz`` is not read: what it holds of each step stays
            on disk, and is read and checked when it is looked at. Nor are larger files held to
            the result: :meth:`LoadedRuns.disagreement` does.

    Raises:
        InputError: Something in it is absent or damaged.
    """
    result = read_whole_run(folder, most_bytes=most_read_bytes)
    config = result.config
    try:
        own = _own_scenario(config)
    except InputError as error:
        if result.simulator is None:
            raise
        message = (
            f"run {folder}: its simulator, {result.simulator.code}, is known to the program that "
            "ran it alone; register it under the entry points pemviz.simulators to see the run here"
        )
        raise InputError(message) from error
    table, mapped = _rollouts(folder, config, own, most_read_bytes=most_read_bytes)
    table = numbered(table) if table else {}
    parts = (table,) if table else ()
    if not mapped and sum(values.nbytes for values in table.values()) > most_read_bytes:
        parts = thinned(parts, stages=result.stages)
    drawn = sum(stage.rollouts for stage in result.stages)
    simulated = max(drawn, table["violated"].size) if table else 0  # a folder may keep fewer
    run = RunData(
        result=result, gap_m=np.empty(0), pem_detection=np.empty(0), parts=parts,
        simulated=simulated, folder=folder, own=own, mapped=mapped,
    )  # fmt: skip
    return _with_curves(run, table, folder) if own is None else run  # else no gap to draw against


def _with_curves(run: RunData, table: Mapping[str, AnyArray], folder: Path) -> RunData:
    config = run.config
    simulator = VectorizedSimulator(config.scenario)
    gap_m = gap_grid(simulator)
    try:
        pem_detection = pem_curve(simulator=simulator, pem=load_pem(config.pem), gap_m=gap_m)
    except InputError:  # the error model's file may be elsewhere by now: the rollouts tell too
        pem_detection = np.full(gap_m.size, np.nan)
        if table:
            rows = _spread(np.arange(table["violated"].size), most=VISITED_ROLLOUTS)
            pem_detection = _visited_curve(table, rows, "log_p", folder, gap_m=gap_m)
    curves, curves_from = _learned_curves(folder, config, gap_m=gap_m), None
    if not curves and table:
        follows_model = run.method.follows_model
        curves, curves_from = _visited_curves(
            table, folder, follows_model=follows_model, gap_m=gap_m
        )
    return replace(
        run, gap_m=gap_m, pem_detection=pem_detection, curves=curves, curves_from=curves_from
    )


def _own_scenario(config: ExperimentConfig) -> Simulator | SlotSimulator | None:
    """The scenario that ``config`` names, if it is another than the braking scenario.

    Raises:
        InputError: There is none of that name here.
    """
    if config.is_braking_scenario:
        return None
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        config = replace(config, simulator=DRAWN_BACK_END)  # the same states on every back end
    found = build_back_end(config).simulator
    return own_scenario(found.scenario if isinstance(found, UnrolledSimulator) else found, config)


def _rollouts(
    folder: Path,
    config: ExperimentConfig,
    own: Simulator | SlotSimulator | None,
    *,
    most_read_bytes: int,
) -> tuple[dict[str, AnyArray], bool]:
    """The table of rollouts, empty if there is none, and whether its steps stay on disk."""
    whole, parts = folder / "rollouts.npz", stage_files(folder)
    if not whole.exists() and not parts:
        return {}, False
    size = sum(file.stat().st_size for file in parts or [whole])
    mapped = not parts and size > most_read_bytes
    if parts and size > LARGEST_READ_BYTES:
        message = f"rollouts {folder}: stages of over 4 GB are too large to show before they end"
        raise InputError(message)
    table = map_arrays(whole) if mapped else load_rollouts(folder)
    check_table(table, config, where=str(folder), simulator=own, mapped=mapped)
    return table, mapped


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
        curves.append(ProposalCurve(repetition, stage, detection))
    return tuple(curves)


def _visited_curves(
    table: Mapping[str, AnyArray], folder: Path, *, follows_model: bool, gap_m: FloatArray
) -> tuple[tuple[ProposalCurve, ...], int | None]:
    """What every stage's rollouts were drawn from, where some of them have been.

    Of the error model itself one curve is enough. Beside the curves how many rollouts of a stage
    that is, where any has more.
    """
    curves: list[ProposalCurve] = []
    stages = by_stage(table)
    stages = stages[-1:] if follows_model else stages[-MOST_CURVES:]
    most = min(VISITED_ROLLOUTS // len(stages), OF_A_STAGE)
    for rows in stages:
        repetition, stage = (int(table[name][rows[0]]) for name in ("repetition", "stage"))
        visited = _spread(rows, most=most)
        detection = _visited_curve(table, visited, "log_q", folder, gap_m=gap_m)
        curves.append(ProposalCurve(repetition, stage, detection))
    return tuple(curves), most if any(rows.size > most for rows in stages) else None


def _spread(rows: IntArray, *, most: int) -> IntArray:
    """At most ``most`` of some rows, in short groups which are spread evenly: few pages."""
    if rows.size <= most:
        return rows
    groups = most // GROUP_ROWS
    firsts = np.linspace(0, rows.size - GROUP_ROWS, groups).round().astype(np.int64)
    return rows[(firsts[:, None] + np.arange(GROUP_ROWS)).ravel()]


def _visited_curve(
    table: Mapping[str, AnyArray], rows: IntArray, likelihood: str, folder: Path, *,
    gap_m: FloatArray,
) -> FloatArray:  # fmt: skip
    """Mean P(detected) ``[G]`` at the gaps that some rollouts visited; NaN elsewhere."""
    part = checked_rows(table, ("gap_m", "detected", likelihood), rows, where=str(folder))
    detection = detection_probability(part[likelihood], part["detected"]).ravel()
    gaps = part["gap_m"][:, :-1].ravel()
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
