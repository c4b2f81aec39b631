"""Simulators by name: those shipped, and those that installed packages register.

A package registers one in its ``pyproject.toml``::

    [project.entry-points."pemviz.simulators"]
    my-simulator = "my_package.simulation:build"

where ``build`` takes a :class:`pemviz.config.ScenarioConfig`, or nothing if it has no use for
one, and returns a :class:`pemviz.types.Simulator`.
"""

import inspect
from collections.abc import Callable
from typing import Any

from pemviz.config import SHIPPED_SIMULATORS, ScenarioConfig
from pemviz.config.entry_points import NamedPart
from pemviz.simulators.braking.measured_gap import RangeErrors
from pemviz.types import Simulator

SHIPPED = SHIPPED_SIMULATORS
SIMULATORS = NamedPart(kind="simulator", group="pemviz.simulators", shipped=SHIPPED)


def simulator_names() -> tuple[str, ...]:
    """Names that :func:`build_named_simulator` knows: shipped ones first, then registered."""
    return SIMULATORS.names()


def build_named_simulator(
    name: str, scenario: ScenarioConfig, *, errors: RangeErrors | None = None
) -> Simulator:
    """The simulator ``name``; a shipped one goes before a registered one of the same name.

    Args:
        name: Shipped or registered.
        scenario: Its parameters.
        errors: Of the gap that a shipped one measures; others take none.

    Raises:
        ConfigError: There is none, two packages register it, or its factory fails or returns
            something else.
    """
    if name == "highway-env":
        from pemviz.simulators.braking.highway import HighwaySimulator  # noqa: PLC0415  pulls in pygame

        return HighwaySimulator(scenario, errors)
    if name == "vectorized":
        from pemviz.simulators.braking.vectorized import VectorizedSimulator  # noqa: PLC0415  as above

        return VectorizedSimulator(scenario, errors)
    return SIMULATORS.registered(
        name,
        made=lambda factory: _called(factory, scenario),
        fits=lambda built: isinstance(built, Simulator) and not isinstance(built, type),
        complaint="returns {}, which is no pemviz.Simulator",
    )


def _called(factory: Callable[..., Any], scenario: ScenarioConfig) -> Any:
    try:
        inspect.signature(factory).bind(scenario)
    except TypeError:
        return factory()
    except ValueError:  # built in, without a signature
        pass
    return factory(scenario)
