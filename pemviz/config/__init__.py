"""The configuration of a run, with units and ranges, and how it is written as TOML."""

from pemviz.config.encounters import LOGICAL_SCENARIOS, EncounterConfig, StartChoice
from pemviz.config.settings import (
    BLACK_BOXES,
    CLIENTS,
    LIMITS,
    METHODS,
    SHIPPED_SIMULATORS,
    WITHOUT_EFFECT,
    ExperimentConfig,
    KeepName,
    LostName,
    MethodName,
    MetricName,
    Rule,
    ScenarioConfig,
)

__all__ = [
    "BLACK_BOXES",
    "CLIENTS",
    "LIMITS",
    "LOGICAL_SCENARIOS",
    "METHODS",
    "SHIPPED_SIMULATORS",
    "WITHOUT_EFFECT",
    "EncounterConfig",
    "ExperimentConfig",
    "KeepName",
    "LostName",
    "MethodName",
    "MetricName",
    "Rule",
    "ScenarioConfig",
    "StartChoice",
]
