"""Rollouts drawn from fitted proposals by a compiled loop, where numba is installed.

The braking scenario with memory of misses, with a tracker or without; a network as error model;
outcomes drawn from it, from a network of the gap, or from pilots and fits. Signals and outcomes are
numpy's to the last bit, logits within 1e-12 of their size, or of 1 where they are smaller: networks
are linear in the gap between their kinks, so that a logit is a product and a sum. A rollout with an
outcome that is too close to call by rounded numbers is drawn by numpy.

Whether a stage goes this way is :attr:`pemviz.sampling.rollouts.batches.BatchTask.many`, which
follows from a run's settings alone: one that is stopped and goes on draws what it would have drawn.
"""

import importlib
from collections.abc import Mapping
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.compiling import is_translated
from pemviz.pem.models.protocol import Pem
from pemviz.sampling.fitted.numbers import ERROR_MODEL, Scene, Written
from pemviz.sampling.fitted.terms import (
    is_served,
    model_numbers,
    plain_part,
    proposal_numbers,
    remembers,
    rules_of,
    tracking_numbers,
)
from pemviz.sampling.rollouts.batches import BatchTask, by_numpy
from pemviz.sampling.rollouts.draw import of_rows, simulate
from pemviz.sampling.rollouts.kernels import lead_speeds
from pemviz.simulators.braking.loops import numbers_of
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.latched import VIOLATED
from pemviz.simulators.remembering import LAST_OUTCOME
from pemviz.types import Proposal, RolloutBatch, Simulator


@cache
def compiled_draw() -> ModuleType | None:
    """The module of the loop, compiled; ``None`` without numba, or with one that fails here."""
    loops = importlib.import_module("pemviz.sampling.fitted.loops")
    return loops if is_translated(loops.draw) else None


def simulated(simulator: Simulator, pem: Pem, task: BatchTask) -> RolloutBatch:
    """A batch's rollouts, by the loop if they are of many, and it knows them."""
    if task.many and task.normals is None and is_served(simulator, pem, task.proposal):
        loops = compiled_draw()
        if loops is not None:
            return drawn(simulator, pem, task.proposal, task.uniforms, loops)
    return by_numpy(simulator, pem, task)


def drawn(
    simulator: Simulator, pem: Pem, proposal: Proposal, uniforms: FloatArray, loops: Any
) -> RolloutBatch:
    """Rollouts for draws ``uniforms [N, T-1]``.

    Args:
        simulator: The scenario; with the model and the proposal, one that is served.
        pem: The error model.
        proposal: What outcomes are drawn from, N rollouts or any number.
        uniforms: As in :func:`pemviz.sampling.rollouts.draw.simulate`.
        loops: :mod:`pemviz.sampling.fitted.loops`, compiled or not.
    """
    scenario, rules = plain_part(simulator), rules_of(simulator)
    assert scenario is not None and rules is not None  # noqa: S101, PT018  it is served
    lead_mps = lead_speeds(scenario.config)
    signals, memory, written = _begun(simulator, scenario, len(uniforms), lead_mps)
    model = model_numbers(simulator, pem)
    fit = proposal_numbers(proposal, model)
    loops.draw(
        written,
        model,
        fit,
        Scene(numbers_of(scenario.config), tracking_numbers(scenario.config), rules),
        uniforms,
    )
    pem_logit, proposal_logit = written.under_pem.T, written.under_proposal.T
    rollouts = RolloutBatch(
        signals={name: values.T for name, values in signals.items()},
        memory={name: values.T for name, values in memory.items()},
        detected=written.detected.T,
        pem_logit=pem_logit,
        proposal_logit=pem_logit if fit.kind == ERROR_MODEL else proposal_logit,
    )
    for row in np.flatnonzero(written.doubtful).tolist():
        one = slice(row, row + 1)
        by_numpy = simulate(
            simulator=simulator, pem=pem, proposal=of_rows(proposal, one), uniforms=uniforms[one]
        )
        _put(rollouts, one, by_numpy)
    return rollouts


def _begun(
    simulator: Simulator, scenario: VectorizedSimulator, count: int, lead_mps: FloatArray
) -> tuple[Mapping[str, Any], Mapping[str, Any], Written]:
    """Signals and memory ``[T, N]`` by name with their first states, and the same for the loop."""
    states, first = scenario.states, simulator.initial(count=count)
    floats = np.empty((len(first.signals) + 1, states, count))
    signals = dict(zip(first.signals, floats, strict=False))
    memory = {name: np.empty((states, count), v.dtype) for name, v in first.memory.items()}
    memory[SPEED_ERROR_INTEGRAL] = floats[-1]
    for found, begin in ((signals, first.signals), (memory, first.memory)):
        for name, values in begin.items():
            found[name][0] = values
    signals[LEAD_SPEED][:] = lead_mps[:, None]
    outcome = signals[LAST_OUTCOME.name] if remembers(simulator) else np.empty((states, 0))
    tracker = scenario.tracker
    track = {} if tracker is None else {
        part: memory[f"{tracker.name}_{part}"]
        for part in ("window", "misses", "confirmed", "position_m_0")
    }  # fmt: skip
    numbers, flags = np.empty((states, 0), dtype=np.int64), np.empty((states, 0), np.bool_)
    detected = np.empty((states - 1, count), dtype=np.bool_)
    logits = np.empty((2, states - 1, count))
    written = Written(
        gap_m=signals[GAP],
        ego_mps=signals[EGO_SPEED],
        integral_m=memory[SPEED_ERROR_INTEGRAL],
        outcome=outcome,
        window=track.get("window", numbers),
        misses=track.get("misses", numbers),
        confirmed=track.get("confirmed", flags),
        position_m=track.get("position_m_0", np.empty((states, 0))),
        violated=memory.get(VIOLATED, flags),
        detected=detected,
        under_pem=logits[0],
        under_proposal=logits[1],
        lead_mps=lead_mps,
        doubtful=np.zeros(count, dtype=np.bool_),
    )
    return signals, memory, written


def _put(rollouts: RolloutBatch, rows: slice, others: RolloutBatch) -> None:
    """Write ``others`` in place of some of the rollouts."""
    for part in ("signals", "memory"):
        for name, values in getattr(others, part).items():
            getattr(rollouts, part)[name][rows] = values
    for part in ("detected", "pem_logit", "proposal_logit"):
        getattr(rollouts, part)[rows] = getattr(others, part)
