"""From a configuration to the parts of an experiment."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz import stl
from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem import Pem, PemEnsemble, ensemble_of, load_pem
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.proposals.simple import ConstantProposal, PemProposal
from pemviz.sampling.adaptive import AdaptiveSampling
from pemviz.sampling.direct import DirectSampling
from pemviz.sampling.final_batch import largest_part
from pemviz.sampling.method import Method
from pemviz.sampling.mixture import MixtureSampling
from pemviz.sampling.problem import BATCH_ROLLOUTS, Problem
from pemviz.sampling.rollout import replay
from pemviz.sampling.splitting import SplittingSampling
from pemviz.sampling.value_specification import unsafe_states
from pemviz.sampling.value_twisted import ValueTwistedSampling, require_unsafe
from pemviz.simulators.braking_features import BrakingFeatures
from pemviz.simulators.vectorized import VectorizedSimulator
from pemviz.types import Simulator

SLOW_BATCH_ROLLOUTS = 50


@dataclass(frozen=True)
class Experiment:
    """The parts that a run puts together.

    Attributes:
        config: What was asked, validated.
        pem: The perception error model.
        ensemble: Models that its training data could as well have produced, if there are any.
        formula: The specification.
        problem: What is to be estimated.
        twin: A fast simulator of the same scenario, for the reference and the data's bound.
        method: How.
        features: What the scenario's states offer to look at.
        planned_rollouts: How many rollouts all repetitions take together.
    """

    config: ExperimentConfig
    pem: Pem
    ensemble: PemEnsemble | None
    formula: stl.Formula
    problem: Problem
    twin: Simulator
    method: Method[Any]
    features: StateFeatures
    planned_rollouts: int

    @property
    def has_likelihood_ratios(self) -> bool:
        """Whether rollouts carry weights; splitting's particles are cut and copied instead."""
        return self.config.method != "splitting"


def build_experiment(config: ExperimentConfig) -> Experiment:
    """Validate ``config`` and build everything it names; nothing is simulated.

    Raises:
        InputError: A value is out of range, the specification does not parse or fit the
            scenario, or the perception error model cannot be loaded.
    """
    config.validate()
    simulator = build_simulator(config)
    formula = build_formula(config, simulator)
    pem = load_pem(config.pem)
    metric = build_metric(config, simulator)

    def robustness(signals: Mapping[str, FloatArray]) -> FloatArray:
        return stl.robustness(formula, signals, metric)

    def violated(signals: Mapping[str, FloatArray]) -> BoolArray:
        return stl.violated(formula, signals)

    problem = Problem(
        simulator=simulator,
        pem_logit=pem.logit,
        robustness=robustness,
        violated=violated,
        batch_rollouts=(
            SLOW_BATCH_ROLLOUTS
            if config.simulator == "highway-env"
            else min(BATCH_ROLLOUTS, largest_part(states=config.scenario.states))
        ),
        batch_time_limit_s=config.batch_time_limit_s,
        unsafe=unsafe_states(formula),
    )
    if config.reference or config.method == "value-twisted":
        require_unsafe(problem)
    return Experiment(
        config=config,
        pem=pem,
        ensemble=ensemble_of(config.pem),
        formula=formula,
        problem=problem,
        twin=VectorizedSimulator(config.scenario),
        method=build_method(config),
        features=BrakingFeatures(config.scenario),
        planned_rollouts=config.repetitions * rollouts_per_repetition(config),
    )


def build_simulator(config: ExperimentConfig) -> Simulator:
    """The back end that ``config`` names."""
    if config.simulator == "highway-env":
        from pemviz.simulators.highway import HighwaySimulator  # noqa: PLC0415  pulls in pygame

        return HighwaySimulator(config.scenario)
    return VectorizedSimulator(config.scenario)


def build_formula(config: ExperimentConfig, simulator: Simulator) -> stl.Formula:
    """The specification, checked against the scenario.

    Raises:
        InputError: It does not parse, names an unknown signal, or looks further ahead than a
            rollout is long.
    """
    try:
        formula = stl.parse(config.spec, signals=[signal.name for signal in simulator.signals])
    except stl.FormulaError as error:
        message = f"spec = {config.spec!r}: {error}"
        raise ConfigError(message) from error
    last = simulator.states - 1
    if formula.horizon_steps() > last:
        message = (
            f"spec = {config.spec!r}: looks {formula.horizon_steps()} steps ahead, but a rollout "
            f"of scenario.states = {simulator.states} states has only steps 0 to {last}"
        )
        raise ConfigError(message)
    return formula


def build_metric(config: ExperimentConfig, simulator: Simulator) -> stl.Metric:
    """The metric that ranks rollouts.

    Raises:
        ConfigError: The agm metric's bounds do not hold all that the scenario can reach.
    """
    if config.metric == "agm":
        check_bounds_hold(simulator)
        return stl.Agm(bounds={s.name: (s.low, s.high) for s in simulator.signals})
    if config.metric == "smooth-cumulative":
        return stl.SmoothCumulative(beta=config.smooth_beta_per_m)
    return stl.Classical()


def check_bounds_hold(simulator: Simulator) -> None:
    """Check the signals' bounds on the two extreme rollouts, all missed and all detected.

    Raises:
        ConfigError: One of them leaves the bounds.
    """
    outcomes = np.zeros((2, simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    reached = replay(simulator=simulator, detected=outcomes)
    for signal in simulator.signals:
        low, high = float(reached[signal.name].min()), float(reached[signal.name].max())
        if low < signal.low or high > signal.high:
            message = (
                f"metric = 'agm': {signal.name} reaches {low:.4g} to {high:.4g} {signal.unit}, "
                f"beyond its bounds {signal.low:g} to {signal.high:g}; raise "
                "scenario.gap_bound_m or scenario.speed_bound_mps"
            )
            raise ConfigError(message)


def build_method(config: ExperimentConfig) -> Method[Any]:
    """The method that ``config`` names."""
    most = largest_part(states=config.scenario.states)
    if config.method == "adaptive":
        return AdaptiveSampling(
            learning_stages=config.stages,
            rollouts=config.rollouts,
            final_rollouts=config.final_rollouts,
            sigma=config.sigma,
            alpha=config.alpha,
            epochs=config.epochs,
            learning_rate=config.learning_rate,
            seed=config.seed,
            largest_part=most,
        )
    if config.method == "value-twisted":
        return ValueTwistedSampling(
            twin=VectorizedSimulator(config.scenario),
            rollouts=config.final_rollouts,
            seed=config.seed,
            largest_part=most,
        )
    if config.method == "mixture":
        return MixtureSampling(
            learning_stages=config.stages,
            rollouts=config.rollouts,
            final_rollouts=config.final_rollouts,
            seed=config.seed,
            features=BrakingFeatures(config.scenario),
            largest_part=most,
        )
    if config.method == "splitting":
        return SplittingSampling(stages=config.stages, rollouts=config.rollouts, seed=config.seed)
    proposal = (
        PemProposal()
        if config.method == "monte-carlo"
        else ConstantProposal(detection_probability=config.naive_detection_probability)
    )
    return DirectSampling(
        name=config.method,
        proposal=proposal,
        rollouts=config.final_rollouts,
        seed=config.seed,
        largest_part=most,
    )


def rollouts_per_repetition(config: ExperimentConfig) -> int:
    """How many rollouts one repetition simulates."""
    if config.method in ("adaptive", "mixture"):
        return (config.stages + 1) * config.rollouts + config.final_rollouts
    if config.method == "splitting":  # particles that are cut and continued come on top
        return config.stages * config.rollouts
    return config.final_rollouts
