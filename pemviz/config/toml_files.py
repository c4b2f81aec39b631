"""Configurations as TOML: presets, the user's files, and the copy in every run folder."""

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, cast

import tomli_w

from pemviz.config import BLACK_BOXES, ExperimentConfig, ScenarioConfig
from pemviz.config.encounters import LOGICAL_SCENARIOS, StartChoice
from pemviz.config.ranges import did_you_mean
from pemviz.config.records import read_record, read_value
from pemviz.config.settings import SumoConfig
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.errors import ConfigError
from pemviz.files.shipped import asset_path

LARGEST_BYTES = 1_000_000
"""A configuration has a kilobyte; no more than this is read of what is given as one."""
GONE = {"device": "cpu"}
"""Settings of earlier versions, with the one value that means what there is now."""
DEEPEST_KEY = 200
"""Dots in a key; tomllib's time grows with the square of their number."""
FREE_TRAFFIC = "free-traffic"
"""The preset that has the rules of all traffic in SUMO."""
OWN_MEMORY = ("memory_s", "frailty", "varying_frailty", "varying_frailty_s")
"""Left out, the error model's own."""
_TOO_DEEP = "nested too deeply"


def preset_names(*, logical_scenarios: bool = True) -> tuple[str, ...]:
    """Names of the shipped presets, those of other scenarios than the braking one after the others.

    Args:
        logical_scenarios: Whether to name those, of logical scenarios and of black boxes.
    """
    names = {path.stem for path in asset_path("presets").glob("*.toml")}
    others = (*LOGICAL_SCENARIOS, *BLACK_BOXES, FREE_TRAFFIC)
    return (*sorted(names - set(others)), *(others if logical_scenarios else ()))


def with_own_rules(config: ExperimentConfig) -> ExperimentConfig:
    """A black box without rules or a specification of its own has its preset's rules."""
    is_specified = config.rules or config.spec != ExperimentConfig().spec
    preset = FREE_TRAFFIC if config.is_sumo_traffic else config.simulator
    if preset not in (*BLACK_BOXES, FREE_TRAFFIC) or is_specified:
        return config
    return config.with_rules({rule.name: rule.formula for rule in load_preset(preset).rules})


def load_preset(name: str) -> ExperimentConfig:
    """The shipped preset ``name``.

    Raises:
        ConfigError: There is no such preset.
    """
    if name not in preset_names():
        names = preset_names()
        raise ConfigError(
            f"preset = {name!r}: must be one of {', '.join(names)}{did_you_mean(name, names)}"
        )
    return load_config(asset_path("presets", f"{name}.toml"))


def preset_words(name: str) -> str:
    """What a shipped preset is: how its file begins, without what is for those who read code."""
    with asset_path("presets", f"{name}.toml").open(encoding="utf-8") as lines:
        about = [line[1:].strip() for line in takewhile(lambda line: line.startswith("#"), lines)]
    return " ".join(line for line in about if "`" not in line)


def load_config(path: Path) -> ExperimentConfig:
    """Read and validate a TOML file; what it leaves out keeps its default.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or holds an unknown field or a
            value that is out of range.
    """
    try:
        config = config_from_table(read_table(path))
        config.validate()
    except ConfigError as error:
        raise ConfigError(f"config {path}: {error}") from error
    return config


