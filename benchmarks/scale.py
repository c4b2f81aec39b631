"""``python -m benchmarks scale``: how time and memory grow with rollouts and with their length."""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pemviz.config import KeepName
from pemviz.errors import ConfigError, RunError

ROOT = Path(__file__).resolve().parents[1]
GRID = ("1000x100", "10000x100", "100000x100", "1000000x100", "10000x500", "10000x2000")
DISK_BYTES_PER_STEP: Mapping[KeepName, float] = {"all": 120.0, "violations": 0.3}
"""Of a run folder at its largest, when the parts of the final batch are joined."""


@dataclass(frozen=True, kw_only=True)
class ScaleStudy:
    """Measure how time and memory grow: Monte Carlo runs, kept in a temporary folder.

    Each case runs in a process of its own. The largest of the default ones needs 12 GB of
    temporary disk space; cases without it are left out and say so.
    """

    cases: tuple[str, ...] = GRID
    """Rollouts and states of a rollout, as 1000x100."""
    keep: KeepName = "all"
    """What is kept: all rollouts, or violations, which take hardly any disk space."""
    json: bool = False
    """Print the figures as one JSON object and nothing else."""


@dataclass(frozen=True, kw_only=True)
class ScaleRow:
    """One case.

    Attributes:
        rollouts: Of the run.
        states: Of each rollout.
        run_s: The whole run, from the first rollout to the finished run folder [s].
        run_ns_per_step: The same, divided by rollouts and steps [ns].
        simulation_ns_per_step: Of that, simulation [ns].
        peak_mb: Peak memory of the process [MB].
        disk_mb: Size of the run folder [MB].
        skipped: Why there are no figures; empty where there are.
    """

    rollouts: int
    states: int
    run_s: float | None = None
    run_ns_per_step: float | None = None
    simulation_ns_per_step: float | None = None
    peak_mb: float | None = None
    disk_mb: float | None = None
    skipped: str = ""


def run_scale(study: ScaleStudy) -> Iterator[ScaleRow]:
    """Measure case by case.

    Raises:
        InputError: A case is not written as it should be.
        RunError: A run failed.
    """
    cases = [_sizes(case) for case in study.cases]
    return (_row(rollouts=n, states=states, keep=study.keep) for n, states in cases)


def _sizes(case: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,6})", case)
    if match is None or int(match[1]) < 2 or not 2 <= int(match[2]) <= 100_000:
        message = f"cases = {case!r}: must be rollouts and states, such as 1000x100; both from 2"
        raise ConfigError(message)
    return int(match[1]), int(match[2])


def _row(*, rollouts: int, states: int, keep: KeepName) -> ScaleRow:
    steps = rollouts * (states - 1)
    reason = _why_not(disk_bytes=steps * DISK_BYTES_PER_STEP[keep])
    if reason:
        return ScaleRow(rollouts=rollouts, states=states, skipped=reason)
    with tempfile.TemporaryDirectory(prefix="pemviz-scale-") as folder:
        measured = _in_a_process(
            {
                "rollouts": rollouts,
                "states": states,
                "keep": keep,
                "folder": folder,
            }
        )
    return ScaleRow(
        rollouts=rollouts,
        states=states,
        run_s=measured["run_s"],
        run_ns_per_step=1e9 * measured["run_s"] / steps,
        simulation_ns_per_step=1e9 * measured["simulation_s"] / steps,
        peak_mb=measured["peak_bytes"] / 1e6,
        disk_mb=measured["disk_bytes"] / 1e6,
    )


def _why_not(*, disk_bytes: float) -> str:
    """Why a case cannot run here; empty if it can."""
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if disk_bytes <= free:
        return ""
    return f"needs {disk_bytes / 1e9:.1f} GB in {tempfile.gettempdir()}, free {free / 1e9:.1f}"


def _in_a_process(case: dict[str, str | int]) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.scale_case", json.dumps(case)]
    done = subprocess.run(  # noqa: S603  our own program, no shell
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise RunError(f"case of {case['rollouts']} rollouts: {last}")
    return json.loads(done.stdout)


HEADER = (
    "rollouts",
    "states",
    "run [s]",
    "ns a step",
    "of it simulation",
    "peak [MB]",
    "disk [MB]",
)
"""Of the table; a step is one of one rollout."""


def cells(row: ScaleRow) -> Sequence[str]:
    """A row's entries under `HEADER`."""
    figures = (row.run_ns_per_step, row.simulation_ns_per_step, row.peak_mb, row.disk_mb)
    return (
        f"{row.rollouts:,}",
        f"{row.states:,}",
        "-" if row.run_s is None else f"{row.run_s:.1f}",
        *("-" if figure is None else f"{figure:,.0f}" for figure in figures),
    )


def reasons(rows: Sequence[ScaleRow]) -> Sequence[str]:
    """What was skipped and why, a line each."""
    return [
        f"{row.rollouts:,} rollouts of {row.states:,}: skipped, {row.skipped}"
        for row in rows
        if row.skipped
    ]
