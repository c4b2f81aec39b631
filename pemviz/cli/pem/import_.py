"""``pemviz pem import``: noise parameters of another simulator as error models of pemviz."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from pemviz.cli.pem.checks import check_out, check_rate_hz
from pemviz.cli.pem.export import ERRORS_BESIDE
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.text_files import writing
from pemviz.pem.exchange.autoware import Configuration, NoiseFile, read_noise
from pemviz.pem.exchange.averages import FARTHEST_M
from pemviz.pem.exchange.binned_models import miss_model, position_model
from pemviz.pem.model_files import SUFFIX, save_pem, save_position_errors
from pemviz.pem.models.tabulated import check_sensor_ahead


@dataclass(frozen=True)
class ImportArguments:
    """Read noise parameters of scenario_simulator_v2 as models that 'pemviz record' runs."""

    file: tyro.conf.Positional[Path]
    """Parameters of scenario_simulator_v2, with noise of version 4 (.yaml)."""
    out: Path
    """Model of misses to write, ending in .safetensors; position errors, where there are some, go
    into OUT-position-errors.safetensors beside it."""
    format: Literal["autoware"] = "autoware"
    """Whose parameters."""
    config: str | None = None
    """Which of the file's configurations, where it has several."""
    sensor_ahead_m: float = 0.0
    """How far the sensor is ahead of base_link, from where the file's distances are [m]; -30 to
    30."""
    rate_hz: float | None = None
    """Frames a second of that simulator (above 0), for correlations that depend on it: those with
    an amplitude other than 1, or an offset."""


def run(arguments: ImportArguments) -> int:
    """Read, write, and say what pemviz has no words for; gives the exit code.

    Raises:
        PemError: bad arguments or file; one line says what, where and what is allowed.
    """
    check_out(arguments.out, ending=SUFFIX)
    check_rate_hz(arguments.rate_hz)
    check_sensor_ahead(arguments.sensor_ahead_m, where="pem import")
    file = read_noise(arguments.file, rate_hz=arguments.rate_hz)
    chosen = file.named(arguments.config)
    name, ahead_m = arguments.file.stem, arguments.sensor_ahead_m
    misses = miss_model(chosen, file.notes, name=name, sensor_ahead_m=ahead_m)
    errors = position_model(chosen, file.notes, name=name, sensor_ahead_m=ahead_m)
    beside = arguments.out.with_name(f"{arguments.out.stem}{ERRORS_BESIDE}{SUFFIX}")
    if errors is None and is_file(beside):
        message = (
            f"out = {arguments.out}: {beside} lies beside it and would pass for its position "
            "errors, of which the file has none: choose another place, or remove that"
        )
        raise PemError(message)
    with writing(arguments.out):
        save_pem(misses, arguments.out)
        if errors is not None:
            save_position_errors(errors, beside)
    low, high = 1.0 - chosen.rate.max(), 1.0 - chosen.rate.min()
    print(
        f"{arguments.out}: P(missed) {low:.3g} to {high:.3g} by distance, memory time "
        f"{chosen.tau_s:.3g} s, of configuration {chosen.name!r}"
    )
    used = "" if errors is None else f" --position-errors {beside}"
    if errors is not None:
        print(f"{beside}: position errors by distance")
    print(f"run it: pemviz record --pem {arguments.out}{used}")
    for line in _not_taken(file, chosen):
        print(f"- {line}")
    return 0


def _not_taken(file: NoiseFile, chosen: Configuration) -> Iterator[str]:
    """What of the file the models do not have."""
    others = [one.name for one in file.configurations if one is not chosen]
    if others:
        yield f"left in the file: configurations {', '.join(others)} (--config)"
    yield f"for entities of subtype {', '.join(chosen.subtypes)}; the model answers for any"
    for one in (*chosen.other, *file.other):
        yield f"not taken: {one}"
    last_m = float(chosen.radii_m[-1])
    if last_m < FARTHEST_M:
        yield f"beyond {last_m:g} m nothing is reported: P(missed) is 1 to twelve decimals there"
