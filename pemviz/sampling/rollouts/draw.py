"""Rollouts: the scenario stepped with outcomes drawn from a proposal."""

from collections.abc import Mapping
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from scipy import special

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.faults import SimulationError, blame, counted_from
from pemviz.latents import StandardNormals
from pemviz.pem.models.own_detector import DetectorModel
from pemviz.sampling.rollouts.latent_draws import LatentTrack
from pemviz.sampling.slots import turns_of
from pemviz.sampling.state.composed import kept_with_rollouts
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import begun, salient_of, stepped
from pemviz.types import Proposal, RolloutBatch, Simulator, StateBatch


def simulate(
    *,
    simulator: Simulator,
    pem: DetectorModel,
    proposal: Proposal,
    uniforms: FloatArray,
    normals: StandardNormals | None = None,
) -> RolloutBatch:
    """Roll out the scenario once for each row of ``uniforms``.

    Args:
        simulator: The scenario.
        pem: The perception error model.
        proposal: What outcomes are drawn from.
        uniforms: ``[N, T-1]`` independent draws from [0, 1); a step misses where its draw
            is below the probability of a miss.
        normals: Of a scenario with latents.

    Returns:
        N rollouts; of environments side by side as many at a time as there are.

    Raises:
        SimulationError: Something that is asked raises something, or gives what does not fit.
    """
    count, steps = uniforms.shape
    pieces = _pieces(simulator, count)
    if len(pieces) > 1:
        parts: list[RolloutBatch] = []
        for rows in pieces:
            with counted_from(rows.start):
                part = simulate(
                    simulator=simulator,
                    pem=pem,
                    proposal=of_rows(proposal, rows),
                    uniforms=uniforms[rows],
                    normals=None if normals is None else normals.take(rows),
                )
            parts.append(part)
        return RolloutBatch.concatenate(parts)
    track = None
    if normals is not None:
        track = LatentTrack.begun(normals, proposal, outcomes=steps)
    return roll_out(
        begun(simulator, count=count, start=None if track is None else track.latents.start),
        simulator=simulator,
        pem=pem,
        proposal=proposal,
        draws=uniforms.T,
        track=track,
    )


