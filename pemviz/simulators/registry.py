"""Simulators by name: those shipped, and those that installed packages register.

A package registers one in its ``pyproject.toml``::

    [project.entry-points."pemviz.simulators"]
    my-simulator = "my_package.simulation:build"

where ``build`` takes a :class:`pemviz.config.ScenarioConfig`, or nothing if it has no use for
one, and returns a :class:`pemviz.types.Simulator`. A class serves too, such as a dataclass: it is
handed the scenario if its first argument is called ``scenario``, is annotated so or has no default.
"""

import inspect
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from pemviz.config import (
    BLACK_BOXES,
    CLIENTS,
    SHIPPED_SIMULATORS,
    ExperimentConfig,
    ScenarioConfig,
)
from pemviz.config.ranges import NamedPart
from pemviz.config.settings import DEFAULT_ADDRESS, SumoConfig
from pemviz.errors import ConfigError
from pemviz.simulators.measurement_errors import PositionErrors
from pemviz.types import Simulator

if TYPE_CHECKING:
    from pemviz.simulators.encounters.vectorized import VectorizedEncounters

SHIPPED = SHIPPED_SIMULATORS
SIMULATORS = NamedPart(
    kind="simulator", group="pemviz.simulators", shipped=(*SHIPPED, *BLACK_BOXES, *CLIENTS)
)


def simulator_names() -> tuple[str, ...]:
    """Names that :func:`build_named_simulator` knows: shipped ones first, then registered."""
    return SIMULATORS.names()


def build_named_simulator(  # noqa: PLR0911 (one case per simulator)
    name: str,
    scenario: ScenarioConfig,
    *,
    errors: PositionErrors | None = None,
    carla: str | None = None,
    sumo: SumoConfig | None = None,
) -> Simulator:
    """The simulator ``name``; a shipped one goes before a registered one of the same name.

    Args:
        name: Shipped or registered.
        scenario: Its parameters.
        errors: Of the gap that a shipped one measures; others take none.
        carla: Where simulator carla finds its server, ``HOST:PORT``.
        sumo: Names traffic of SUMO's own, in place of the scenario.

    Raises:
        ConfigError: There is none, two packages register it, or its factory fails or returns
            something else.
    """
    if name == "highway-env":
        from pemviz.simulators.braking.highway import HighwaySimulator  # noqa: PLC0415  pulls in pygame

        return HighwaySimulator(scenario, errors)
    if name == "merge":
        from pemviz.simulators.merge.scenario import MergeSimulator  # noqa: PLC0415  as above

        return MergeSimulator(scenario)
    if name == "sumo" and sumo is not None and sumo.config is not None:
        from pemviz.simulators.sumo.traffic.simulator import build_traffic  # noqa: PLC0415  scipy

        return build_traffic(sumo, scenario)
    if name == "sumo":
        from pemviz.simulators.sumo.engine import check_installed  # noqa: PLC0415  as above
        from pemviz.simulators.sumo.scenarios import SumoBraking  # noqa: PLC0415

        check_installed()
        return SumoBraking(scenario, errors)
    if name == "vectorized":
        from pemviz.simulators.braking.vectorized import VectorizedSimulator  # noqa: PLC0415  as above

        return VectorizedSimulator(scenario, errors)
    if name == "carla":
        from pemviz.simulators.carla.server import braking_on_carla  # noqa: PLC0415  as above
        from pemviz.simulators.episodic import SideBySide  # noqa: PLC0415

        return SideBySide(make=partial(braking_on_carla, scenario, carla or DEFAULT_ADDRESS))
    return SIMULATORS.registered(
        name,
        made=lambda factory: _made(factory, scenario),
        fits=lambda built: isinstance(built, Simulator) and not isinstance(built, type),
        complaint="returns {}, which is no pemviz.Simulator",
    )


def build_encounter_simulator(
    config: ExperimentConfig, *, errors: PositionErrors | None = None
) -> "VectorizedEncounters":
    """The back end of the logical scenario that ``config`` names, with errors of places.

    Raises:
        ConfigError: It has none of that name, or a start value's distribution cannot be.
    """
    own = (config.encounter, config.start, config.scenario.tracker, errors)
    if config.simulator == "highway-env":
        from pemviz.simulators.encounters.highway import HighwayEncounters  # noqa: PLC0415  as below

        return HighwayEncounters(*own)
    from pemviz.simulators.encounters.vectorized import VectorizedEncounters  # noqa: PLC0415  scipy

    if config.simulator == "sumo":
        from pemviz.simulators.sumo.engine import check_installed  # noqa: PLC0415  as below
        from pemviz.simulators.sumo.scenarios import SumoEncounters  # noqa: PLC0415

        check_installed()
        return SumoEncounters(*own, sumo=config.sumo)
    if config.simulator != "vectorized":
        allowed = f"{', '.join(SHIPPED)} with a logical scenario"
        message = f"simulator = {config.simulator!r}: must be {allowed}"
        raise ConfigError(message)
    return VectorizedEncounters(*own)


def _made(factory: Callable[..., Any], scenario: ScenarioConfig) -> Any:
    """What the factory makes; of an environment that is reset and stepped each process its own."""
    from pemviz.simulators.episodic import EpisodicSimulator, side_by_side  # noqa: PLC0415  slow

    made = _called(factory, scenario)
    steps = isinstance(made, EpisodicSimulator) and not isinstance(made, type)
    if steps and not hasattr(made, "initial"):
        return side_by_side(partial(_called, factory, scenario))
    return made


def _called(factory: Callable[..., Any], scenario: ScenarioConfig) -> Any:
    """What the factory makes: of the scenario, unless all that it takes has defaults of its own."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except ValueError:  # built in, without a signature
        return factory(scenario)
    taken = [
        one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)
    ]
    if not taken:
        takes_scenario = any(one.kind is one.VAR_POSITIONAL for one in parameters)
    else:
        first = taken[0]
        asked = first.name == "scenario" or "ScenarioConfig" in str(first.annotation)
        takes_scenario = asked or first.default is first.empty
    return factory(scenario) if takes_scenario else factory()
