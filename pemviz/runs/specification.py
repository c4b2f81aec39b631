"""How rollouts are judged: the specification or its rules, and the metric that ranks them."""

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from pemviz import stl
from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem import Pem
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.folding import Folding, Signals, StepMonitor, declared_signals, folding_of
from pemviz.sampling.problem import Problem, ScoredRule
from pemviz.sampling.rollouts.pooled import losing_here
from pemviz.sampling.rollouts.runners import CompiledRunner
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.slots import turns_of
from pemviz.sampling.zero_variance.unsafe_states import unsafe_states
from pemviz.simulators.latents import latent_counts
from pemviz.simulators.tracking.tracker import tracker_of
from pemviz.types import Signal, Simulator


def build_problem(
    config: ExperimentConfig, formula: stl.Formula, pem: Pem, back_end: BackEnd
) -> Problem:
    """The problem: scenario, error model, and how rollouts are judged."""
    simulator = back_end.simulator
    metric, folding = build_metric(config, simulator), folding_of(simulator)
    turns = 1 if folding is None else folding.turns

    def scored(rule: stl.Formula) -> ScoredRule:
        by_score = isinstance(metric, stl.Classical) and stl.ties_hold(rule)
        monitor = stl.FormulaMonitor(rule)
        return ScoredRule(
            robustness=partial(_robustness, rule, metric, folding),
            violated=None if by_score else partial(_violated, rule, folding),
            monitor=monitor if folding is None else StepMonitor(monitor, turns),
        )

    whole = scored(formula)
    formulas: dict[str | None, stl.Formula] = {None: formula}
    for rule in config.rules:
        formulas[rule.name] = _parsed(rule.formula, simulator, name=f"rules.{rule.name}")
    conjuncts = {name: stl.conjuncts(one) for name, one in formulas.items()}
    return Problem(
        simulator=simulator,
        pem=pem,
        robustness=whole.robustness,
        violated=whole.violated,
        batch_rollouts=back_end.batch_rollouts,
        run_batches=CompiledRunner() if config.lost == "end" else losing_here,
        step_time_limit_s=config.step_time_limit_s,
        unsafe=unsafe_states(formula, turns=turns),
        monitor=whole.monitor,
        turns=turns,
        thins=config.keep == "violations",
        lost=config.lost,
        rules={name: scored(one) for name, one in formulas.items() if name is not None},
        conjuncts={n: [scored(one) for one in some] for n, some in conjuncts.items() if some[1:]},
    )


# functions of the module, so that a problem can be sent to another process
def _robustness(
    formula: stl.Formula, metric: stl.Metric, folding: Folding | None, signals: Signals
) -> FloatArray:
    return stl.robustness(formula, signals if folding is None else folding.signals(signals), metric)


def _violated(formula: stl.Formula, folding: Folding | None, signals: Signals) -> BoolArray:
    return stl.violated(formula, signals if folding is None else folding.signals(signals))


def build_formula(config: ExperimentConfig, simulator: Simulator) -> stl.Formula:
    """The specification, checked against the scenario.

    Raises:
        InputError: It does not parse, names an unknown signal, or looks further ahead than a
            rollout is long.
    """
    for rule in config.rules:  # each by itself, so that messages name it
        _parsed(rule.formula, simulator, name=f"rules.{rule.name}")
    return _parsed(config.spec, simulator, name="spec")


def named_signals(config: ExperimentConfig, signals: Sequence[Signal]) -> tuple[Signal, ...]:
    """The signals that the specification, or its rules, name, in that order; at least the first."""
    formulas = [rule.formula for rule in config.rules] or [config.spec]
    names = [name for one in formulas for name in re.findall(r"[A-Za-z_]\w*", one)]
    by_name = {signal.name: signal for signal in signals}
    return tuple(by_name[n] for n in dict.fromkeys(names) if n in by_name) or (signals[0],)


def robustness_unit(config: ExperimentConfig, signals: Sequence[Signal]) -> str:
    """Of the metric that ranks rollouts; empty where it has none, or signals differ in theirs."""
    units = {signal.unit for signal in named_signals(config, signals)}
    return units.pop() if config.metric != "agm" and len(units) == 1 else ""


def _parsed(text: str, simulator: Simulator, *, name: str) -> stl.Formula:
    try:
        formula = stl.parse(text, signals=[s.name for s in declared_signals(simulator)])
    except stl.FormulaError as error:
        raise ConfigError(f"{name} = {text!r}: {error}") from error
    last = (simulator.states - 1) // turns_of(simulator)
    if formula.horizon_steps() > last:
        raise ConfigError(
            f"{name} = {text!r}: looks {formula.horizon_steps()} steps ahead, but a rollout "
            f"of {simulator.name!r} has {last + 1} states, steps 0 to {last}"
        )
    return formula


def build_metric(
    config: ExperimentConfig, simulator: Simulator, *, beyond: bool | None = None
) -> stl.Metric:
    """The metric that ranks rollouts.

    Args:
        config: The configuration.
        simulator: The scenario.
        beyond: Whether rollouts may leave the bounds that agm normalises by, and values there
            then count as the bound; by default as :func:`may_leave_bounds` says.

    Raises:
        ConfigError: The agm metric's bounds do not hold all that the scenario can reach.
    """
    if config.metric == "agm":
        _check_bounds_hold(simulator)
        bounds = {s.name: (s.low, s.high) for s in declared_signals(simulator)}
        return stl.Agm(bounds, clip=may_leave_bounds(simulator) if beyond is None else beyond)
    if config.metric == "smooth-cumulative":
        return stl.SmoothCumulative(beta=config.smooth_beta_per_m)
    return stl.Classical()


def may_leave_bounds(simulator: object) -> bool:
    """Whether rollouts may go beyond those that are all missed and all detected.

    Latents may carry them further, and so may a tracker, which goes on reporting what perception
    misses again. Robustness only ranks: the bounds stay those that nearly all rollouts keep to.
    """
    return bool(latent_counts(simulator)) or tracker_of(simulator) is not None


def _check_bounds_hold(simulator: Simulator) -> None:
    """Check the signals' bounds on the two extreme rollouts: all errors, and all nominal."""
    outcomes = np.zeros((2, simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    reached = replay(simulator=simulator, detected=outcomes)
    for signal in simulator.signals:
        low, high = float(reached[signal.name].min()), float(reached[signal.name].max())
        if low < signal.low or high > signal.high:
            raise ConfigError(
                f"metric = 'agm': {signal.name} reaches {low:.4g} to {high:.4g} {signal.unit}, "
                f"beyond its bounds {signal.low:g} to {signal.high:g}; raise "
                "scenario.gap_bound_m or scenario.speed_bound_mps (own systems: the signal's)"
            )
