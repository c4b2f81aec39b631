"""Steps of an environment that were made before, so that none is made twice.

Methods that go on from kept states ask for the same step again and again: splitting's importance
function carries every state on to the end with the same few sequences of outcomes.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray

TRIED = 500
"""So many steps that are known are made again all the same: an environment that does not do the
same from the same numbers is to be seen as it is, by the check of simulators and by runs."""


class KeptSteps:
    """Where outcomes led from states given as numbers; beyond ``most``, the oldest are forgotten.

    An environment that is once found to lead elsewhere has its steps made anew from then on. What
    is sent to another process arrives empty.
    """

    def __init__(self, most: int) -> None:
        """Prepare for so many steps; 0 keeps none."""
        self._most = most
        self._tried = 0
        self._found: OrderedDict[bytes, FloatArray] = OrderedDict()

    def reached(
        self, state: FloatArray, outcome: Any, make: Callable[[], FloatArray]
    ) -> FloatArray:
        """Where a step leads, as numbers ``[R]``.

        Args:
            state: From where, numbers ``[S]``; another last bit is another state.
            outcome: What perception told.
            make: Makes the step.
        """
        if self._most == 0:
            return make()
        told = hashlib.blake2b(state.tobytes(), digest_size=16)
        told.update(repr(outcome).encode())
        key = told.digest()
        known = self._found.get(key)
        if known is not None and self._tried >= TRIED:
            self._found.move_to_end(key)
            return known
        fresh = make()
        if known is not None:
            self._tried += 1
            if not np.array_equal(known, fresh):
                self._most = 0
                self._found.clear()
                return fresh
        self._found[key] = fresh
        if len(self._found) > self._most:
            self._found.popitem(last=False)
        return fresh

    def __getstate__(self) -> dict[str, Any]:
        """Without what was found."""
        return {"_most": self._most, "_tried": 0, "_found": OrderedDict()}
