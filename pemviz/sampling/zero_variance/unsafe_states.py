"""Specifications that single states decide: ``always (predicate on the state)``."""

import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz import stl
from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.signal_bounds import SignalBounds, signals_reached, tells_reached
from pemviz.stl.formulas import Always, And, Constant, Formula, Or, Predicate, Signal
from pemviz.stl.metric import evaluate
from pemviz.stl.verdict import BOOLEAN
from pemviz.types import Simulator, StateBatch


@dataclass(frozen=True)
class StateRule:
    """From step ``first`` to step ``last`` the state must satisfy ``predicate``."""

    first: int
    last: int
    predicate: Formula

    def broken(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Which states with signals ``[N]`` violate the predicate.

        Raises:
            InputError: A number is not finite, or becomes so.
        """
        found = [signals.get(name) for name in self._named]
        finite = all(
            v is not None and v.dtype == np.float64 and np.isfinite(v).all() for v in found
        )
        if not (self._compares_numbers and finite):  # the whole evaluation tells what is wrong
            return stl.violated(self.predicate, {name: v[:, None] for name, v in signals.items()})
        # of a formula without signals the others say how many states there are
        single = {name: signals[name][None] for name in self._named or signals}
        return evaluate(self.predicate, BOOLEAN, single)[0] < 0.0

    @cached_property
    def _named(self) -> frozenset[str]:
        return self.predicate.signals()

    @cached_property
    def _compares_numbers(self) -> bool:
        """Whether all that it compares is signals with numbers."""
        return all(
            isinstance(predicate.left, Signal) and isinstance(predicate.right, Constant)
            for predicate in self.predicate.walk()
            if isinstance(predicate, Predicate)
        )


@dataclass(frozen=True)
class UnsafeStates:
    """Which states violate a specification by themselves.

    Attributes:
        rules: All must hold.
        turns: Outcomes of a step; states between them count as steps of their own.
    """

    rules: tuple[StateRule, ...]
    turns: int = 1

    @property
    def last(self) -> int:
        """The last step at which a state can become unsafe."""
        return self.turns * max(rule.last for rule in self.rules)

    def __call__(self, states: StateBatch) -> BoolArray:
        """Whether states ``[N]``, all of one step, break a rule ``[N]``."""
        step = int(states.step) // self.turns
        due = [rule for rule in self.rules if rule.first <= step <= rule.last]
        if due:
            return functools.reduce(operator.or_, (one.broken(states.signals) for one in due))
        like = next(iter(states.signals.values()))
        return np.zeros(like.shape, dtype=np.bool)

    def possible(self, bounds: SignalBounds, *, after: int) -> BoolArray | bool:
        """Whether signals that stay within bounds ``[N]`` can break a rule after step ``after``.

        True unless the bounds rule it out.
        """
        later = [rule for rule in self.rules if self.turns * rule.last > after]
        return functools.reduce(
            np.logical_or, (_breakable(rule.predicate, bounds) for rule in later), False
        )

    def certain(self, reached: Callable[[int], SignalBounds], *, after: int) -> BoolArray | bool:
        """Whether signals break a rule after step ``after``, whatever they do beyond ``reached``.

        That maps a number of steps to what signals reach at some of as many next states: at one at
        most the first value, at one at least the second, ``[N]`` or one for all. False where it is
        not known.
        """
        result: BoolArray | bool = False
        for rule in self.rules:
            if self.turns * rule.first <= after + 1 <= self.turns * rule.last:
                farthest = reached(self.turns * rule.last - after)
                result = np.logical_or(result, _surely_broken(rule.predicate, farthest))
        return result


def _breakable(predicate: Formula, bounds: SignalBounds) -> BoolArray | bool:
    """Whether signals within bounds ``[N]`` may violate a predicate; True if that is not known."""
    match predicate:
        case And(parts=parts):
            return functools.reduce(np.logical_or, (_breakable(part, bounds) for part in parts))
        case Or(parts=parts):
            return functools.reduce(np.logical_and, (_breakable(part, bounds) for part in parts))
        case Predicate(left=Signal(name=name), right=Constant(value=value)) if name in bounds:
            nearest = bounds[name][0 if predicate.is_lower_bound else 1]
            return _fails(predicate, nearest, value)
        case _:
            return True


def _surely_broken(predicate: Formula, reached: SignalBounds) -> BoolArray | bool:
    """Whether signals that reach values ``[N]``, each at some state, violate a predicate at one."""
    match predicate:
        case And(parts=parts):
            return functools.reduce(
                np.logical_or, (_surely_broken(part, reached) for part in parts)
            )
        case Predicate(left=Signal(name=name), right=Constant(value=value)) if name in reached:
            farthest = reached[name][0 if predicate.is_lower_bound else 1]
            return _fails(predicate, farthest, value)
        case _:  # of an Or, all parts must be broken at one state
            return False


def _fails(predicate: Predicate, value: FloatArray | float, bound: float) -> BoolArray | bool:
    """Whether a signal of such values violates the predicate that compares it with ``bound``."""
    if predicate.is_lower_bound:
        return value <= bound if predicate.is_strict else value < bound
    return value >= bound if predicate.is_strict else value > bound


def unsafe_states(formula: Formula, *, turns: int = 1) -> UnsafeStates | None:
    """The states that violate ``formula``; ``None`` where single states do not decide it.

    Within reach are ``always`` over a formula without temporal operators, nested ``always``,
    and conjunctions of these. A rollout violates the formula if and only if one of its states
    breaks a rule. The formula is over steps with as many outcomes as ``turns``.
    """
    rules = _rules(formula)
    return None if rules is None else UnsafeStates(rules, turns)


def is_of_single_states(text: str) -> bool:
    """Whether a formula's text has :func:`unsafe_states`; not of text that is none."""
    try:
        return _rules(stl.parse(text)) is not None
    except stl.FormulaError:
        return False


def _rules(formula: Formula) -> tuple[StateRule, ...] | None:
    if formula.horizon_steps() == 0 and not any(isinstance(p, Always) for p in formula.walk()):
        return (StateRule(0, 0, formula),)
    if isinstance(formula, And):
        rules: tuple[StateRule, ...] = ()
        for part in formula.parts:
            inner = _rules(part)
            if inner is None:
                return None
            rules += inner
        return rules
    if isinstance(formula, Always):
        inner = _rules(formula.operand)
        if inner is None:
            return None
        return tuple(
            StateRule(formula.first + rule.first, formula.last + rule.last, rule.predicate)
            for rule in inner
        )
    return None


@dataclass(frozen=True)
class CertainViolation:
    """Which states violate later for certain, as far as the twin tells of its signals."""

    twin: Simulator
    unsafe: UnsafeStates

    def __call__(self, states: StateBatch) -> BoolArray:
        """Whether all sequences of outcomes lead from states ``[N]`` of a step to unsafe ones."""
        after = int(states.step)

        def reached(steps: int) -> SignalBounds:
            left = self.twin.states - 1 - after
            return signals_reached(self.twin, states, steps=min(steps, left))

        return np.broadcast_to(self.unsafe.certain(reached, after=after), states.shape)


def certain_violation(twin: Simulator, unsafe: object) -> CertainViolation | None:
    """What tells it; ``None`` where nothing is known."""
    if isinstance(unsafe, UnsafeStates) and tells_reached(twin):
        return CertainViolation(twin, unsafe)
    return None
