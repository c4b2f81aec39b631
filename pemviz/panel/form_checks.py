"""What is wrong with a configuration, at the field of the form that it is about; what it costs."""

import math
import re
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from pemviz.config import SHIPPED_SIMULATORS, ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, start_values
from pemviz.config.settings import SumoConfig
from pemviz.errors import PemvizError
from pemviz.panel.form_fields import BUDGET, RULE, START, method_of, typed_values
from pemviz.pem import load_pem, load_position_errors, shipped_pems
from pemviz.runs.back_ends import SLOW_BATCH_ROLLOUTS, build_back_end
from pemviz.runs.experiment import build_experiment
from pemviz.runs.specification import build_formula
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.folding import declared_signals
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.carla.server import check_installed as check_carla
from pemviz.simulators.registry import build_encounter_simulator
from pemviz.simulators.sumo.engine import check_installed as check_sumo
from pemviz.types import Simulator

Placed = dict[str, str]
"""Sentences by the key of their field; that of none has an empty key."""

EXTRAS: Mapping[str, Callable[[], None]] = {"sumo": check_sumo, "carla": check_carla}
"""Simulators that need what is installed on demand."""
OTHER_NAMES = {
    "spec": RULE,
    "rules": RULE,
    "rule": RULE,
    "tracker": "scenario.tracker",
    "scenario": "encounter.logical_scenario",
    "encounter": "encounter.logical_scenario",
    "sumo": "simulator",
}
"""What messages name, by the field that it is about."""
WHERE = re.compile(
    r"(?P<name>[a-z][\w.-]*)(\[\d+\])?"
    r"( = (?P<shown>'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|[^\s:]*))?: (?P<sentence>.*)",
    re.DOTALL,
)
"""Messages that are about a setting."""
ABOUT = re.compile(r"(?P<name>[a-z][\w.]*) = ")
"""How others begin that say more than its value."""
BYTES_A_STATE = 40
"""Of a rollout that is kept, in memory and on disk."""
LARGE_BYTES, LONG_S = 4e9, 600.0
"""From here on what a run takes is told before it begins."""
MANY = {"vectorized": 200_000}
FEW = 3_000
"""Rollouts from which on it is measured how long one takes: on other simulators from here on."""


def missing_extra(simulator: str) -> str:
    """What has to be installed for a simulator; empty if all is there."""
    try:
        EXTRAS.get(simulator, lambda: None)()
    except PemvizError as error:
        return placed(error)[1]
    return ""


def complaints(config: ExperimentConfig) -> Placed:
    """What is wrong that can be told at once."""
    found = Placed()

    def check(act: Callable[[], object], *, key: str | None = None) -> bool:
        try:
            act()
        except PemvizError as error:
            where, sentence = placed(error)
            found.setdefault(where if key is None else key, sentence)
            return False
        return True

    fits = check(config.validate) and check(lambda: by_name(config.method))
    if config.pem.strip() and config.pem not in shipped_pems():
        check(lambda: load_pem(config.pem), key="pem")
    if config.position_errors is not None:
        check(lambda: load_position_errors(str(config.position_errors)), key="position_errors")
    check(EXTRAS.get(config.simulator, lambda: None))
    if fits and is_quick(config):
        check(lambda: build_formula(config, plain_simulator(config)))
    return found


def whole_complaints(config: ExperimentConfig) -> tuple[Placed, tuple[str, ...]]:
    """What is wrong that only shows once all is built, which takes seconds with some simulators.

    Returns:
        That, or nothing and the scenario's signals with their units.
    """
    try:
        experiment = build_experiment(config)
    except PemvizError as error:
        return dict([placed(error)]), ()
    return {}, signal_words(experiment.declared)


def placed(error: PemvizError) -> tuple[str, str]:
    """The field that a message is about, none if that cannot be told, and what it says."""
    message = " ".join(str(error).split())
    match = WHERE.fullmatch(message)
    if match is None:
        about = ABOUT.match(message)
        known = about is not None and about["name"] in typed_values(ExperimentConfig())
        return (about["name"] if about and known else ""), message
    name, sentence = match["name"], match["sentence"]
    table, _, rest = name.partition(".")
    if table == "rules" and rest:
        return RULE, f"{rest}: {sentence}"
    if name in typed_values(ExperimentConfig()):
        return name, sentence
    key = OTHER_NAMES.get(name, START if table == START else "")
    return key, sentence if key else message


def is_quick(config: ExperimentConfig) -> bool:
    """Whether the scenario is one of those that cost nothing to build."""
    return config.simulator in SHIPPED_SIMULATORS and not config.is_sumo_traffic


