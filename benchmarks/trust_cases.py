"""Cases whose failure probability is known, from 1e-25 to 0.9, of every form of specification."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.trust_systems import (
    MOST,
    DroneAtWall,
    LinearLogit,
    MissesInSets,
    ScatteredMisses,
    TwoWayWalk,
    windows,
)
from benchmarks.trust_truth import (
    Automaton,
    Condition,
    always,
    always_eventually,
    both,
    eventually,
    eventually_always,
    exact_probability,
    response,
    until,
)
from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.types import Simulator

AUTHORS = Path(__file__).resolve().parents[2] / "shared" / "data" / "authors_pem"
AUTHORS_MODEL = AUTHORS / "pem_ml_nn.safetensors"
"""The authors' published model; part of the development data, absent in a user's checkout."""
RECURSION = "recursion over states and automaton, `trust_truth.exact_probability`"


@dataclass(frozen=True, kw_only=True)
class TrustCase:
    """A failure probability that is known.

    Attributes:
        name: In tables.
        config: Scenario, error model and specification; methods and seeds vary.
        truth: The failure probability.
        source: How it was found.
        relative_error: Standard error of the truth as a share of it; 0 where it is exact.
        automaton: Reads the specification, for the recursion; ``None`` where the truth is of
            another source.
        system: A simulator of one's own.
        model: Its detector model.
    """

    name: str
    config: ExperimentConfig
    truth: float
    source: str = RECURSION
    relative_error: float = 0.0
    automaton: Automaton | None = None
    system: Simulator | None = None
    model: Any = None

    def experiment(self, config: ExperimentConfig) -> Experiment:
        """What ``config``, this case's with a method and a seed, asks for.

        Raises:
            InputError: The method cannot be had for this specification.
        """
        return build_experiment(config, simulator=self.system, twin=self.system, pem=self.model)

    def recomputed(self) -> float:
        """The truth, by the recursion.

        Raises:
            ValueError: It is of another source.
        """
        if self.automaton is None:
            message = f"case {self.name}: no recursion, but {self.source}"
            raise ValueError(message)
        problem = self.experiment(replace(self.config, method="monte-carlo")).problem
        return exact_probability(problem.simulator, problem.pem, self.automaton)


def at_least(gap: float) -> Condition:
    """``gap >= gap``."""
    return lambda signals: signals["gap"] >= gap


def below(gap: float) -> Condition:
    """``gap < gap``."""
    return lambda signals: signals["gap"] < gap


def outside(low: float, high: float) -> Condition:
    """``gap < low or gap > high``."""
    return lambda signals: (signals["gap"] < low) | (signals["gap"] > high)


def _fast_or_far(signals: Any) -> Any:
    gap, speed = signals["gap"], signals["ego_speed"]
    return (gap >= 2.0) & ((gap >= 6.5) | (speed >= 7.0))


SPECIFICATIONS: dict[str, tuple[str, Automaton]] = {
    "always": ("always[0,99] (gap >= 2.0)", always(at_least(2.0), 0, 99)),
    "always, contact": ("always[0,99] (gap >= 0.0)", always(at_least(0.0), 0, 99)),
    "always, 5 m": ("always[0,99] (gap >= 5.0)", always(at_least(5.0), 0, 99)),
    "always, 6.59 m": ("always[0,99] (gap >= 6.59)", always(at_least(6.59), 0, 99)),
    "never far": ("always[50,99] (gap < 13.54)", always(below(13.54), 50, 99)),
    "two sides, band": (
        "always[0,65] (gap >= 2.0) and always[65,65] (gap < 5.4 or gap > 5.5)",
        both(always(at_least(2.0), 0, 65), always(outside(5.4, 5.5), 65, 65)),
    ),
    "two sides, speed": (
        "always[0,72] (gap >= 2.0 and (gap >= 6.5 or ego_speed >= 7))",
        always(_fast_or_far, 0, 72),
    ),
    "two sides, late": (
        "always[0,90] (gap >= 2.0) and always[90,90] (gap < 7.0 or gap > 7.3)",
        both(always(at_least(2.0), 0, 90), always(outside(7.0, 7.3), 90, 90)),
    ),
    "two sides, early": (
        "always[38,45] (gap < 4.5 or gap > 4.9)",
        always(outside(4.5, 4.9), 38, 45),
    ),
    "until": (
        "(gap >= 2.0) until[60,99] (gap >= 9.0)",
        until(at_least(2.0), at_least(9.0), 60, 99),
    ),
    "until, nearer": (
        "(gap >= 5.0) until[70,90] (gap >= 7.5)",
        until(at_least(5.0), at_least(7.5), 70, 90),
    ),
    "eventually": ("eventually[60,99] (gap >= 10.0)", eventually(at_least(10.0), 60, 99)),
    "eventually, short": ("eventually[80,85] (gap >= 7.0)", eventually(at_least(7.0), 80, 85)),
    "always eventually": (
        "always[40,70] (eventually[0,25] (gap >= 7.5))",
        always_eventually(at_least(7.5), 40, 70, 25),
    ),
    "eventually always": (
        "eventually[50,80] (always[0,15] (gap >= 7.2))",
        eventually_always(at_least(7.2), 50, 80, 15),
    ),
    "response": (
        "always[0,74] (gap < 5.0 -> eventually[0,25] (gap >= 7.0))",
        response(below(5.0), at_least(7.0), 74, 25),
    ),
}
"""Name to specification of the braking scenario and what reads it for the recursion."""

BRAKING: Sequence[tuple[str, str, str, float]] = (
    ("paper", "ml-nn", "always", 8.673765379962655e-15),
    ("paper", "ml-nn", "until", 1.590601122088744e-07),
    ("paper", "ml-nn", "always, 5 m", 1.3708029721965616e-05),
    ("paper", "ml-nn", "two sides, speed", 0.013998211696502927),
    ("town01", "authors", "two sides, early", 0.011339186086772137),
    ("paper", "authors", "always", 6.692596055482732e-15),
    ("paper", "authors", "always, contact", 1.4952924877386414e-20),
    ("paper", "authors", "always, 5 m", 1.245347855902262e-05),
    ("paper", "authors", "never far", 0.6136435846051822),
    ("paper", "authors", "two sides, band", 0.00018203175034797059),
    ("paper", "authors", "two sides, speed", 0.013339184477837145),
    ("paper", "authors", "two sides, late", 9.23339803164836e-07),
    ("paper", "authors", "until", 1.3164984909195893e-07),
    ("paper", "authors", "until, nearer", 1.2987678075096648e-05),
    ("paper", "authors", "eventually", 3.706423638952598e-06),
    ("paper", "authors", "eventually, short", 3.058745672404355e-05),
    ("paper", "authors", "always eventually", 0.23477111555419705),
    ("paper", "authors", "eventually always", 0.002372638662217381),
    ("paper", "authors", "response", 1.947819250116003e-06),
)
"""Preset, error model, specification and truth, all by the recursion: up to minutes each."""


def _braking(preset: str, pem: str, specification: str, truth: float) -> TrustCase:
    spec, automaton = SPECIFICATIONS[specification]
    path = str(AUTHORS_MODEL) if pem == "authors" else pem
    return TrustCase(
        name=f"{preset}, {pem}: {specification}",
        config=replace(load_preset(preset), pem=path, spec=spec, plan=False),
        truth=truth,
        automaton=automaton,
    )


WALKS: Sequence[tuple[str, TwoWayWalk, LinearLogit, tuple[str, Automaton], float]] = (
    (
        "1e-25",
        TwoWayWalk(initial_gap=12, largest_gap=14, states=60),
        LinearLogit(4.5, 0.05),
        ("always[0,59] (gap >= 0.5)", always(at_least(0.5), 0, 59)),
        7.126027916309994e-26,
    ),
    (
        "two modes",
        TwoWayWalk(watched=tuple(range(7)), still=7, states=26),
        LinearLogit(3.5, -0.2),
        ("always[0,25] (gap >= 0.5)", always(at_least(0.5), 0, 25)),
        1.1193902034872503e-07,
    ),
    (
        "two modes, every other step",
        TwoWayWalk(watched=(1, 3, 5, 7, 9, 11, 13)),
        LinearLogit(3.0, -0.2),
        ("always[0,18] (gap >= 0.5)", always(at_least(0.5), 0, 18)),
        3.211162618244414e-06,
    ),
    (
        "0.9",
        TwoWayWalk(states=60),
        LinearLogit(0.1, -0.05),
        ("always[0,59] (gap >= 2.5)", always(at_least(2.5), 0, 59)),
        0.9173990199749846,
    ),
    (
        "until",
        TwoWayWalk(states=40),
        LinearLogit(3.0, -0.1),
        (
            "(gap >= 2.5) until[20,30] (gap >= 7.5)",
            until(at_least(2.5), at_least(7.5), 20, 30),
        ),
        6.329161348022662e-05,
    ),
    (
        "response",
        TwoWayWalk(states=40),
        LinearLogit(2.0, -0.1),
        (
            "always[0,29] (gap < 4.5 -> eventually[0,10] (gap >= 6.5))",
            response(below(4.5), at_least(6.5), 29, 10),
        ),
        0.004331546553221874,
    ),
)
"""Own systems whose states are few, so that the recursion takes a second; truth at the end."""


def _walks() -> Sequence[TrustCase]:
    return [
        TrustCase(
            name=f"walk: {name}",
            config=replace(load_preset("paper"), spec=spec, plan=False),
            truth=truth,
            automaton=automaton,
            system=system,
            model=model,
        )
        for name, system, model, (spec, automaton), truth in WALKS
    ]


TOWN_VALUES = "the value function's proposal, 200,000 rollouts (`reference`)"


def _towns() -> Sequence[TrustCase]:
    """Cases of ``town01``, whose states do not merge enough for the recursion."""
    band = "always[0,45] (gap >= 4.3) and always[45,45] (gap < 4.75 or gap > 4.8)"
    if not AUTHORS_MODEL.is_file():
        return ()
    config = replace(load_preset("town01"), pem=str(AUTHORS_MODEL), plan=False)
    return (
        TrustCase(
            name="town01, authors: always",
            config=config,
            truth=2.4357300741609107e-13,
            source=TOWN_VALUES,
            relative_error=0.0015,
        ),
        TrustCase(
            name="town01, authors: two sides, band",
            config=replace(config, spec=band),
            truth=0.001758417493929991,
            source=f"{TOWN_VALUES}; 17,676 of 10,000,000 plain Monte Carlo rollouts",
            relative_error=0.0001,
        ),
    )


IN_TIME: Mapping[str, ScatteredMisses] = {
    "windows from 0 and 100 on": windows(0, 100),
    "windows from 20 and 100 on": windows(20, 100),
    "misses in two places, or one": ScatteredMisses(
        sets=((10, 11, 12, 100, 101, 102), tuple(range(50, 56))), needed=6
    ),
    "five misses of eight, twice": ScatteredMisses(
        sets=(tuple(range(8)), tuple(range(100, 108))), needed=5
    ),
}
"""Two failure modes far apart in time, of which exploration meets one seldom."""


def _fewer(needed: int, signals: Mapping[str, FloatArray]) -> BoolArray:
    return signals[MOST] < needed


def _in_time() -> Sequence[TrustCase]:
    config = replace(load_preset("paper"), plan=False)
    cases: list[TrustCase] = []
    for name, system in IN_TIME.items():
        model = MissesInSets(system=system)
        cases.append(
            TrustCase(
                name=name,
                config=replace(config, spec=system.spec),
                truth=system.probability(miss=model.within),
                automaton=always(partial(_fewer, system.needed), 0, system.states - 1),
                system=system,
                model=model,
            )
        )
    return cases


DRONE_COUNTED, DRONE_ROLLOUTS = 766_438, 4_000_000
"""Violations by plain Monte Carlo with numpy alone, without the sampler; seed 20261122."""


def _drones() -> Sequence[TrustCase]:
    """The drone's states do not merge: its truths are counted."""
    config = replace(load_preset("paper"), plan=False)
    spec = "always[0,60] (distance >= 1.0) and always[60,60] (distance >= 1.5)"
    return (
        TrustCase(
            name="drone: two sides",
            config=replace(config, spec=spec),
            truth=DRONE_COUNTED / DRONE_ROLLOUTS,
            source=f"{DRONE_COUNTED} of {DRONE_ROLLOUTS} plain Monte Carlo rollouts",
            relative_error=((1.0 - DRONE_COUNTED / DRONE_ROLLOUTS) / DRONE_COUNTED) ** 0.5,
            system=DroneAtWall(),
            model=LinearLogit(-0.5, 1.5),
        ),
    )


def trust_cases() -> Sequence[TrustCase]:
    """All cases; those with the authors' model where it is there."""
    here = [case for case in BRAKING if case[1] != "authors" or AUTHORS_MODEL.is_file()]
    return (*(_braking(*case) for case in here), *_towns(), *_walks(), *_in_time(), *_drones())
