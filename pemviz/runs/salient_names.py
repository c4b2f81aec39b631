"""Does a simulator give an error model what that was fitted to?

A model of features of one's own is asked about them by their places; that these are what the
simulator gives there, its attribute ``salient_names`` says.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import ConfigError
from pemviz.pem import Pem, own_features_of
from pemviz.simulators.latents import parts_of


def check_salient_names(named: Pem | Mapping[str, Pem], simulator: object) -> None:
    """Whether the simulator gives each model what it sees, by name and in its order.

    Raises:
        ConfigError: It does not, or does not say.
    """
    for pem in named.values() if isinstance(named, Mapping) else (named,):
        own = own_features_of(pem)
        if own is None:
            continue
        given = _salient_names(simulator)
        wanted = ", ".join(own.names)
        who = f"pem = {pem.name!r} sees {wanted}"
        name = getattr(simulator, "name", type(simulator).__name__)
        if given is None:
            raise ConfigError(
                f"{who}: simulator {name!r} must say that its salient variables are these, by an "
                f"attribute salient_names = {own.names!r}"
            )
        if given != own.names:
            raise ConfigError(f"{who}, in this order: simulator {name!r} gives {', '.join(given)}")


def _salient_names(simulator: Any) -> tuple[str, ...] | None:
    """What a simulator, or one that is wrapped in it, calls its salient variables."""
    said = (getattr(part, "salient_names", None) for part in parts_of(simulator))
    names = next((names for names in said if names is not None), None)
    return None if names is None else tuple(str(name) for name in names)


def outside_training(pem: Pem, salient: FloatArray) -> Iterator[str]:
    """Where what a simulator gives ``[..., D]`` leaves the model's training data, in words."""
    own = own_features_of(pem)
    if own is not None:
        for line in own.beyond(np.asarray(salient)):
            yield f"error model {pem.name}: {line}"
