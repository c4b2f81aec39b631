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
    from pemviz.errors import ConfigError, InputError, PemvizError, RunError, UndecidedError
    from pemviz.export.rollouts_table import read_rollouts
    from pemviz.latents import LatentCounts, Latents
    from pemviz.pem import DetectorModel
    from pemviz.proposals.offset_logistic import StateFeatures
    from pemviz.reports.gate import raise_if_undecided
    from pemviz.reports.terminal import summary_text
    from pemviz.runs.engine import run, run_experiment
    from pemviz.runs.experiment import Experiment, build_experiment
    from pemviz.runs.kept_rollout import read_rollout
    from pemviz.runs.observers import KeptStages, LeastRobust, Rollout
    from pemviz.runs.reading import read_result
    from pemviz.runs.replay import Replayed, replay
    from pemviz.runs.result import RunResult
    from pemviz.runs.result_file import result_document
    from pemviz.runs.run_folder import record
    from pemviz.sampling.description import MethodDescription
    from pemviz.sampling.state.component import Known
    from pemviz.sampling.state.hidden import HiddenProperty
    from pemviz.simulators.detector_loop import DetectorEpisodes, DetectorInTheLoop
    from pemviz.simulators.episodic import EpisodicSimulator, side_by_side
    from pemviz.simulators.gymnasium_adapter import (
        GymnasiumEpisodes,
        GymnasiumSimulator,
        GymnasiumSlotEpisodes,
        GymnasiumSlotSimulator,
        named_detections_action,
    )
    from pemviz.simulators.latents import LatentSimulator, NamesStarts
    from pemviz.simulators.quantised import quantised_start
    from pemviz.simulators.scene import (
        DrawsScene,
        DrawsTracks,
        Ramp,
        Road,
        SceneCar,
        SceneStates,
        SceneTracks,
    )
    from pemviz.simulators.slots import Slot, SlotSimulator
    from pemviz.simulators.tracking.filters import AlphaBeta, Kalman
    from pemviz.simulators.tracking.tracked import tracked
    from pemviz.simulators.tracking.tracker import Tracker, TrackerState
    from pemviz.types import Estimate, Proposal, RolloutBatch, Signal, Simulator, StateBatch

_HOMES = {
    "arrays": "BoolArray FloatArray",
    "config": "ExperimentConfig ScenarioConfig",
    "errors": "ConfigError InputError PemvizError RunError UndecidedError",
    "export.rollouts_table": "read_rollouts",
    "latents": "LatentCounts Latents",
    "pem": "DetectorModel",
    "proposals.offset_logistic": "StateFeatures",
    "reports.gate": "raise_if_undecided",
    "reports.terminal": "summary_text",
    "runs.engine": "run run_experiment",
    "runs.experiment": "Experiment build_experiment",
    "runs.observers": "KeptStages LeastRobust Rollout",
    "runs.kept_rollout": "read_rollout",
    "runs.reading": "read_result",
    "runs.replay": "Replayed replay",
    "runs.result": "RunResult",
    "runs.result_file": "result_document",
    "runs.run_folder": "record",
    "sampling.description": "MethodDescription",
    "sampling.state.component": "Known",
    "sampling.state.hidden": "HiddenProperty",
    "simulators.detector_loop": "DetectorEpisodes DetectorInTheLoop",
    "simulators.episodic": "EpisodicSimulator side_by_side",
    "simulators.gymnasium_adapter": (
        "GymnasiumEpisodes GymnasiumSimulator GymnasiumSlotEpisodes GymnasiumSlotSimulator "
        "named_detections_action"
    ),
    "simulators.latents": "LatentSimulator NamesStarts",
    "simulators.quantised": "quantised_start",
    "simulators.scene": "DrawsScene DrawsTracks Ramp Road SceneCar SceneStates SceneTracks",
    "simulators.slots": "Slot SlotSimulator",
    "simulators.tracking.filters": "AlphaBeta Kalman",
    "simulators.tracking.tracked": "tracked",
    "simulators.tracking.tracker": "Tracker TrackerState",
    "types": "Estimate Proposal RolloutBatch Signal Simulator StateBatch",
}
"""Which names, by the module that defines them."""
_MODULES = ("figures", "pem", "quantiles")
"""Those of which pages write ``pemviz.pem.load_pem``."""

__all__ = [
    "AlphaBeta", "BoolArray", "ConfigError", "DetectorEpisodes",
    "DetectorInTheLoop", "DetectorModel", "DrawsScene", "DrawsTracks",
    "EpisodicSimulator", "Estimate", "Experiment", "ExperimentConfig", "FloatArray",
    "GymnasiumEpisodes", "GymnasiumSimulator", "GymnasiumSlotEpisodes", "GymnasiumSlotSimulator",
    "HiddenProperty", "InputError", "Kalman", "KeptStages", "Known", "LatentCounts",
    "LatentSimulator", "Latents", "LeastRobust", "MethodDescription", "NamesStarts", "PemvizError",
    "Proposal", "Ramp", "Replayed", "Road", "Rollout", "RolloutBatch", "RunError", "RunResult",
    "ScenarioConfig", "SceneCar", "SceneStates", "SceneTracks", "Signal", "Simulator",
    "Slot", "SlotSimulator", "StateBatch", "StateFeatures", "Tracker", "TrackerState",
    "UndecidedError", "__version__", "build_experiment", "named_detections_action",
    "quantised_start", "raise_if_undecided", "read_result", "read_rollout", "read_rollouts",
    "record", "replay", "result_document", "run", "run_experiment", "side_by_side",
    "summary_text", "tracked",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """A public name, imported from where it is defined (PEP 562)."""
    for home, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(f"pemviz.{home}"), name)
    if name in _MODULES:
        return import_module(f"pemviz.{name}")
    message = f"module 'pemviz' has no attribute {name!r}"
    raise AttributeError(message)


def __dir__() -> list[str]:
    """What is meant for users."""
    return sorted(__all__)
