"""What was run, in words: the scenario, the budget, what was kept."""

from dataclasses import fields

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.runs.result import LEAST_ROBUST
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.registry import by_name

BUDGET_FIELDS = frozenset({"stages", "rollouts", "final_rollouts"})


def scenario_text(config: ExperimentConfig) -> str:
    """What differs from the defaults, the first figures in any case."""
    if not config.is_braking_scenario:
        return config.other_scenario
    scenario, default = config.scenario, ScenarioConfig()
    shown = (
        f"{scenario.initial_speed_kmh:g} km/h, {scenario.initial_gap_m:g} m behind a lead car "
        f"that brakes at {scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}"
    )
    named = {"initial_speed_kmh", "initial_gap_m", "lead_deceleration_mps2"}
    others = [
        f"{field.name} {value if isinstance(value, str) else f'{value:g}'}"
        for field in fields(scenario)
        if field.name not in named
        and (value := getattr(scenario, field.name)) != getattr(default, field.name)
    ]
    return "; ".join([shown, *others])


def budget_text(config: ExperimentConfig) -> str:
    """What one repetition simulates, the method's other settings, and how many repetitions."""
    method = by_name(config.method)
    settings = [
        f"{field.name} {_setting(config, field.name, method)}"
        for field in fields(config)
        if field.name in method.settings - BUDGET_FIELDS
    ]
    repetitions = [f"{config.repetitions} repetitions"] if config.repetitions > 1 else []
    return ", ".join([method.budget(config).words, *settings, *repetitions])


def _setting(config: ExperimentConfig, name: str, method: MethodDescription) -> object:
    value = getattr(config, name)
    if name == "alpha" and value is None:
        return "chosen at each stage" if method.alpha is None else method.alpha
    return value


def kept_text(config: ExperimentConfig) -> str:
    """Which rollouts its files hold; empty where all of them."""
    if config.keep != "violations":
        return ""
    return (
        f"violations, and the {LEAST_ROBUST} least robust of each final stage; learning stages "
        "whole, large ones in part"
    )
