"""``pemviz pem export``: a fitted error model as the noise parameters or table of a simulator."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from pemviz.cli.help import HelpPage
from pemviz.cli.pem.checks import check_out
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, write_text
from pemviz.files.text_files import writing
from pemviz.pem.data.table import load_table
from pemviz.pem.exchange.autoware import (
    SUBTYPES,
    Configuration,
    NoiseFile,
    Subtype,
    configuration_of,
    noise_yaml,
)
from pemviz.pem.exchange.averages import (
    EDGES_M,
    Averages,
    Obstacles,
    averages,
    check_edges,
    fixed_obstacles,
    table_obstacles,
)
from pemviz.pem.exchange.plain import DISTANCE, MEANS, plain_csv, plain_rows
from pemviz.pem.exchange.unsaid import RATE_HZ, unsaid_of_misses, unsaid_of_positions
from pemviz.pem.model_files import (
    SUFFIX,
    load_pem,
    load_position_errors,
    shipped_position_errors,
)
from pemviz.pem.models.binned_position_errors import BinnedPositionErrors
from pemviz.pem.models.memory import persistence
from pemviz.pem.models.own_features import own_features_of
from pemviz.pem.models.position_errors import PositionErrorModel
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, Pem
from pemviz.pem.models.tabulated import TabulatedPem, check_sensor_ahead

ENDINGS = {"autoware": ".yaml", "csv": ".csv", "json": ".json"}
ERRORS_BESIDE = "-position-errors"
NO_ERRORS = "none"

PAGE = HelpPage(
    text="""
usage: pemviz pem export MODEL --format autoware|csv|json --out FILE [OPTIONS]
A fitted error model for another simulator, and what that cannot say of it.

  MODEL               a shipped name, or a file of 'pemviz pem fit'
  --format autoware   noise of scenario_simulator_v2, version 4 (.yaml): misses
                      with their memory, and position errors, by distance
  --format csv|json   P(missed), memory, position errors by distance, occlusion
                      and class, for a simulator of your own
  --table FILE        obstacles to average over, best those that it was fitted
                      to; left out: a car straight ahead in plain view
  --position-errors NAME|FILE|none   left out: those of the model's name, or
                      beside its file
  --edges-m 5,10,20   between the bins of distance
  --sensor-ahead-m 1.7   how far the sensor is ahead of the rear axle, where
                      distances of scenario_simulator_v2 begin
Examples
  pemviz pem export rrc --format autoware --table tracks.csv --out noise.yaml
  pemviz pem export my.safetensors --format csv --table tracks.csv --out my.csv
  pemviz pem export rrc --format json --out rrc.json
Back in: pemviz pem import noise.yaml --out own.safetensors
More: --help OPTION, such as --help table; --help-all for everything""",
)


@dataclass(frozen=True)
class ExportArguments:
    """Write an error model as noise parameters or a table for another simulator."""

    pem: tyro.conf.Positional[str]
    """Name of a shipped model, or a file (.safetensors, .csv), of misses."""
    format: Literal["autoware", "csv", "json"]
    """autoware: parameters of scenario_simulator_v2, noise version 4 (.yaml); csv, json: a table by
    class, occlusion and distance."""
    out: Path
    """File to write, ending in .yaml, .csv or .json by its format."""
    table: Path | None = None
    """Obstacles to average over, a table of 'pemviz pem collect' or one of your own. Left out: a
    car straight ahead, in plain view, seen from behind, equally often at each distance."""
    position_errors: str | None = None
    """Model of position errors, by shipped name or file; none: none. Left out: the shipped one of
    the model's name, or NAME-position-errors.safetensors beside its file, where there is one."""
    edges_m: str = ""
    """Distances between the bins [m], increasing, between commas. Left out: those of a model that
    has some, else 5, 10, 15, 20, 25, 30, 40, 50, 60 and 80."""
    sensor_ahead_m: float | None = None
    """How far the sensor is ahead of where the simulator measures distances from [m]:
    scenario_simulator_v2's base_link, the middle of the rear axle; -30 to 30, 0 if not given."""
    subtype: Subtype = "CAR"
    """Entities that a model which is a table of distances is for; with a table of obstacles its
    classes say so."""
    allow_python: bool = False
    """Allow a model named module:attribute, which runs that module's code."""


