"""``python -m benchmarks compare``: speed as ratios within one run, against what else there is.

Every ratio is one of processor seconds, measured in turns one right after the other, so that other
machines and what else a machine does matter little. More is better in all of them.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.compiled_limit import limit_work
from benchmarks.ratios import Comparison, LeftOut, Ratio, made_with, ratio_of_turns
from benchmarks.simulators import replaying
from benchmarks.stl import (
    ALWAYS,
    BY_HAND,
    METRICS,
    ORACLE_PYTHON,
    ROLLOUTS,
    STATES,
    random_batch,
    time_rtamt,
)
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import load_preset
from pemviz.pem import load_pem
from pemviz.pem.models.network import NetworkPem
from pemviz.proposals.fixed import PemProposal
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.simulators.braking.compiled import CompiledRollouts, compiled_loops
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.stl import Classical, parse, robustness

Work = Callable[[], object]
Found = Iterator[Ratio | LeftOut]
TRACES = 200
"""Traces that rtamt is timed on."""


def compare(*, turns: int = 5, rtamt_python: str | None = None) -> Comparison:
    """Measure every ratio.

    Args:
        turns: Times that each pair is measured, after one that is not counted.
        rtamt_python: A Python that has rtamt; by default what the environment variable
            PEMVIZ_ORACLE_PYTHON names.

    Raises:
        RunError: That Python cannot run rtamt.
    """
    python = rtamt_python or os.environ.get(ORACLE_PYTHON)
    found = [
        *compiled_ratios(turns=turns),
        *replay_ratios(turns=turns),
        *hand_written_ratios(turns=turns),
        *rtamt_ratios(python, turns=turns),
        *paper_ratios(load_preset("paper-algorithm"), turns=max(1, turns // 2)),
        *(run_ratio(one, turns=max(1, turns // 2)) for one in _runs()),
    ]
    return Comparison(
        ratios=tuple(one for one in found if isinstance(one, Ratio)),
        left_out=tuple(one for one in found if isinstance(one, LeftOut)),
        made_with=made_with(),
    )


def _runs() -> Sequence[ExperimentConfig]:
    """What whole runs are timed of, besides the paper's algorithm."""
    paper = load_preset("paper")
    return [
        replace(paper, plan=False),
        replace(paper, method="zero-variance", final_rollouts=1200),
    ]


def spent_s(work: Work) -> float:
    """Processor seconds that some work takes in this process."""
    began = time.process_time()
    work()
    return time.process_time() - began


def in_turns_s(works: Sequence[Work], turns: int) -> Sequence[Sequence[float]]:
    """Of each work its processor seconds, turn by turn; a first turn is not counted."""
    measured = [[spent_s(work) for work in works] for _ in range(turns + 1)]
    return list(zip(*measured[1:], strict=True))


def compiled_ratios(*, rollouts: int = 20_000, turns: int = 5) -> Found:
    """Plain rollouts of the paper's scenario: the compiled loop against numpy and its own limit.

    The limit is what takes longer of memory alone and arithmetic alone; the ratio is the share of
    it that the loop reaches, at most about 1.
    """
    name = "plain rollouts by the compiled loop"
    kernels = compiled_loops()
    if kernels is None:
        yield LeftOut(name, "numba is not there: pip install 'pemviz[fast]'")
        return
    simulator, pem = VectorizedSimulator(ScenarioConfig()), load_pem(ExperimentConfig().pem)
    uniforms = np.random.default_rng(0).random((rollouts, simulator.states - 1))
    compiled = CompiledRollouts(simulator, pem.logit, kernels)
    compiled.simulate(uniforms)  # from here on it knows every gap
    limit = limit_work(compiled, uniforms)
    works: list[Work] = [
        lambda: simulate(
            simulator=simulator, pem=pem, proposal=PemProposal(), uniforms=uniforms
        ),
        lambda: compiled.simulate(uniforms),
        limit.memory,
        limit.arithmetic,
    ]  # fmt: skip
    numpy_s, compiled_s, memory_s, arithmetic_s = in_turns_s(works, turns)
    yield ratio_of_turns(name, "numpy", theirs_s=numpy_s, ours_s=compiled_s)
    each_ns = [
        1e9 * statistics.median(times_s) / uniforms.size
        for times_s in (compiled_s, memory_s, arithmetic_s)
    ]
    bound = "memory" if each_ns[1] > each_ns[2] else "arithmetic"
    note = f"limit: {bound}; {{:.1f}} ns a rollout and step, {{:.1f}} memory, {{:.1f}} arithmetic"
    yield ratio_of_turns(
        name,
        "its limit",
        theirs_s=memory_s if bound == "memory" else arithmetic_s,
        ours_s=compiled_s,
        note=note.format(*each_ns),
    )


