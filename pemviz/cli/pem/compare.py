"""``pemviz pem compare``."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from pemviz.config.ranges import Range, check_value
from pemviz.config.toml_files import load_config, load_preset
from pemviz.errors import ConfigError
from pemviz.runs.model_comparison import ModelFigures, compare_models

Rollouts = Annotated[int, Range(low=2, high=1_000_000)]
DEFAULT_PRESET = "paper"
Seed = Annotated[int, Range(low=0, high=2**63 - 1)]


@dataclass(frozen=True, kw_only=True)
class CompareArguments:
    """Failure probability under several error models, and its ratio to the first one's.

    All from the same rollouts, drawn by the zero-variance method: a few seconds a model.
    """

    models: tyro.conf.Positional[tuple[str, ...]]
    """Shipped names, files, or with --allow-python module:attribute; at least two."""
    preset: str | None = None
    """Shipped configuration whose scenario and specification are taken: paper (default), town01."""
    config: Path | None = None
    """Configuration file in place of a preset; its simulator needs a fast twin, as all of this."""
    spec: str | None = None
    """Another specification; 'always' over a condition on single states."""
    rollouts: Rollouts = 1200
    """Rollouts for each model; 2 to 1000000."""
    seed: Seed = 0
    """Root of all randomness; 0 or more."""
    allow_python: bool = False
    """Allow a model named module:attribute, which runs that module's code."""
    json: bool = False
    """Print the figures as one JSON object and nothing else."""


def run(arguments: CompareArguments) -> int:
    """Estimate and print; gives the exit code.

    Raises:
        InputError: The arguments are wrong, or a model cannot be used.
    """
    check_value(name="rollouts", value=arguments.rollouts, annotation=Rollouts)
    check_value(name="seed", value=arguments.seed, annotation=Seed)
    if arguments.config is not None and arguments.preset is not None:
        message = f"config {arguments.config} and preset {arguments.preset!r}: give only one"
        raise ConfigError(message)
    if arguments.config is not None:
        base = load_config(arguments.config)
    else:
        base = load_preset(arguments.preset or DEFAULT_PRESET)
    config = replace(base, seed=arguments.seed, spec=arguments.spec or base.spec)
    figures = compare_models(
        config, arguments.models, rollouts=arguments.rollouts, allow_python=arguments.allow_python
    )
    if arguments.json:
        print(json.dumps({"models": [asdict(one) for one in figures]}, allow_nan=False))
        return 0
    title = f"{config.spec}, {arguments.rollouts} rollouts a model"
    table = Table(title=title, title_justify="left")
    for column in ("error model", "probability", "times the first", "interval of the ratio"):
        table.add_column(column, justify="left" if column == "error model" else "right")
    for one in figures:
        table.add_row(*_cells(one))
    console = Console()
    console.print(table)
    for one in figures:
        if one.log10_probability is not None and one.unreliable_because:
            reasons = "; ".join(one.unreliable_because)
            words = f"warning: {one.name}: {reasons}: do not quote its number"
            console.print(words, soft_wrap=True, markup=False)
    return 0


def _cells(one: ModelFigures) -> tuple[str, str, str, str]:
    if one.log10_probability is None:
        return one.name, "no violation", "", ""
    probability = f"{one.probability:.3g} +- {one.std_error:.1g}"
    if one.to_first is None:
        return one.name, probability, "1", ""
    ratio = one.to_first
    return (
        one.name,
        probability,
        f"{10.0**ratio.log10_ratio:.3g}",
        f"{10.0**ratio.log10_low:.3g} to {10.0**ratio.log10_high:.3g} {_level(one)}",
    )


def _level(one: ModelFigures) -> str:
    return "(not a 95 % interval)" if one.interval_caveats else "(95 %)"
