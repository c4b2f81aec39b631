"""A network's answers to many rows as a plain loop, compiled where numba is there.

The same arithmetic in the same order as :meth:`pemviz.pem.models.network.NetworkPem.logit`, eight
rows at a time (:mod:`pemviz.lanes`), so that both give the same numbers to the last bit. Imported
when it is time to compile: see :mod:`pemviz.pem.models.compiled_network`.
"""

import importlib
import math
from typing import Any

from pemviz.arrays import FloatArray
from pemviz.compiling import inlined, translated, with_numba
from pemviz.lanes import LANES, filled, larger, loaded, memory, store
from pemviz.pem.models.layers import PackedNetwork
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES

WIDE = with_numba(lambda _: importlib.import_module("pemviz.wide_lanes"))
"""Having taught numba what lanes are; ``None`` without numba."""
USED_AS_OF = "e701465d3b0f19be"
"""Of the files of lanes: what numba keeps of this one is made anew when they change."""

KIND, OCCLUSION, POSE = COLUMN["class_id"], COLUMN["occlusion"], COLUMN["x_m"]
KINDS, OCCLUSIONS = len(CLASS_NAMES), len(OCCLUSION_NAMES)


@inlined
def _encode(rows: FloatArray, first: int, mean: FloatArray, std: FloatArray, inputs: Any) -> bool:
    """Eight rows as the paper's inputs ``[14 * 8]``; whether all are ones that models know."""
    count = min(LANES, rows.shape[0] - first)
    for place in range(inputs.size):
        inputs[place] = 0.0
    known = True
    for lane in range(count):
        n, total = first + lane, 0.0
        for column in range(rows.shape[1]):
            total += rows[n, column] - rows[n, column]  # NaN where one is not finite
        kind, occlusion = rows[n, KIND], rows[n, OCCLUSION]
        in_range = 0.0 <= kind < KINDS and 0.0 <= occlusion < OCCLUSIONS
        whole = kind == math.floor(kind) and occlusion == math.floor(occlusion)
        if not (total == 0.0 and in_range and whole):
            known = False
            continue
        inputs[int(kind) * LANES + lane] = 1.0
        inputs[(KINDS + int(occlusion)) * LANES + lane] = 1.0
        for pose in range(mean.size):
            place = (KINDS + OCCLUSIONS + pose) * LANES + lane
            inputs[place] = (rows[n, POSE + pose] - mean[pose]) / std[pose]
    return known


@inlined
def _layer(
    numbers: FloatArray, layer: tuple[int, int, int], before: Any, after: Any, last: bool
) -> int:
    """Eight rows through a layer; where the next one's numbers begin.

    A layer is where its own begin, its units and what each is given. Four units at a time, since a
    sum that waits for the one before it takes four times as long.
    """
    first, units, given = layer
    zero, bias = filled(0.0), first + units * given
    unit = 0
    while unit + 4 <= units:
        w0 = first + unit * given
        w1, w2, w3 = w0 + given, w0 + 2 * given, w0 + 3 * given
        s0, s1, s2, s3 = zero, zero, zero, zero
        for k in range(given):
            eight = loaded(before, k * LANES)
            s0 = s0 + filled(numbers[w0 + k]) * eight
            s1 = s1 + filled(numbers[w1 + k]) * eight
            s2 = s2 + filled(numbers[w2 + k]) * eight
            s3 = s3 + filled(numbers[w3 + k]) * eight
        store(larger(s0 + filled(numbers[bias + unit]), zero), after, unit * LANES)
        store(larger(s1 + filled(numbers[bias + unit + 1]), zero), after, (unit + 1) * LANES)
        store(larger(s2 + filled(numbers[bias + unit + 2]), zero), after, (unit + 2) * LANES)
        store(larger(s3 + filled(numbers[bias + unit + 3]), zero), after, (unit + 3) * LANES)
        unit += 4
    while unit < units:
        total = zero
        for k in range(given):
            eight = loaded(before, k * LANES)
            total = total + filled(numbers[first + unit * given + k]) * eight
        total = total + filled(numbers[bias + unit])
        store(total if last else larger(total, zero), after, unit * LANES)
        unit += 1
    return bias + units


@translated
def answers(
    rows: FloatArray, network: PackedNetwork, buffers: FloatArray, logit: FloatArray
) -> bool:
    """Logits of rows ``[n, 11]`` to ``logit [n + 7]``; whether all are rows that models know.

    Args:
        rows: Salient variables.
        network: Its numbers.
        buffers: ``[2, most units * 8]``, written to.
        logit: Written to; the last 7 may be anything.
    """
    one, other = memory(buffers[0]), memory(buffers[1])
    written, sizes = memory(logit), network.sizes
    inputs = buffers[0, : sizes[0] * LANES]
    for first in range(0, rows.shape[0], LANES):
        if not _encode(rows, first, network.pose_mean, network.pose_std, inputs):
            return False
        begin, before, after = 0, one, other
        for place in range(1, sizes.size):
            layer = (begin, sizes[place], sizes[place - 1])
            begin = _layer(network.numbers, layer, before, after, place == sizes.size - 1)
            before, after = after, before
        store(loaded(before, 0), written, first)
    return True
