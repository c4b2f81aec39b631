"""Simulators by name: those shipped, and those that installed packages register.

A package registers one in its ``pyproject.toml``::

    [project.entry-points."pemviz.simulators"]
    my-simulator = "my_package.simulation:build"

where ``build`` takes a :class:`pemviz.config.ScenarioConfig`, or nothing if it has no use for
one, and returns a :class:`pemviz.types.Simulator`.
"""

import difflib
import inspect
from collections.abc import Callable
from importlib import metadata
from typing import Any

from pemviz.config import SHIPPED_SIMULATORS, ScenarioConfig
from pemviz.errors import ConfigError
from pemviz.types import Simulator

GROUP = "pemviz.simulators"
SHIPPED = SHIPPED_SIMULATORS


def simulator_names() -> tuple[str, ...]:
    """Names that :func:`build_named_simulator` knows: shipped ones first, then registered."""
    registered = sorted({point.name for point in metadata.entry_points(group=GROUP)} - {*SHIPPED})
    return (*SHIPPED, *registered)


def build_named_simulator(name: str, scenario: ScenarioConfig) -> Simulator:
    """The simulator ``name``; a shipped one goes before a registered one of the same name.

    Raises:
        ConfigError: There is none, two packages register it, or its factory fails or returns
            something else.
    """
    if name == "highway-env":
        from pemviz.simulators.braking.highway import HighwaySimulator  # noqa: PLC0415  pulls in pygame

        return HighwaySimulator(scenario)
    if name == "vectorized":
        from pemviz.simulators.braking.vectorized import VectorizedSimulator  # noqa: PLC0415  as above

        return VectorizedSimulator(scenario)
    return _registered(name, scenario)


def _registered(name: str, scenario: ScenarioConfig) -> Simulator:
    found = {point.value: point for point in metadata.entry_points(group=GROUP, name=name)}
    if not found:
        raise ConfigError(_unknown(name))
    if len(found) > 1:
        message = f"simulator = {name!r}: registered more than once, as {' and '.join(found)}"
        raise ConfigError(message)
    (point,) = found.values()
    try:
        built = _called(point.load(), scenario)
        is_simulator = isinstance(built, Simulator)
    except Exception as error:  # code of another package may raise anything
        message = f"simulator = {name!r}: {point.value} raises {type(error).__name__}: {error}"
        raise ConfigError(" ".join(message.split())) from error
    if not is_simulator or isinstance(built, type):
        message = (
            f"simulator = {name!r}: {point.value} returns {_described(built)}, which is no "
            "pemviz.Simulator"
        )
        raise ConfigError(message)
    return built


def _called(factory: Callable[..., Any], scenario: ScenarioConfig) -> Any:
    try:
        inspect.signature(factory).bind(scenario)
    except TypeError:
        return factory()
    except ValueError:  # built in, without a signature
        pass
    return factory(scenario)


def _described(built: object) -> str:
    if isinstance(built, type):
        return f"the class {built.__name__}"
    return "nothing" if built is None else f"a value of type {type(built).__name__}"


def _unknown(name: str) -> str:
    names = simulator_names()
    near = difflib.get_close_matches(name, names, n=1)
    guess = f"did you mean {near[0]}? There" if near else "there"
    return f"simulator = {name!r}: no such simulator; {guess} are: {', '.join(names)}"
