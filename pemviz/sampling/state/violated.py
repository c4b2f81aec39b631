"""Whether there has been a violation, as part of a system's state.

A proposal that makes violations likely must know when there has been one: from then on nothing is
to be gained, and leaving the error model only spreads the weights.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.sampling.state.component import Component, Known, ModelLogit
from pemviz.types import VIOLATED, StateBatch, tells_violation, violated_rule

MONITOR = "what a monitor knows"
"""Beside states: of the way that led to them."""


@dataclass(frozen=True)
class Violated(Component):
    """Remembers violations where single states decide them.

    Attributes:
        unsafe: States ``[N]`` to whether being in them is a violation.
    """

    unsafe: Callable[[StateBatch], BoolArray]

    def owns(self, memory: str) -> bool:
        """Whether there has been one."""
        return tells_violation(memory)

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:  # noqa: ARG002  states alone tell
        """Whether the initial states violate."""
        return self._known(states, np.zeros(states.shape, dtype=np.bool_))

    def next(
        self,
        before: StateBatch,
        detected: BoolArray,  # noqa: ARG002  as above
        states: StateBatch,
        model: ModelLogit,  # noqa: ARG002
    ) -> Known:
        """A violation stays."""
        return self._known(states, before.memory[VIOLATED])

    def _known(self, states: StateBatch, before: BoolArray) -> Known:
        return Known({}, {VIOLATED: before | self.unsafe(states)})


class Monitor(Protocol):
    """Follows rollouts state by state, and tells which have violated whatever comes next."""

    def start(self, *, count: int) -> Any:
        """What is known of ``count`` rollouts before their first state."""
        ...

    def advance(self, known: Any, *, step: int, signals: Mapping[str, FloatArray]) -> Any:
        """What is known with the states of ``step`` too, signals ``[N]``; changes nothing."""
        ...

    def violated(self, known: Any) -> BoolArray:
        """Which rollouts violate the specification for certain, ``[N]``."""
        ...


@dataclass(frozen=True)
class EachRule:
    """A monitor of several rules, violated once all are broken, that tells of each.

    Attributes:
        monitors: By the rules' names; at least one.
    """

    monitors: Mapping[str, Monitor]

    def start(self, *, count: int) -> Mapping[str, Any]:
        """What is known of ``count`` rollouts before their first state, by rule."""
        return {rule: one.start(count=count) for rule, one in self.monitors.items()}

    def advance(
        self, known: Mapping[str, Any], *, step: int, signals: Mapping[str, FloatArray]
    ) -> Mapping[str, Any]:
        """What is known with the states of ``step`` too, signals ``[N]``, by rule."""
        return {
            rule: one.advance(known[rule], step=step, signals=signals)
            for rule, one in self.monitors.items()
        }

    def violated(self, known: Mapping[str, Any]) -> BoolArray:
        """Which rollouts break every rule for certain, ``[N]``."""
        return np.all(list(self.broken(known).values()), axis=0)

    def broken(self, known: Mapping[str, Any]) -> Mapping[str, BoolArray]:
        """Which break each rule for certain, ``[N]`` by the memory's name."""
        return {
            violated_rule(rule): one.violated(known[rule]) for rule, one in self.monitors.items()
        }


@dataclass(frozen=True)
class Monitored(Component):
    """Remembers violations, likewise, where it takes a monitor of the states so far to tell them.

    Of several rules it also remembers each (:class:`EachRule`). What the monitor knows is beside
    the states: they continue rollouts that the system began itself.

    Attributes:
        monitor: What tells them.
    """

    monitor: Monitor

    def owns(self, memory: str) -> bool:
        """Whether there has been one, and of which rule."""
        return tells_violation(memory)

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:  # noqa: ARG002  as above
        """Whether the initial states violate."""
        return self._known(states, self.monitor.start(count=states.shape[0]))

    def next(
        self,
        before: StateBatch,
        detected: BoolArray,  # noqa: ARG002  as above
        states: StateBatch,
        model: ModelLogit,  # noqa: ARG002
    ) -> Known:
        """A violation stays.

        Raises:
            TypeError: The states are not such that the monitor led to.
        """
        if MONITOR not in before.beside:
            message = "a monitored system goes on from its own states only"
            raise TypeError(message)
        return self._known(states, before.beside[MONITOR])

    def _known(self, states: StateBatch, before: Any) -> Known:
        known = self.monitor.advance(before, step=int(states.step), signals=states.signals)
        each = self.monitor.broken(known) if isinstance(self.monitor, EachRule) else {}
        return Known({}, {**each, VIOLATED: self.monitor.violated(known)}, {MONITOR: known})