def plain_simulator(config: ExperimentConfig) -> Simulator:
    """A shipped scenario, whose signals a specification is about, without what is beside it."""
    plain = replace(scenario_of(config), simulator="vectorized", sumo=SumoConfig())
    return _plain_simulator(plain)


@lru_cache(maxsize=8)
def _plain_simulator(config: ExperimentConfig) -> Simulator:
    if config.encounter.logical_scenario == NO_LOGICAL_SCENARIO:
        return VectorizedSimulator(config.scenario)
    return cast(Simulator, build_encounter_simulator(config))


def facts(config: ExperimentConfig, signals: tuple[str, ...]) -> Placed:
    """What is good to know at a field: what a rule can be about, what is drawn at the start."""
    found = Placed()
    if is_quick(config):
        signals = signal_words(plain_simulator(config))
    if signals:
        found[RULE] = f"Signals: {', '.join(signals)}"
    drawn = [f"{one.name} = {one.distribution}" for one in start_values(config.encounter)]
    if drawn:
        found[START] = f"The scenario's own: {'; '.join(drawn)}"
    return found


def signal_words(simulator: Any) -> tuple[str, ...]:
    """Signals with their units."""
    return tuple(
        f"{signal.name} [{signal.unit}]" if signal.unit else signal.name
        for signal in declared_signals(simulator)
    )


def cost_notes(
    config: ExperimentConfig, *, changed: Collection[str], folder: Path, measure: bool
) -> Placed:
    """What an unusually large run takes, at the field that makes it so.

    Args:
        config: What is to run.
        changed: Fields that were changed, which are the likelier to have made it large.
        folder: Where it would be kept.
        measure: Whether to find out how long a rollout takes, where that is not known.
    """
    method = method_of(config)
    if method is None:
        return {}
    most = method.budget(config).rollouts if method.most is None else method.most(config)
    rollouts = most * config.repetitions
    seconds = math.nan
    if rollouts >= MANY.get(config.simulator, FEW) and config.simulator != "carla":
        seconds = rollouts * _seconds_a_rollout(scenario_of(config), measure=measure)
    kept = rollouts * config.states * BYTES_A_STATE if config.keep == "all" else 0.0
    if kept < LARGE_BYTES and not seconds >= LONG_S:
        return {}
    words = f"{rollouts:,} rollouts take"
    parts = [f"about {_duration(seconds)} to simulate here"] * (seconds >= LONG_S)
    if kept >= LARGE_BYTES:
        there = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        free_gb = shutil.disk_usage(there).free / 1e9
        room = f"about {kept / 1e9:,.0f} GB of memory and disk, of which {free_gb:,.0f} GB are free"
        parts.append(f"{room}, unless only violations are kept (Rollouts kept)")
    return {_largest(config, method, changed): f"{words} {' and '.join(parts)}."}


def _largest(config: ExperimentConfig, method: MethodDescription, changed: Collection[str]) -> str:
    """The field that made a run large."""
    candidates = [n for n in ("repetitions", "max_rollouts", *BUDGET) if n in changed]
    if candidates:
        return max(candidates, key=lambda name: getattr(config, name) or 0)
    if method.most is not None:
        return "max_rollouts"
    return "final_rollouts" if "final_rollouts" in method.settings else "rollouts"


def scenario_of(config: ExperimentConfig) -> ExperimentConfig:
    """The scenario alone, which decides how long a rollout takes."""
    return ExperimentConfig(
        simulator=config.simulator, scenario=config.scenario, encounter=config.encounter,
        start=config.start, sumo=config.sumo,
    )  # fmt: skip


_MEASURED: dict[ExperimentConfig, float] = {}


def _seconds_a_rollout(scenario: ExperimentConfig, *, measure: bool) -> float:
    """How long one of many takes on this machine; NaN where it was not measured."""
    if scenario not in _MEASURED and measure:
        back_end = build_back_end(scenario)
        simulator = back_end.simulator
        count = {"vectorized": 2_000, "sumo": 20}.get(scenario.simulator, 2)
        count = min(count, max(back_end.batch_rollouts, SLOW_BATCH_ROLLOUTS))
        detected = np.zeros((count, simulator.states - 1), dtype=np.bool_)
        replay(simulator=simulator, detected=detected)
        began = time.perf_counter()
        replay(simulator=simulator, detected=detected)
        _MEASURED[scenario] = (time.perf_counter() - began) / count
    return _MEASURED.get(scenario, math.nan)


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.0f} {unit}"
    return f"{seconds / 60.0:.0f} min"
