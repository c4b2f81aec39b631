"""How likely is a rare violation of a perception-driven controller, and why.

The names below are what testing a system of one's own takes; ``examples/own_system.py`` shows
them at work. They are imported when first used, so that ``import pemviz`` takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pemviz._version import __version__

if TYPE_CHECKING:
    from pemviz.arrays import BoolArray, FloatArray
    from pemviz.config import ExperimentConfig, ScenarioConfig
    from pemviz.errors import ConfigError, InputError, PemvizError, RunError
    from pemviz.latents import LatentCounts, Latents
    from pemviz.pem import DetectorModel
    from pemviz.proposals.offset_logistic import StateFeatures
    from pemviz.reports.terminal import summary_text
    from pemviz.runs.engine import run, run_experiment
    from pemviz.runs.experiment import Experiment, build_experiment
    from pemviz.runs.observers import KeptStages, LeastRobust, Rollout
    from pemviz.runs.reading import read_result
    from pemviz.runs.result import RunResult
    from pemviz.runs.store import RunStore
    from pemviz.sampling.description import MethodDescription
    from pemviz.sampling.state.hidden import HiddenProperty, Known
    from pemviz.simulators.episodic import EpisodicSimulator, side_by_side
    from pemviz.simulators.gymnasium_adapter import GymnasiumSimulator, GymnasiumSlotSimulator
    from pemviz.simulators.gymnasium_episodes import (
        GymnasiumEpisodes,
        GymnasiumSlotEpisodes,
        named_detections_action,
    )
    from pemviz.simulators.latents import LatentSimulator
    from pemviz.simulators.quantised import quantised_start
    from pemviz.simulators.scene import (
        DrawsScene,
        DrawsTracks,
        Road,
        SceneCar,
        SceneStates,
        SceneTracks,
    )
    from pemviz.simulators.slots import Slot, SlotSimulator
    from pemviz.simulators.starts import NamesStarts
    from pemviz.simulators.tracking.filters import AlphaBeta, Kalman
    from pemviz.simulators.tracking.tracked import tracked
    from pemviz.simulators.tracking.tracker import Tracker, TrackerState
    from pemviz.types import Estimate, Proposal, RolloutBatch, Signal, Simulator, StateBatch

_HOMES = {
    "AlphaBeta": "simulators.tracking.filters",
    "BoolArray": "arrays",
    "ConfigError": "errors",
    "DetectorModel": "pem",
    "DrawsScene": "simulators.scene",
    "DrawsTracks": "simulators.scene",
    "EpisodicSimulator": "simulators.episodic",
    "Estimate": "types",
    "Experiment": "runs.experiment",
    "ExperimentConfig": "config",
    "FloatArray": "arrays",
    "GymnasiumEpisodes": "simulators.gymnasium_episodes",
    "GymnasiumSimulator": "simulators.gymnasium_adapter",
    "GymnasiumSlotEpisodes": "simulators.gymnasium_episodes",
    "GymnasiumSlotSimulator": "simulators.gymnasium_adapter",
    "HiddenProperty": "sampling.state.hidden",
    "InputError": "errors",
    "Kalman": "simulators.tracking.filters",
    "KeptStages": "runs.observers",
    "Known": "sampling.state.hidden",
    "LatentCounts": "latents",
    "LatentSimulator": "simulators.latents",
    "Latents": "latents",
    "LeastRobust": "runs.observers",
    "MethodDescription": "sampling.description",
    "NamesStarts": "simulators.starts",
    "PemvizError": "errors",
    "Proposal": "types",
    "Road": "simulators.scene",
    "Rollout": "runs.observers",
    "RolloutBatch": "types",
    "RunError": "errors",
    "RunResult": "runs.result",
    "RunStore": "runs.store",
    "ScenarioConfig": "config",
    "SceneCar": "simulators.scene",
    "SceneStates": "simulators.scene",
    "SceneTracks": "simulators.scene",
    "Signal": "types",
    "Simulator": "types",
    "Slot": "simulators.slots",
    "SlotSimulator": "simulators.slots",
    "StateBatch": "types",
    "StateFeatures": "proposals.offset_logistic",
    "Tracker": "simulators.tracking.tracker",
    "TrackerState": "simulators.tracking.tracker",
    "build_experiment": "runs.experiment",
    "named_detections_action": "simulators.gymnasium_episodes",
    "quantised_start": "simulators.quantised",
    "read_result": "runs.reading",
    "run": "runs.engine",
    "run_experiment": "runs.engine",
    "side_by_side": "simulators.episodic",
    "summary_text": "reports.terminal",
    "tracked": "simulators.tracking.tracked",
}

__all__ = [
    "AlphaBeta",
    "BoolArray",
    "ConfigError",
    "DetectorModel",
    "DrawsScene",
    "DrawsTracks",
    "EpisodicSimulator",
    "Estimate",
    "Experiment",
    "ExperimentConfig",
    "FloatArray",
    "GymnasiumEpisodes",
    "GymnasiumSimulator",
    "GymnasiumSlotEpisodes",
    "GymnasiumSlotSimulator",
    "HiddenProperty",
    "InputError",
    "Kalman",
    "KeptStages",
    "Known",
    "LatentCounts",
    "LatentSimulator",
    "Latents",
    "LeastRobust",
    "MethodDescription",
    "NamesStarts",
    "PemvizError",
    "Proposal",
    "Road",
    "Rollout",
    "RolloutBatch",
    "RunError",
    "RunResult",
    "RunStore",
    "ScenarioConfig",
    "SceneCar",
    "SceneStates",
    "SceneTracks",
    "Signal",
    "Simulator",
    "Slot",
    "SlotSimulator",
    "StateBatch",
    "StateFeatures",
    "Tracker",
    "TrackerState",
    "__version__",
    "build_experiment",
    "named_detections_action",
    "quantised_start",
    "read_result",
    "run",
    "run_experiment",
    "side_by_side",
    "summary_text",
    "tracked",
]


def __getattr__(name: str) -> Any:
    """A public name, imported from where it is defined (PEP 562)."""
    home = _HOMES.get(name)
    if home is None:
        message = f"module 'pemviz' has no attribute {name!r}"
        raise AttributeError(message)
    return getattr(import_module(f"pemviz.{home}"), name)


def __dir__() -> list[str]:
    """Everything importable from here."""
    return sorted({*globals(), *__all__})