def run(arguments: ExportArguments) -> int:
    """Average, write, and say what is lost; gives the exit code.

    Raises:
        PemError: bad arguments, model or table; one line says what, where and what is allowed.
    """
    check_out(arguments.out, ending=ENDINGS[arguments.format])
    pem = load_pem(arguments.pem, allow_python=arguments.allow_python)
    if own_features_of(pem) is not None:
        raise PemError(f"{arguments.pem}: sees features of its own, which no table by distance has")
    if arguments.subtype != "CAR" and not isinstance(pem, TabulatedPem):
        raise PemError("subtype: only of a model that is a table of distances; else give a table")
    errors, errors_words = _position_errors(arguments)
    edges_m = _edges(arguments, pem)
    obstacles = _obstacles(arguments, pem, edges_m)
    if arguments.format == "autoware":
        lines = _write_autoware(arguments, pem, obstacles, edges_m, errors)
    else:
        lines = _write_table(arguments, pem, obstacles, edges_m, errors)
    print(f"averages over {obstacles.words}; position errors: {errors_words}")
    print(f"trained on: {pem.data}; licence: {pem.licence}")
    print("What it cannot say:")
    for line in lines:
        print(f"- {line}")
    return 0


def _position_errors(arguments: ExportArguments) -> tuple[PositionErrorModel | None, str]:
    """Those to go with the model, if any, and which these are."""
    named = arguments.position_errors
    if named is None and arguments.pem in shipped_position_errors():
        named = arguments.pem
    beside = Path(arguments.pem).with_name(f"{Path(arguments.pem).stem}{ERRORS_BESIDE}{SUFFIX}")
    if named is None and Path(arguments.pem).suffix == SUFFIX and is_file(beside):
        named = str(beside)
    if named in (None, NO_ERRORS):
        return None, NO_ERRORS
    return load_position_errors(named), named


def _edges(arguments: ExportArguments, pem: Pem) -> tuple[float, ...]:
    if arguments.edges_m:
        try:
            edges_m = tuple(float(word) for word in arguments.edges_m.split(","))
        except ValueError:
            raise PemError(
                f"edges_m is {arguments.edges_m!r}, must be numbers between commas"
            ) from None
    elif isinstance(pem, TabulatedPem) and pem.measure == "nearest-point":
        edges_m = tuple(pem.distance_m[1:].tolist())
    else:
        edges_m = EDGES_M
    check_edges(edges_m)
    return edges_m


def _obstacles(arguments: ExportArguments, pem: Pem, edges_m: tuple[float, ...]) -> Obstacles:
    ahead_m = arguments.sensor_ahead_m
    if ahead_m is None:
        ahead_m = pem.sensor_ahead_m if isinstance(pem, TabulatedPem) else 0.0
    check_sensor_ahead(ahead_m, where="pem export")
    if arguments.table is None:
        return fixed_obstacles(edges_m, sensor_ahead_m=ahead_m)
    table = load_table(arguments.table)
    return table_obstacles(table, name=arguments.table.name, sensor_ahead_m=ahead_m)


