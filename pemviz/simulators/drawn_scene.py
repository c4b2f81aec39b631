"""What views draw of a simulator: the scene that it offers, or that of a gap and two speeds."""

from typing import Any

from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import DRAWN_SIGNALS, FollowedCar
from pemviz.simulators.latents import within
from pemviz.simulators.scene import DrawsScene
from pemviz.simulators.slots import SlotSimulator


def drawn_scene(simulator: Any) -> DrawsScene | None:
    """Where a simulator's cars are.

    Returns:
        The scene of the simulator, or of the one that it wraps; without any, that of one car
        behind another where it has their gap and speeds; else ``None``.
    """
    offered = within(simulator, DrawsScene)
    names = {signal.name for signal in simulator.signals}
    if offered is not None or isinstance(simulator, SlotSimulator) or not names >= DRAWN_SIGNALS:
        return offered
    part, config = simulator, None
    while part is not None and not isinstance(config, ScenarioConfig):
        config, part = getattr(part, "config", None), getattr(part, "scenario", None)
    if not isinstance(config, ScenarioConfig):
        return FollowedCar(simulator.dt_s)
    return FollowedCar(simulator.dt_s, config.lead_length_m, config.emergency_gap_m)
