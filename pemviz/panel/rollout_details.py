"""What there is to say of a rollout beside its charts, and which rule a run opens on."""

from dataclasses import replace
from typing import cast

import numpy as np

from pemviz import stl
from pemviz.arrays import FloatArray
from pemviz.charts.chart import Axis, Line, PlaneChart
from pemviz.latents import Latents
from pemviz.panel.pieces import drawn, number, signal_name
from pemviz.panel.ranking import RankedRow
from pemviz.panel.rollout_tables import final_violations
from pemviz.panel.run_data import RunData
from pemviz.reports.charts import RUN_COLORS
from pemviz.reports.document import Block, Paragraph, Table, Verdict
from pemviz.reports.html import blocks_html, heading
from pemviz.runs.answers import rules_in_order
from pemviz.runs.specification import build_formula
from pemviz.simulators.latents import NamesStarts, within
from pemviz.types import Simulator

MOST_LATENTS = 12
NOISE_HEIGHT = 130
BROKEN, KEPT = Verdict("no", "broken"), Verdict("yes", "kept")
ALL_RULES = "all rules"


def details(run: RunData, entry: RankedRow, *, contact: str = "") -> str:
    """Each rule, contact, start and latents; empty where scene and plots tell all there is."""
    blocks: list[Block] = []
    if robustness := rule_robustness(run, entry.index):
        rows = tuple(
            (name, number(value), BROKEN if name in entry.broken else KEPT)
            for name, value in robustness.items()
        )
        blocks.append(Table(("rule", "robustness", ""), rows, name="Rules of the rollout"))
    if contact:
        blocks.append(Paragraph(f"{contact[0].upper()}{contact[1:]}.", tone="quiet"))
    plot, latents = "", run.latents(entry.index)
    if latents is not None:
        if latents.start.size:
            blocks.append(Paragraph(_start_words(run, latents), tone="quiet"))
        plot = drawn(noise_chart(run, latents))
    shown = blocks_html(blocks) + plot
    return heading("The rollout shown") + shown if shown else ""


def rule_robustness(run: RunData, index: int) -> dict[str, float]:
    """Classical robustness of a rollout in each rule, by name."""
    signals = run.signals(index)
    found: dict[str, float] = {}
    for rule in run.config.rules:
        config = replace(run.config, spec=rule.formula, rules=())
        formula = build_formula(config, cast(Simulator, run.simulator))
        found[rule.name] = float(stl.robustness(formula, signals, stl.Classical())[0])
    return found


def _start_words(run: RunData, latents: Latents) -> str:
    """The values it started with, where the scenario names them; else the latents themselves."""
    named = within(run.simulator, NamesStarts)
    if named is None:
        mean = latents.start_mean[0]
        around = f", sampled around {_listed(mean)}" if np.any(mean) else ""
        return f"Standard normals at its start: {_listed(latents.start[0])}{around}."
    values = named.start_values(latents.start)
    words = [
        f"{signal_name(signal)} {number(float(values[signal.name][0]))} {signal.unit}"
        for signal in named.starts
    ]
    return f"It started with {', '.join(words)}."


def _listed(values: FloatArray) -> str:
    shown, more = ", ".join(number(float(v)) for v in values[:MOST_LATENTS]), values.size
    return shown if more <= MOST_LATENTS else f"{shown} and {more - MOST_LATENTS} more"


def noise_chart(run: RunData, latents: Latents) -> PlaneChart | None:
    """The latents of a rollout's steps, as many as there are colours; ``None`` without any."""
    noise: FloatArray = latents.noise[0, :, : len(RUN_COLORS)]
    if not noise.size:
        return None
    reach = max(3.0, float(np.max(np.abs(noise))) * 1.05)
    steps_s = run.time_s[: len(noise)]
    lines = tuple(
        Line(steps_s, values, color, width=1.2, name=f"latent {place}")
        for place, (values, color) in enumerate(zip(noise.T, RUN_COLORS, strict=False), start=1)
    )
    return PlaneChart(
        title="Standard normals of its steps",
        x=Axis(0.0, float(run.time_s[-1]), "time [s]"),
        y=Axis(-reach, reach, "standard deviations"),
        marks=lines,
        height=NOISE_HEIGHT,
    )


def opens_on(run: RunData) -> str:
    """The first rule that anything breaks, those about collisions before others."""
    ordered = rules_in_order(run.config.rules)
    final = (final_violations(run.rollouts, stages=run.result.stages, rule=r.name) for r in ordered)
    broken = (rule.name for rule, found in zip(ordered, final, strict=True) if found.any())
    return next(broken, ALL_RULES) if run.parts else ALL_RULES