def replay_ratios(
    *, vectorized_rollouts: int = 10_000, highway_rollouts: int = 20, turns: int = 5
) -> Found:
    """Rollouts of given outcomes: the vectorized back end against highway-env."""
    config = ScenarioConfig()
    works = [
        replaying(VectorizedSimulator(config), vectorized_rollouts),
        replaying(HighwaySimulator(config), highway_rollouts),
    ]
    batch_s, highway_s = in_turns_s(works, turns)
    yield ratio_of_turns(
        "rollouts of given outcomes, vectorized",
        "highway-env",
        theirs_s=[time_s / highway_rollouts for time_s in highway_s],
        ours_s=[time_s / vectorized_rollouts for time_s in batch_s],
    )


def hand_written_ratios(*, turns: int = 5) -> Found:
    """Classical robustness of three formulas against numpy written for each."""
    batch = random_batch(rollouts=ROLLOUTS, states=STATES)
    for text, by_hand in BY_HAND.items():
        formula = parse(text)
        works: list[Work] = [
            lambda formula=formula: robustness(formula, batch, Classical()),
            lambda by_hand=by_hand: by_hand(batch),
        ]
        ours_s, theirs_s = in_turns_s(works, 2 * turns)
        yield ratio_of_turns(
            f"classical of {text}", "numpy by hand", theirs_s=theirs_s, ours_s=ours_s
        )


def rtamt_ratios(python: str | None, *, turns: int = 5) -> Found:
    """Robustness of one formula under each metric, against rtamt's classical one."""
    batch, formula = random_batch(rollouts=ROLLOUTS, states=STATES), parse(ALWAYS)
    if not python:
        why = f"{ORACLE_PYTHON} names no Python with rtamt (tests/stl/oracle_requirements.txt)"
        yield LeftOut("robustness against rtamt", why)
        return
    rtamt_s = [time_rtamt(python, batch["d"][:TRACES])]
    ours_s: dict[str, list[float]] = {name: [] for name in METRICS}
    for _ in range(max(1, turns // 2)):
        for name, metric in METRICS.items():
            works: list[Work] = [lambda metric=metric: robustness(formula, batch, metric)]
            ours_s[name].append(min(in_turns_s(works, 3 * turns)[0]) / ROLLOUTS)
        rtamt_s.append(time_rtamt(python, batch["d"][:TRACES]))
    for name, each_s in ours_s.items():
        label = f"{name} of {ALWAYS}"
        yield ratio_of_turns(label, "rtamt's classical", theirs_s=rtamt_s[1:], ours_s=each_s)


def run_ratio(config: ExperimentConfig, *, turns: int = 2) -> Ratio:
    """A whole run of a method against plain rollouts alone, as many and in batches as large.

    What a method learns, weighs and judges comes on top of simulating: below 1, and more is better.
    """
    experiment = build_experiment(config)
    simulator, planned = VectorizedSimulator(config.scenario), experiment.planned_rollouts
    uniforms = np.random.default_rng(0).random((planned, simulator.states - 1))
    batches = np.split(uniforms, range(config.rollouts, planned, config.rollouts))

    def plain() -> None:
        for some in batches:
            simulate(simulator=simulator, pem=experiment.pem, proposal=PemProposal(), uniforms=some)

    plain_s, ours_s = in_turns_s([plain, lambda: run(experiment)], turns)
    planning = ", with its plan" if config.plan else ""
    return ratio_of_turns(
        f"{config.method}, {planned} rollouts{planning}",
        "plain rollouts alone",
        theirs_s=plain_s,
        ours_s=ours_s,
        note=f"{statistics.median(ours_s):.2f} s",
    )


def paper_ratios(config: ExperimentConfig, *, turns: int = 2) -> Found:
    """One repetition of the paper's algorithm against the same in plain torch, on one thread."""
    pem = load_pem(config.pem)
    assert isinstance(pem, NetworkPem)  # noqa: S101  the preset's
    from benchmarks.plain_torch import paper_loop  # noqa: PLC0415  torch is slow to import
    from pemviz.pem.fitting.networks import single_thread  # noqa: PLC0415  as above

    experiment = build_experiment(config)
    with single_thread(0):
        works: list[Work] = [
            lambda: paper_loop(config, pem, seed=config.seed),
            lambda: run(experiment),
        ]
        torch_s, ours_s = in_turns_s(works, turns)
    yield ratio_of_turns(
        "the paper's algorithm, one repetition",
        "plain torch",
        theirs_s=torch_s,
        ours_s=ours_s,
        note=f"{statistics.median(ours_s):.2f} s, plain torch {statistics.median(torch_s):.2f} s",
    )