def _write_autoware(
    arguments: ExportArguments,
    pem: Pem,
    obstacles: Obstacles,
    edges_m: tuple[float, ...],
    errors: PositionErrorModel | None,
) -> list[str]:
    """Write the parameters; gives what they cannot say."""
    kinds = obstacles.salient[:, COLUMN["class_id"]]
    subtype_of: dict[int, Subtype] = {
        code: SUBTYPES[CLASS_NAMES[code]]
        for code in obstacles.classes
        if CLASS_NAMES[code] in SUBTYPES
    }
    if arguments.table is None:
        subtype_of = dict.fromkeys(obstacles.classes, arguments.subtype)
    if not subtype_of:
        raise PemError(f"{arguments.table}: no class that scenario_simulator_v2 has a subtype of")
    configurations: list[Configuration] = []
    lines: list[str] = []
    for subtype in sorted(set(subtype_of.values())):
        codes = [code for code, own in subtype_of.items() if own == subtype]
        chosen = obstacles.only(np.isin(kinds, codes))
        table = averages(pem, chosen, edges_m=edges_m, errors=errors)
        configurations.append(configuration_of(table, subtype=subtype))
        prefix = f"{subtype}: " if len(set(subtype_of.values())) > 1 else ""
        lines += [
            f"{prefix}{line}"
            for line in (
                *unsaid_of_misses(pem, chosen, table),
                *unsaid_of_positions(errors, chosen, table),
                _begin(table),
            )
        ]
    left_out = [CLASS_NAMES[code] for code in obstacles.classes if code not in subtype_of]
    recipe = _recipe(pem, obstacles)
    notes = {"model": pem.name, "data": pem.data, "licence": pem.licence, "averages": recipe}
    if isinstance(errors, BinnedPositionErrors):
        notes["position errors"] = errors.card.data
    elif errors is not None:
        card = errors.card
        notes["position errors"] = f"{card.name}: {card.data}; licence: {card.licence}"
    with writing(arguments.out):
        write_text(arguments.out, noise_yaml(NoiseFile(tuple(configurations), notes)))
    names = ", ".join(one.name for one in configurations)
    print(f"written: {arguments.out}: scenario_simulator_v2's noise, version 4, for {names}")
    return [*lines, *_of_every_file(obstacles, left_out)]


def _recipe(pem: Pem, obstacles: Obstacles) -> str:
    """What averages are over; of a table by distance that it is, what those of its own were."""
    if isinstance(pem, TabulatedPem) and pem.measure == "nearest-point" and (
        obstacles.detected is None
    ):  # fmt: skip
        return pem.card.recipe
    return (
        f"over {obstacles.words}; distances from {obstacles.sensor_ahead_m:g} m behind the sensor"
    )


def _begin(table: Averages) -> str:
    """How an entity's first frames differ, and by how much."""
    rho = float(persistence(1.0 / RATE_HZ, table.memory.tau_s))
    return (
        "an entity begins as reported, without error, and its first frame is never reported: "
        f"{1.0 / RATE_HZ:g} s later it is missed {1.0 - rho:.2g} times as often as P(missed) says, "
        "which pemviz begins with"
    )


def _of_every_file(obstacles: Obstacles, left_out: list[str]) -> Iterator[str]:
    yield (
        f"distances begin {obstacles.sensor_ahead_m:g} m behind the sensor; scenario_simulator_v2 "
        "measures them from base_link, the rear axle (--sensor-ahead-m)"
    )
    yield (
        "what is hidden from the simulator's lidar altogether it does not report (occlusionless: "
        "false); such obstacles are in no table of labels either"
    )
    yield "yaw and yaw_flip are 0: pemviz fits no errors of heading; false positives it has none of"
    others = f"; of no subtype there: {', '.join(left_out)}" if left_out else ""
    yield f"entities of other subtypes are reported without any noise{others}"


def _write_table(
    arguments: ExportArguments,
    pem: Pem,
    obstacles: Obstacles,
    edges_m: tuple[float, ...],
    errors: PositionErrorModel | None,
) -> list[str]:
    """Write the table; gives what it cannot say."""
    if arguments.table is None:
        obstacles = obstacles.at_every_occlusion()
    rows = plain_rows(pem, obstacles, edges_m=edges_m, errors=errors)
    table = averages(pem, obstacles, edges_m=edges_m, errors=errors)
    lines = [*unsaid_of_misses(pem, obstacles, table)]
    document = {
        "model": pem.name,
        "data": pem.data,
        "licence": pem.licence,
        "averages": obstacles.words,
        "distance": DISTANCE.format(ahead=obstacles.sensor_ahead_m),
        "columns": MEANS,
        "cannot_say": lines,
        "rows": rows,
    }
    text = plain_csv(rows)
    if arguments.format == "json":
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    with writing(arguments.out):
        write_text(arguments.out, text)
    print(f"written: {arguments.out}: {len(rows)} rows by class, occlusion and distance")
    print(f"{document['distance']}; {MEANS}")
    return lines
