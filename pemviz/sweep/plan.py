"""Which runs a sweep consists of: every combination of settings, with every seed."""

import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_text
from pemviz.errors import ConfigError, InputError
from pemviz.runs.experiment import build_experiment
from pemviz.sweep.fields import Setting, Value, Variation, with_setting

MAXIMUM_RUNS = 100_000
HASH_DIGITS = 10
NAME_LENGTH = 120
VALUE_LENGTH = 24


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Attributes:
        name: Its folder's: readable settings and a hash of the complete configuration.
        config: What is asked of it.
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
    """A sweep's runs.

    Attributes:
        variations: The varied fields, in the order in which they were given.
        runs: Settings in order, the last field fastest; seeds innermost.
    """

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


def make_plan(base: ExperimentConfig, variations: Sequence[Variation], *, seeds: int = 1) -> Plan:
    """The sweep's runs, each checked as far as that goes without simulating.

    Args:
        base: What every run starts from.
        variations: Which fields take which values.
        seeds: Every setting is run with this many seeds, from the base's on.

    Raises:
        InputError: A field is varied twice, there are too many runs, or one of them asks for
            what cannot be.
    """
    _check(variations, seeds=seeds)
    runs: list[PlannedRun] = []
    for values in itertools.product(*(one.values for one in variations)):
        chosen = tuple(zip((one.field for one in variations), values, strict=True))
        config = with_setting(base, chosen)
        setting = tuple((name, value) for name, value in chosen if name != "seed")
        digests = _checked_digests(config, chosen)
        for number in range(seeds):
            seeded = replace(config, seed=config.seed + number)
            seeded.validate()
            name = run_name(seeded, setting)
            runs.append(PlannedRun(name, seeded, setting, *digests))
    return Plan(variations=tuple(variations), runs=tuple(runs))


def run_name(config: ExperimentConfig, setting: Setting) -> str:
    """A folder name: the settings, the seed and a hash of the complete configuration."""
    digest = hashlib.sha256(config_text(config).encode()).hexdigest()[:HASH_DIGITS]
    parts = [f"{name.rpartition('.')[2]}-{_plain(value)}" for name, value in setting]
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


def _plain(value: Value) -> str:
    """A value in characters that every file system takes."""
    text = re.sub(r"[^A-Za-z0-9.+-]+", "-", value_text(value)).strip("-.")
    return text[:VALUE_LENGTH] or "x"


def _check(variations: Sequence[Variation], *, seeds: int) -> None:
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


def _checked_digests(config: ExperimentConfig, chosen: Setting) -> tuple[str, str | None]:
    """Build the experiment, as a run will, and tell which error model and errors it uses."""
    try:
        experiment = build_experiment(config)
        errors = experiment.back_end.position_errors
        return experiment.pem.digest, None if errors is None else errors.digest
    except InputError as error:
        if not chosen:
            raise
        message = f"setting {setting_label(chosen)}: {error}"
        raise ConfigError(message) from error
