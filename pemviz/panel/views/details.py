"""What else there is to say of the rollout shown: each rule, contact, its start, its latents."""

from dataclasses import replace
from html import escape
from typing import cast

import numpy as np

from pemviz import stl
from pemviz.arrays import FloatArray
from pemviz.charts.svg import Axis, Plot
from pemviz.colors import MISSED
from pemviz.latents import Latents
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData
from pemviz.panel.views.curves import RUN_COLORS
from pemviz.panel.views.elements import block, grid, number, quiet
from pemviz.reports.html import heading
from pemviz.runs.specification import build_formula
from pemviz.simulators.starts import named_starts
from pemviz.types import Simulator

MOST_LATENTS = 12
MOST_NOISE = len(RUN_COLORS)
WIDTH, HEIGHT = 390, 130


def details(run: RunData, entry: RankedRow, *, contact: str = "") -> str:
    """All of it; empty where there is nothing beyond what scene and plots tell.

    Args:
        run: The run shown.
        entry: The rollout.
        contact: When and how fast the cars touched, in words.
    """
    latents = run.latents(entry.index)
    parts = [
        _rules(run, entry),
        quiet(f"{contact[0].upper()}{contact[1:]}.") if contact else "",
        "" if latents is None else _start(run, latents),
        "" if latents is None else _noise(run, latents),
    ]
    shown = "".join(parts)
    return block(heading("The rollout shown") + shown) if shown else ""


def rule_robustness(run: RunData, index: int) -> dict[str, float]:
    """Classical robustness of a rollout in each rule, by name."""
    signals = run.signals(index)
    found: dict[str, float] = {}
    for rule in run.config.rules:
        config = replace(run.config, spec=rule.formula, rules=())
        formula = build_formula(config, cast(Simulator, run.simulator))
        found[rule.name] = float(stl.robustness(formula, signals, stl.Classical())[0])
    return found


def _rules(run: RunData, entry: RankedRow) -> str:
    lines = [
        [
            escape(name),
            number(robustness),
            f"<b style='color:{MISSED}'>broken</b>" if name in entry.broken else "kept",
        ]
        for name, robustness in rule_robustness(run, entry.index).items()
    ]
    return grid(["rule", "robustness", ""], lines, name="Rules of the rollout") if lines else ""


def _start(run: RunData, latents: Latents) -> str:
    """The values it started with, where the scenario names them; else the latents themselves."""
    drawn, mean = latents.start[0], latents.start_mean[0]
    if not drawn.size:
        return ""
    named = named_starts(run.simulator)
    if named is None:
        around = f", drawn around {_listed(mean)}" if np.any(mean) else ""
        return quiet(f"Standard normals at its start: {_listed(drawn)}{around}.")
    values = named.start_values(latents.start)
    words = [
        f"{escape(signal.name.replace('_', ' '))} {number(float(values[signal.name][0]))} "
        f"{escape(signal.unit)}"
        for signal in named.starts
    ]
    return quiet(f"It started with {', '.join(words)}.")


def _noise(run: RunData, latents: Latents) -> str:
    """The latents of its steps against time."""
    noise: FloatArray = latents.noise[0, :, :MOST_NOISE]
    if not noise.size:
        return ""
    reach = max(3.0, float(np.max(np.abs(noise))) * 1.05)
    time_s = run.time_s
    plot = Plot(
        title="Standard normals of its steps",
        x=Axis(0.0, float(time_s[-1]), "time [s]"),
        y=Axis(-reach, reach, "standard deviations"),
        width=WIDTH,
        height=HEIGHT,
    )
    for place, values in enumerate(noise.T):
        plot.line(time_s[:-1], values, color=RUN_COLORS[place], width=1.2)
    return plot.text()


def _listed(values: FloatArray) -> str:
    shown, more = ", ".join(number(float(v)) for v in values[:MOST_LATENTS]), values.size
    return shown if more <= MOST_LATENTS else f"{shown} and {more - MOST_LATENTS} more"
