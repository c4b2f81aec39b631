"""What views draw of a simulator: the scene that it tells of, or that of a gap and two speeds."""

from typing import Any

from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import DRAWN_SIGNALS, FollowedCar
from pemviz.simulators.scene import DrawsScene, DrawsTracks
from pemviz.simulators.slots import SlotSimulator


def drawn_scene(simulator: Any) -> DrawsScene | None:
    """Where a simulator's cars are.

    Returns:
        The scene of the simulator, or of the one that it wraps; without any, that of one car
        behind another where it has their gap and speeds; else ``None``.
    """
    inwards = _inwards(simulator)
    told = next((one for one in inwards if isinstance(one, DrawsScene)), None)
    names = {signal.name for signal in simulator.signals}
    if told is not None or isinstance(simulator, SlotSimulator) or not names >= DRAWN_SIGNALS:
        return told
    configs = (getattr(one, "config", None) for one in inwards)
    config = next((one for one in configs if isinstance(one, ScenarioConfig)), None)
    if config is None:
        return FollowedCar(simulator.dt_s)
    return FollowedCar(simulator.dt_s, config.lead_length_m, config.emergency_gap_m)


def drawn_tracks(simulator: Any) -> DrawsTracks | None:
    """A simulator, or the one that it wraps, if it tells where it believes cars to be."""
    return next((one for one in _inwards(simulator) if isinstance(one, DrawsTracks)), None)


def _inwards(simulator: Any) -> list[Any]:
    """A simulator, the one that it wraps as ``scenario``, and so on."""
    layers: list[Any] = []
    while simulator is not None:
        layers.append(simulator)
        simulator = getattr(simulator, "scenario", None)
    return layers