def read_table(path: Path, *, kind: str = "configuration") -> dict[str, Any]:
    """The values of a file that is a ``kind``.

    Raises:
        ConfigError: It cannot be read, or is no TOML; the message does not name the file.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES + 1)
        if len(content) > LARGEST_BYTES:
            raise ConfigError(f"must be a {kind} of at most {LARGEST_BYTES} bytes")
        text = content.decode("utf-8").replace("\r\n", "\n")
        if any(line.partition("=")[0].count(".") > DEEPEST_KEY for line in text.split("\n")):
            raise ConfigError(_TOO_DEEP)
        return tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror or error})") from error
    except ValueError as error:  # also of numbers with more digits than Python reads
        raise ConfigError(f"not valid TOML ({error})") from error
    except RecursionError as error:
        raise ConfigError(_TOO_DEEP) from error


def config_from_table(table: object, *, name: str = "") -> ExperimentConfig:
    """The configuration that a table of plain values spells out.

    ``rules`` is a table of names and formulas; ``spec`` may then be left out. ``start`` is one of
    names and distributions.

    Args:
        table: What :func:`config_table` gives, or a part of it.
        name: What the table is called, for messages.

    Raises:
        ConfigError: A field is unknown or of the wrong type.
    """
    if not isinstance(table, Mapping):
        return read_record(ExperimentConfig, table, name=name)
    given = cast(Mapping[str, Any], table)
    others = {key: value for key, value in given.items() if GONE.get(key, ...) != value}
    named = {key: _named_texts(others.pop(key, None), key, name) for key in ("rules", "start")}
    start = tuple(StartChoice(*choice) for choice in named["start"].items())
    config = read_record(ExperimentConfig, others, name=name).with_rules(named["rules"])
    return replace(config, spec=others.get("spec", config.spec), start=start)


def _named_texts(given: object, key: str, name: str) -> Mapping[str, str]:
    """A table of texts by name; empty where it is left out."""
    if given is None:
        return {}
    place = f"{name}.{key}" if name else key
    if key == "start" and isinstance(given, Mapping):  # a number fixes a start value
        named = cast(Mapping[str, object], given)
        given = {name: str(v) if type(v) in (int, float) else v for name, v in named.items()}
    texts: Mapping[str, str] = read_value(Mapping[str, str], given, name=place)
    if not texts:
        one = "rule" if key == "rules" else "start value"
        raise ConfigError(f"{place} = {{}}: must name one {one} at least")
    return texts


def config_table(config: ExperimentConfig) -> dict[str, Any]:
    """Every field as plain values, for TOML and JSON.

    Without rules, position errors, surrogate, server, tracker, logical scenario, SUMO's model and
    encounters an hour where there are none, without the braking scenario where it is another that
    is run and nothing of it was changed, without a memory that is left out or not assumed, its law
    where that is of outcomes, without ``measured_memory`` where it is looked at, and without
    ``keep`` where all is kept.
    """
    table = every_setting(config)
    for name in ("position_errors", "surrogate", "carla", "encounters_per_hour", *OWN_MEMORY):
        if table[name] is None:
            del table[name]
    usual = {"assumed_memory_s": 0.0, "memory_law": "outcomes", "measured_memory": True}
    for name in [name for name, value in usual.items() if table[name] == value]:
        del table[name]
    if config.scenario.tracker == NO_TRACKER:
        del table["scenario"]["tracker"]
    if not config.is_encounter:
        del table["encounter"]
    if config.is_encounter and config.scenario.tracker == NO_TRACKER:
        del table["scenario"]
    elif config.is_encounter:
        table["scenario"] = {"tracker": config.scenario.tracker}
    elif not config.is_braking_scenario and config.scenario == ScenarioConfig():
        del table["scenario"]
    if config.keep == "all":
        del table["keep"]
    is_used = config.simulator == "sumo" and not config.is_braking_scenario
    if not is_used and config.sumo == SumoConfig():
        del table["sumo"]
    elif config.sumo.config is None:
        table["sumo"] = {"model": config.sumo.model}
    return table


def every_setting(config: ExperimentConfig) -> dict[str, Any]:
    """Every field as plain values, those that files leave out as well; rules by name, if any."""
    table = asdict(config)
    del table["rules"], table["start"]
    if config.rules:
        table["rules"] = {rule.name: rule.formula for rule in config.rules}
    if config.start:
        table["start"] = {choice.name: choice.distribution for choice in config.start}
    return table


def config_text(config: ExperimentConfig) -> str:
    """Every field as TOML that :func:`load_config` reads back to an equal configuration."""
    # TOML has no null: what is not set is left out
    set_values = {n: value for n, value in config_table(config).items() if value is not None}
    return tomli_w.dumps(set_values)
