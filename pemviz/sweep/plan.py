"""Which runs a sweep consists of: fields and their values, every combination, every seed."""

import difflib
import hashlib
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

from pemviz.config import ExperimentConfig
from pemviz.config.ranges import allows_none, check_value, optional_value
from pemviz.config.settings import conjunction
from pemviz.config.toml_files import config_text
from pemviz.config.tracker_text import GRID_BEGINS, tracker_grid
from pemviz.errors import ConfigError, InputError
from pemviz.runs.experiment import build_experiment

Value = str | int | float | bool | None
Setting = tuple[tuple[str, Value], ...]

BRACKETS = {"(": ")", "[": "]"}
TRUTH = {"true": True, "false": False}
MAXIMUM_RUNS = 100_000
RULE = "rule"
"""Varied as if it were a field: runs that are of one rule each."""
TRACKER = "scenario.tracker"
HASH_DIGITS = 10
NAME_LENGTH = 120
VALUE_LENGTH = 24


@dataclass(frozen=True)
class Variation:
    """A field by its dotted name, such as ``scenario.initial_gap_m``, and its values."""

    field: str
    values: tuple[Value, ...]


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Attributes:
        name: Its folder's: readable settings and a hash of the complete configuration.
        setting: The varied fields with their values, the seed aside.
        pem_digest: SHA-256 of the error model that it shall use.
        position_digest: The same of the position errors; ``None`` without.
    """

    name: str
    config: ExperimentConfig
    setting: Setting
    pem_digest: str
    position_digest: str | None = None

    @property
    def label(self) -> str:
        """The run in a few words, for people."""
        return f"{setting_label(self.setting)}, seed {self.config.seed}".removeprefix(", ")


@dataclass(frozen=True)
class Plan:
    """A sweep's runs: settings in order, the last field fastest; seeds innermost."""

    variations: tuple[Variation, ...]
    runs: tuple[PlannedRun, ...]

    @property
    def fields(self) -> tuple[str, ...]:
        """The varied fields' names, the seed aside: it stands in every run anyway."""
        return tuple(one.field for one in self.variations if one.field != "seed")

    @property
    def digest(self) -> str:
        """Tells this plan from others: the same runs in the same order."""
        names = "\n".join(run.name for run in self.runs)
        return hashlib.sha256(names.encode()).hexdigest()[:HASH_DIGITS]


def make_plan(
    base: ExperimentConfig,
    variations: Sequence[Variation],
    *,
    seeds: int = 1,
    allow_python: bool = False,
) -> Plan:
    """The sweep's runs, each checked as far as that goes without simulating.

    Args:
        base: What every run starts from.
        variations: Which fields take which values.
        seeds: Every setting is run with this many seeds, from the base's on.
        allow_python: Whether an error model may be ``module:attribute``, whose code then runs.

    Raises:
        InputError: A field is varied twice, there are too many runs, or one of them asks for
            what cannot be.
    """
    names = [one.field for one in variations]
    for name in names:
        if names.count(name) > 1:
            message = f"vary {name}: given twice; list all its values after one --vary"
            raise ConfigError(message)
    if "seed" in names and seeds > 1:
        message = f"vary seed and seeds = {seeds}: give only one of them"
        raise ConfigError(message)
    count = math.prod(len(one.values) for one in variations) * seeds
    if count > MAXIMUM_RUNS:
        message = f"vary: asks for {count} runs; at most {MAXIMUM_RUNS} are allowed"
        raise ConfigError(message)
    runs: list[PlannedRun] = []
    for values in itertools.product(*(one.values for one in variations)):
        chosen = tuple(zip(names, values, strict=True))
        config = base
        for name, value in chosen:
            if name == RULE:
                config = _with_rule(config, str(value))
            else:
                config = _replaced(config, name.split("."), value)
        setting = tuple((name, value) for name, value in chosen if name != "seed")
        digests = _checked_digests(config, chosen, allow_python=allow_python)
        for number in range(seeds):
            seeded = replace(config, seed=config.seed + number)
            seeded.validate()
            runs.append(PlannedRun(run_name(seeded, setting), seeded, setting, *digests))
    return Plan(variations=tuple(variations), runs=tuple(runs))


def _replaced(instance: Any, path: list[str], value: Value) -> Any:
    name, *below = path
    inner = _replaced(getattr(instance, name), below, value) if below else value
    return replace(instance, **{name: inner})


def _with_rule(config: ExperimentConfig, name: str) -> ExperimentConfig:
    """The same of one of its rules alone: its proposals and its budget are then for this rule."""
    rules = tuple(rule for rule in config.rules if rule.name == name)
    if not rules:
        known = ", ".join(rule.name for rule in config.rules) or "none"
        message = f"rule {name!r}: the configuration has no such rule; it has {known}"
        raise ConfigError(message)
    return replace(config, rules=rules, spec=conjunction(rules))


def _checked_digests(
    config: ExperimentConfig, chosen: Setting, *, allow_python: bool
) -> tuple[str, str | None]:
    """Build the experiment, as a run will, and tell which error model and errors it uses."""
    try:
        experiment = build_experiment(config, allow_python=allow_python)
    except InputError as error:
        if not chosen:
            raise
        message = f"setting {setting_label(chosen)}: {error}"
        raise ConfigError(message) from error
    errors = experiment.back_end.position_errors
    return experiment.pem.digest, None if errors is None else errors.digest