def roll_out(
    states: StateBatch,
    *,
    simulator: Simulator,
    pem: DetectorModel,
    proposal: Proposal,
    draws: FloatArray,
    track: LatentTrack | None = None,
) -> RolloutBatch:
    """Rollouts from initial ``states [N]`` for draws ``[T-1, N]``; latents go on by ``track``.

    Raises:
        SimulationError: Something that is asked raises something, or gives what does not fit.
    """
    steps, step = draws.shape[0], 0
    detected = np.empty(draws.shape, dtype=np.bool_)
    under_pem = np.empty(draws.shape)
    under_proposal = np.empty(draws.shape)
    signals = _Track(states.signals, steps + 1, simulator=simulator)
    memory = _Track(kept_with_rollouts(states.memory), steps + 1, simulator=simulator)
    try:
        for step in range(steps):
            under_pem[step] = logit_of(pem, salient_of(simulator, states))
            under_proposal[step] = proposal.logit(states, under_pem[step])
            detected[step] = draws[step] >= special.expit(-under_proposal[step])
            noise = None if track is None else track.noise(step, states, detected[step], proposal)
            states = stepped(simulator, states, detected[step], noise)
            signals.record(step + 1, states.signals)
            memory.record(step + 1, kept_with_rollouts(states.memory))
    except BaseException as error:  # parts of the user's may raise anything
        rollouts = range(draws.shape[1])
        blame(error, "proposal", step=step // turns_of(simulator), rollouts=rollouts)
    return RolloutBatch(
        signals=signals.by_rollout(),
        memory=memory.by_rollout(),
        detected=detected.T,
        pem_logit=under_pem.T,
        proposal_logit=under_proposal.T,
        latents=None if track is None else track.latents,
    )


def logit_of(pem: DetectorModel, salient: FloatArray, *, step: int | None = None) -> FloatArray:
    """The error model's answer to salient variables ``[N, D]`` of a step: logits ``[N]``.

    Raises:
        SimulationError: It raises something, or answers in another shape.
    """
    try:
        logit = pem.logit(salient)
        if np.shape(logit) != salient.shape[:-1]:  # numpy would repeat a single value
            what = f"error model: logit has shape {tuple(np.shape(logit))}"
            raise SimulationError(what, why=f"must be {tuple(salient.shape[:-1])}")
    except BaseException as error:  # a model of the user's may raise anything
        blame(error, "error model: logit", step=step, rollouts=range(len(salient)))
    return logit


def replay(
    *,
    simulator: Simulator,
    detected: BoolArray,
    start: FloatArray | None = None,
    noise: FloatArray | None = None,
) -> Mapping[str, FloatArray]:
    """Signals ``[N, T]`` of rollouts with given outcomes and latents.

    Args:
        simulator: The scenario; one with K slots as it was declared, or unrolled.
        detected: ``[N, T-1]``, or ``[N, T-1, K]``.
        start: ``[N, S]``; ``None``: all 0.
        noise: ``[N, T-1, M]``, with slots not unrolled; ``None`` likewise.

    Raises:
        SimulationError: The simulator raises something, or gives what does not fit.
    """
    pieces = _pieces(simulator, len(detected))
    if len(pieces) > 1:
        parts = [
            replay(
                simulator=simulator,
                detected=detected[rows],
                start=None if start is None else start[rows],
                noise=None if noise is None else noise[rows],
            )
            for rows in pieces
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    states = begun(simulator, count=detected.shape[0], start=start)
    signals = _Track(states.signals, simulator.states, simulator=simulator)
    by_step = np.ascontiguousarray(np.moveaxis(detected, 0, 1))
    turns = 1 if noise is None else detected.shape[1] // noise.shape[1]
    for step in range(simulator.states - 1):
        given = None if noise is None else noise[:, step // turns]
        states = stepped(simulator, states, by_step[step], given)
        signals.record(step + 1, states.signals)
    return signals.by_rollout()


def _pieces(simulator: Simulator, count: int) -> list[slice]:
    """Which of ``count`` rollouts are carried out at a time: all, but of environments few."""
    places = episodic(simulator)
    at_a_time = count if places is None else places.count
    return [slice(row, row + at_a_time) for row in range(0, count, max(at_a_time, 1))]


@runtime_checkable
class RowBoundProposal(Proposal, Protocol):
    """A proposal of N rollouts that differs from one to the next."""

    def rows(self, rows: slice) -> Proposal:
        """What some of the rollouts are drawn from."""
        ...


def of_rows(proposal: Proposal, rows: slice) -> Proposal:
    """What the chosen ones of the rollouts that ``proposal`` is for are drawn from."""
    return proposal.rows(rows) if isinstance(proposal, RowBoundProposal) else proposal


class _Track:
    """Named values as they come, kept time-major: each step writes one contiguous row.

    Values of a type share one block: fresh memory takes about as long as the arithmetic of the
    vectorized back end, and a large block comes in large pages.
    """

    def __init__(self, first: Mapping[str, AnyArray], states: int, *, simulator: Simulator) -> None:
        self._values, self._simulator = dict(first), simulator
        self._shapes = {name: array.shape for name, array in first.items()}
        for dtype in {array.dtype for array in first.values()}:
            alike = {name: array for name, array in first.items() if array.dtype == dtype}
            array = next(iter(alike.values()))
            shape = (len(alike), states, *array.shape)
            block = np.empty(shape, dtype=dtype)
            self._values.update(zip(alike, block, strict=True))
        self.record(0, first)

    def record(self, index: int, values: Mapping[str, AnyArray]) -> None:
        if values.keys() != self._shapes.keys():  # what is absent would be anything
            self._refuse(index, f"step gives {sorted(values)}", sorted(self._shapes))
        for name, array in values.items():
            if array.shape != self._shapes[name]:  # numpy would repeat a single value
                shapes = tuple(array.shape), tuple(self._shapes[name])
                self._refuse(index, f"{name} has shape {shapes[0]}", shapes[1])
            self._values[name][index] = array

    def _refuse(self, index: int, what: str, allowed: object) -> NoReturn:
        step = index // turns_of(self._simulator)
        what = f"simulator {self._simulator.name}: {what}"
        raise SimulationError(what, why=f"must be {allowed}", step=step)

    def by_rollout(self) -> dict[str, AnyArray]:
        return {name: array.T for name, array in self._values.items()}
