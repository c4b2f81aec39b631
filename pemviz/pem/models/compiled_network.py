"""When networks are asked through the compiled loop, and what they hand to it."""

import importlib
from functools import cache
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.compiling import LoadedInTime, is_installed, is_translated
from pemviz.lanes import LANES
from pemviz.pem.models.encoding import paper_inputs
from pemviz.pem.models.layers import Layer, PackedNetwork, forward, packed

FIRST_BY_NUMPY = 12_000_000
"""Rows, each about a quarter of a microsecond, after which importing numba is likely to pay."""
FIRST_WHERE_LOADED = 200_000
"""The same where numba has been imported: what is compiled is read in some 20 ms."""
TRIED_ROWS = 19
"""On which the loop must give what numpy gives."""


def by_loop(rows: FloatArray, network: PackedNetwork, loops: Any) -> FloatArray | None:
    """Logits ``[n]`` of rows ``[n, 11]``; ``None`` where one is none that models know."""
    buffers = np.empty((2, int(network.sizes.max()) * LANES))
    found = np.empty(len(rows) + LANES - 1)
    return found[: len(rows)] if loops.answers(rows, network, buffers, found) else None


@cache
def compiled_network() -> Any:
    """The module with the loop, compiled.

    ``None`` without numba, or where numpy rounds otherwise, as it does on processors for which its
    own build multiplies and adds at once.
    """
    if not is_installed():
        return None
    loops = importlib.import_module("pemviz.pem.models.network_loops")
    usable = loops.WIDE is not None and is_translated(loops.answers)
    return loops if usable and _is_as_numpy(loops) else None


def _is_as_numpy(loops: Any) -> bool:
    """Whether an arbitrary network's answers are the same to the last bit."""
    generator = np.random.default_rng(0)
    layers = tuple(
        Layer(generator.normal(size=shape), generator.normal(size=shape[0]))
        for shape in ((20, 14), (20, 20), (1, 20))
    )
    rows = generator.normal(size=(TRIED_ROWS, 11))
    rows[:, [0, 2]] = generator.integers(0, 3, (TRIED_ROWS, 2))
    pose_mean, pose_std = generator.normal(size=4), generator.uniform(1.0, 2.0, 4)
    found = by_loop(rows, packed(pose_mean, pose_std, layers), loops)
    inputs = paper_inputs(rows, pose_mean=pose_mean, pose_std=pose_std, multiple=LANES)
    return found is not None and np.array_equal(found, forward(layers, inputs)[:TRIED_ROWS])


ROWS_ASKED = LoadedInTime(compiled_network, FIRST_BY_NUMPY, FIRST_WHERE_LOADED)
"""By how many distinct rows networks were asked about."""