def run_name(config: ExperimentConfig, setting: Setting) -> str:
    """A folder name: the settings, the seed and a hash of the complete configuration."""
    digest = hashlib.sha256(config_text(config).encode()).hexdigest()[:HASH_DIGITS]
    parts: list[str] = []
    for name, value in setting:  # in characters that every file system takes
        text = re.sub(r"[^A-Za-z0-9.+-]+", "-", value_text(value)).strip("-.")
        parts.append(f"{name.rpartition('.')[2]}-{text[:VALUE_LENGTH] or 'x'}")
    readable = "_".join([*parts, f"seed-{config.seed}"])
    return f"{readable[:NAME_LENGTH]}_{digest}"


def setting_label(setting: Setting) -> str:
    """Settings in a few words, for people."""
    return ", ".join(f"{name} {value_text(value)}" for name, value in setting)


def value_text(value: Value) -> str:
    """A value as configuration files have it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


@cache
def field_annotations() -> Mapping[str, object]:
    """Annotation by dotted name of every field of a configuration that holds one value."""
    return {**_annotations(ExperimentConfig, prefix=""), RULE: str}


def _annotations(kind: Any, *, prefix: str) -> dict[str, object]:
    hints = get_type_hints(kind, include_extras=True)
    found: dict[str, object] = {}
    for field in fields(kind):
        annotation = hints[field.name]
        if is_dataclass(annotation):
            found |= _annotations(annotation, prefix=f"{prefix}{field.name}.")
        elif get_origin(annotation) is not tuple:  # rules and start values have names
            found[f"{prefix}{field.name}"] = annotation
    return found


def value_type(annotation: object) -> type | None:
    """``bool``, ``int``, ``float`` or ``str``; ``None`` for a choice of texts."""
    inner = optional_value(annotation)
    base = get_args(inner)[0] if get_origin(inner) is Annotated else inner
    return base if isinstance(base, type) else None


def parse_variation(text: str) -> Variation:
    """The field and values of ``FIELD=V1,V2,...``.

    A comma inside brackets or double quotes is part of a value. ``tracker`` takes a grid, too, as
    :func:`~pemviz.config.tracker_text.tracker_grid` reads it.

    Raises:
        ConfigError: There is no such field, or a value is not allowed in it.
    """
    name, equals, listed = text.partition("=")
    name = name.strip().replace("-", "_")
    if not equals or not name:
        message = f"vary {text!r}: must be FIELD=VALUE,VALUE,..."
        raise ConfigError(message)
    if name in ("tracker", TRACKER):
        name = TRACKER
        if listed.strip().startswith(GRID_BEGINS):
            return Variation(field=name, values=tracker_grid(listed.strip()))
    if name not in field_annotations():
        raise ConfigError(_unknown(name, list(field_annotations())))
    annotation = field_annotations()[name]
    inner, kind = optional_value(annotation), value_type(annotation)
    values: list[Value] = []
    for one in split_values(listed, where=f"vary {name}"):
        value: Value = None
        if not (allows_none(annotation) and one.lower() == "none"):
            checked = check_value(
                name=f"vary {name}", value=_converted(one, kind), annotation=inner
            )
            value = cast(Value, checked)
        if value in values:
            message = f"vary {name}: {one} is given twice"
            raise ConfigError(message)
        values.append(value)
    return Variation(field=name, values=tuple(values))


def split_values(listed: str, *, where: str) -> list[str]:
    """A list's values, split at commas outside brackets and double quotes.

    Raises:
        ConfigError: A value is empty, or brackets or quotes do not close.
    """
    values = [""]
    closing: list[str] = []
    for character in listed:
        if closing and character == closing[-1]:
            closing.pop()
        elif character == '"' and not closing:
            closing.append('"')
        elif character in BRACKETS and '"' not in closing:
            closing.append(BRACKETS[character])
        elif character == "," and not closing:
            values.append("")
            continue
        values[-1] += character
    if closing:
        message = f"{where}: a {closing[-1]} is missing in {listed!r}"
        raise ConfigError(message)
    stripped = [_unquoted(value.strip()) for value in values]
    if "" in stripped:
        message = f"{where}: a value is empty in {listed!r}"
        raise ConfigError(message)
    return stripped


def _unquoted(text: str) -> str:
    quoted = len(text) >= 2 and text[0] == text[-1] == '"' and '"' not in text[1:-1]
    return text[1:-1] if quoted else text


def _unknown(name: str, known: list[str]) -> str:
    below = [one for one in known if one.startswith(f"{name}.")]
    if below:
        return f"vary {name}: is a table; vary one of its fields, such as {below[0]}"
    by_last_part = {one.rpartition(".")[2]: one for one in known}
    near = difflib.get_close_matches(name, [*known, *by_last_part], n=1)
    if near:
        return f"vary {name}: no such field; did you mean {by_last_part.get(near[0], near[0])}?"
    return f"vary {name}: no such field; allowed are {', '.join(known)}"


def _converted(text: str, kind: type | None) -> Value:
    """``text`` as ``kind``, or as it is where it cannot be read so."""
    if kind is bool:
        return TRUTH.get(text.lower(), text)
    if kind not in (int, float):
        return text
    try:
        if kind is int and not any(mark in text.lower() for mark in ".e"):
            return int(text)
        number = float(text)
    except ValueError:
        return text
    return int(number) if kind is int and number.is_integer() else number
