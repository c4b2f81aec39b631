"""How fast plain rollouts with the error model are: by numpy, and by the compiled loop."""

import statistics
from collections.abc import Sequence
from importlib import metadata

import numpy as np

from benchmarks.figures import Figure, median_ratio
from benchmarks.simulators import elapsed_s
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.pem import load_pem
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.simulators.braking.compiled import CompiledRollouts, compiled_loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator


def plain_rollout_figures(*, rollouts: int = 20_000, repeats: int = 11) -> Sequence[Figure]:
    """Rollouts of the paper's scenario drawn from the default error model, by both in turn.

    Draws are made before; the compiled loop has met as many rollouts before it is measured. Without
    numba there is numpy's figure alone, whose name says so.

    Args:
        rollouts: In a repeat.
        repeats: Repeats that medians are taken over, after one that is not counted.
    """
    simulator, pem = VectorizedSimulator(ScenarioConfig()), load_pem(ExperimentConfig().pem)
    kernels, generator = compiled_loops(), np.random.default_rng(0)
    compiled = None if kernels is None else CompiledRollouts(simulator, pem.logit, kernels)
    numpy_s: list[float] = []
    compiled_s: list[float] = []
    for _ in range(repeats + 1):
        uniforms = generator.random((rollouts, simulator.states - 1))
        numpy_s.append(elapsed_s(lambda u=uniforms: simulate(
            simulator=simulator, pem=pem, proposal=PemProposal(), uniforms=u
        )))  # fmt: skip
        if compiled is not None:
            compiled_s.append(elapsed_s(lambda u=uniforms: compiled.simulate(u)))
    by_numpy = rollouts / statistics.median(numpy_s[1:])
    if compiled is None:
        name = "plain rollouts by numpy (no compiled loop: numba, pemviz[fast], is not there)"
        return (Figure(name, by_numpy, "rollouts/s"),)
    loop = f"plain rollouts by the compiled loop, numba {metadata.version('numba')}"
    return (
        Figure("plain rollouts by numpy", by_numpy, "rollouts/s"),
        Figure(loop, rollouts / statistics.median(compiled_s[1:]), "rollouts/s"),
        Figure(
            "compiled loop, times faster than numpy",
            median_ratio(numpy_s[1:], compiled_s[1:]),
        ),
    )
