"""How many rollouts of a simulator a surrogate saves, where it is right and where it is not.

The braking scenario stands for a simulator that is slow, since its answer is known by recursion
over all its states; surrogates are the same scenario with other numbers.
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import pemviz
from pemviz import Estimate, ExperimentConfig, ScenarioConfig
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.zero_variance.reference import exact_log_probability
from pemviz.simulators.braking.vectorized import VectorizedSimulator

Change = Callable[[ScenarioConfig], ScenarioConfig]
SURROGATES: Mapping[str, Change | None] = {
    "none": None,
    "right": lambda scenario: scenario,
    "brakes 20 % too strong": lambda scenario: replace(
        scenario, emergency_deceleration_mps2=1.2 * scenario.emergency_deceleration_mps2
    ),
    "brakes 20 % too weak": lambda scenario: replace(
        scenario, emergency_deceleration_mps2=0.8 * scenario.emergency_deceleration_mps2
    ),
    "the car ahead brakes 0.5 s later": lambda scenario: replace(
        scenario, lead_brake_time_s=scenario.lead_brake_time_s + 0.5
    ),
    "never fails": lambda scenario: replace(scenario, lead_deceleration_mps2=0.1),
}


@dataclass(frozen=True, kw_only=True)
class SurrogateStudy:
    """How many rollouts of a simulator a surrogate saves, and whether answers hold.

    The median number of rollouts of runs that ask for the default precision, and how many of their
    95 % intervals hold the answer, which is known by recursion; warned ones apart.
    """

    seeds: int = 20
    """Runs of each case."""


@dataclass(frozen=True)
class Row:
    """What came of a case.

    Attributes:
        name: Of the surrogate.
        rollouts: Of the simulator itself, each run's.
        ratios: Of its answer to the exact one.
        held: Intervals that nothing warns of and that hold it.
        warned: Runs whose interval is none.
    """

    name: str
    rollouts: Sequence[int]
    ratios: Sequence[float]
    held: int
    warned: int


def run_surrogates(study: SurrogateStudy) -> list[Row]:
    """Carry out all cases."""
    return [_case(name, change, seeds=study.seeds) for name, change in SURROGATES.items()]


def _case(name: str, change: Change | None, *, seeds: int) -> Row:
    found, exact = list[Estimate](), 0.0
    for seed in range(seeds):
        config = ExperimentConfig(seed=seed, measured_memory=False)
        surrogate = None
        if change is not None:
            surrogate = VectorizedSimulator(change(config.scenario))
        built = pemviz.build_experiment(config, surrogate=surrogate)
        if not exact:
            log_exact = exact_log_probability(built.problem, twin=built.problem.simulator)
            assert log_exact is not None  # noqa: S101  single states decide the specification
            exact = math.exp(log_exact)
        state = built.method.init(built.problem, repetition=0)
        while not built.method.is_done(state):
            state, _ = built.method.step(built.problem, state)
        found.append(built.method.estimate(state))
    plain = [one for one in found if not interval_caveats(one)]
    return Row(
        name=name,
        rollouts=[one.rollouts_simulated for one in found],
        ratios=[one.probability / exact for one in found],
        held=sum((one.ci_low or 0.0) <= exact <= (one.ci_high or 0.0) for one in plain),
        warned=len(found) - len(plain),
    )


def surrogate_lines(rows: Sequence[Row]) -> list[str]:
    """A markdown table."""
    lines = [
        "| surrogate | rollouts, median (most) | error of the logarithm | held | warned |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        error = math.sqrt(statistics.fmean(math.log(ratio) ** 2 for ratio in row.ratios))
        of = len(row.rollouts) - row.warned
        lines.append(
            f"| {row.name} | {statistics.median(row.rollouts):.0f} ({max(row.rollouts)}) "
            f"| {error:.2f} | {row.held} of {of} | {row.warned} |"
        )
    return lines
