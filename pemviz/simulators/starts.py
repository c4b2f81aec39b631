"""Scenarios that name the values they start with, so that it can be told which are dangerous."""

from collections.abc import Mapping
from typing import Any, NoReturn, Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import ConfigError
from pemviz.faults import told
from pemviz.simulators.latents import latent_counts
from pemviz.types import Signal

TRIED = 5


@runtime_checkable
class NamesStarts(Protocol):
    """A scenario with latents at the start that says what they mean.

    Any :class:`pemviz.Simulator` may offer it. Results then tell how the starts of violations
    differ from all starts.
    """

    @property
    def starts(self) -> tuple[Signal, ...]:
        """The start values, in the order in which to show them; bounds are those of axes."""
        ...

    @property
    def start_plane(self) -> tuple[str, str]:
        """Names of two of them, across and up, that together tell most of the danger."""
        ...

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Latents ``[N, S]`` to the start values by name, ``[N]`` each.

        They may be derived ones too, such as a closing speed.
        """
        ...


def named_starts(simulator: object) -> NamesStarts | None:
    """What a simulator, or the scenario that it wraps, says of its starts, if anything."""
    found: object = simulator
    while found is not None:
        if isinstance(found, NamesStarts):
            return found
        found = getattr(found, "scenario", None)
    return None


def check_starts(simulator: object, where: str) -> None:
    """Whether names, plane and values fit together.

    Raises:
        ConfigError: One line, which begins with ``where``.
    """
    if not isinstance(simulator, NamesStarts):
        return
    signals: Any = simulator.starts  # whatever the user's code has there
    if not (isinstance(signals, tuple) and signals and all(type(s) is Signal for s in signals)):
        _refuse(f"{where}: starts must be a tuple of one pemviz.Signal at least")
    names = [signal.name for signal in signals]
    for words in (names, [signal.key for signal in signals]):
        if len(set(words)) < len(words) or not all(word.isidentifier() for word in words):
            _refuse(f"{where}: starts: names and keys must be identifiers, each once")
    for signal in signals:
        if not (signal.low < signal.high and np.isfinite([signal.low, signal.high]).all()):
            _refuse(f"{where}: starts: {signal.name}: low must be below high, both finite")
    plane = tuple(simulator.start_plane)
    if len(set(plane)) != 2 or not set(plane) <= set(names):
        _refuse(f"{where}: start_plane = {plane!r}: must be two of {', '.join(names)}")
    _check_values(simulator, names, where)


def _check_values(simulator: NamesStarts, names: list[str], where: str) -> None:
    """Values are finite, one for each rollout, and a rollout's own whatever is beside it."""
    count = latent_counts(simulator).start
    start = np.random.default_rng(2).standard_normal((TRIED, count))
    values = _values(simulator, start, where)
    if set(values) != set(names):
        _refuse(
            f"{where}: start_values gives {', '.join(sorted(values))}: must give "
            f"{', '.join(sorted(names))}"
        )
    backwards = _values(simulator, start[::-1], where)
    for name, one in values.items():
        if np.shape(one) != (TRIED,) or np.asarray(one).dtype != np.float64:
            _refuse(
                f"{where}: start_values: {name} has shape {np.shape(one)}: must be ({TRIED},), "
                "of type float64"
            )
        if not np.isfinite(one).all():
            _refuse(f"{where}: start_values: {name} must be finite numbers")
        if not np.allclose(one, backwards[name][::-1], rtol=1e-9, atol=0.0):
            _refuse(f"{where}: start_values: {name} must not depend on the other rollouts")


def _values(simulator: NamesStarts, start: FloatArray, where: str) -> Mapping[str, FloatArray]:
    try:
        return simulator.start_values(start.copy())
    except ConfigError:  # said in words already
        raise
    except BaseException as error:  # the user's code may raise anything
        message = f"{where}: start_values raises {told(error)}"
        raise ConfigError(message) from error


def _refuse(message: str) -> NoReturn:
    raise ConfigError(message)
