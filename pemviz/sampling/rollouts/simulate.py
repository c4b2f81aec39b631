"""Rollouts: the scenario stepped with outcomes and latents sampled from a proposal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from scipy.special import expit, ndtr

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.faults import SimulationError, blame, counted_from
from pemviz.latents import LatentCounts, Latents, StandardNormals, log_moved, log_shifted
from pemviz.pem.models.protocol import DetectorModel
from pemviz.proposals.latent_moves import NoiseMoves, log_waiting
from pemviz.sampling.slots import turns_of
from pemviz.sampling.state.composed import kept_with_rollouts, stayed
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import begun, salient_of, stepped
from pemviz.types import (
    MovesLatents,
    Proposal,
    RolloutBatch,
    Simulator,
    StateBatch,
    tells_violation,
)

SPAWN_KEY = 2**32 - 1
"""Of the children of a stage's seeds that latents come from; others count from 0."""
Tell = Callable[[int, StateBatch, BoolArray, FloatArray | None], None]
"""Gets what a step is given: the outcome's index, states ``[N]``, outcomes ``[N]`` and noise."""


@runtime_checkable
class ShapesLatents(MovesLatents, Protocol):
    """A proposal that says more of how it moves latents."""

    def noise_sd(self, count: int) -> FloatArray:
        """Spreads of narrow noise, ``[N, M]``; 1 is that of the model."""
        ...

    def noise_moves(self, states: StateBatch, detected: BoolArray) -> NoiseMoves:
        """Of the step that follows states ``[N]`` and outcomes ``[N]`` there."""
        ...

    def once(self, count: int) -> BoolArray:
        """Which of ``count`` rollouts have one step's noise moved at most, ``[N]``.

        Their shares are given that none was moved before.
        """
        ...


@runtime_checkable
class ChoosesStart(Proposal, Protocol):
    """A proposal that chooses where rollouts start."""

    def chosen_start(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latents ``[N, S]`` made of standard normals ``[N, S]``, and log p - log q, ``[N]``."""
        ...


class NormalSource:
    """Standard normals for a stage's rollouts, one batch after the other.

    They have a random generator of their own: outcomes are the same with latents and without.
    A rollout's do not depend on how many are sampled at a time.
    """

    def __init__(self, seeds: np.random.SeedSequence, *, counts: LatentCounts, steps: int) -> None:
        """For the stage of ``seeds``, whose rollouts have ``counts.noise`` at each of ``steps``."""
        self._generator = np.random.default_rng(_child(seeds, SPAWN_KEY))
        self._counts, self._steps = counts, steps

    def draw(self, count: int) -> StandardNormals | None:
        """For the next ``count`` rollouts; ``None`` if they take none."""
        if not self._counts:
            return None
        at_start, each = self._counts.at_start, self._counts.noise
        a_step = each + (each > 0)
        normals = self._generator.standard_normal((count, at_start + self._steps * a_step))
        by_step = normals[:, at_start:].reshape(count, self._steps, a_step)
        return StandardNormals(
            start=normals[:, :at_start],
            noise=by_step[..., :each],
            choice=by_step[..., each:].sum(-1),
        )


def _child(seeds: np.random.SeedSequence, key: int) -> np.random.SeedSequence:
    keys = (*seeds.spawn_key, key)
    return np.random.SeedSequence(seeds.entropy, spawn_key=keys, pool_size=seeds.pool_size)


@dataclass(frozen=True)
class LatentTrack:
    """The latents of N rollouts while they are sampled, a step of all in one piece.

    Attributes:
        normals: Without their means.
        latents: As far as they are sampled; written to.
        turns: Outcomes of a step: noise comes with the last of them.
        once: In which rollouts one step's noise is moved at most, ``[N]``.
        log_waits: Log of how likely it is that none was yet, ``[N]``; written to.
    """

    normals: StandardNormals
    latents: Latents
    turns: int
    once: BoolArray
    log_waits: FloatArray

    @staticmethod
    def begun(normals: StandardNormals, proposal: Proposal, *, outcomes: int) -> "LatentTrack":
        """With those at the start, of rollouts with so many ``outcomes``."""
        count, steps, _ = normals.noise.shape
        mean, once = np.zeros(normals.start.shape), np.zeros(count, dtype=np.bool_)
        if isinstance(proposal, MovesLatents):
            moved = proposal.start_mean(count)  # seeds, which come after, stay
            mean[:, : moved.shape[1]] = moved
        if isinstance(proposal, ChoosesStart):
            start, log_weight = proposal.chosen_start(normals.start)
        else:
            start = normals.start + mean
            log_weight = 0.0 - log_shifted(start, mean)  # not -0.0
        none, shares = np.zeros(normals.noise.shape), np.ones((count, steps))
        one, narrow_share = np.ones(none.shape), np.zeros(shares.shape)
        latents = Latents(start, mean, log_weight, none, none, shares, one, none, narrow_share)
        blank = latents.map(lambda values: np.array(values, order="F"))
        if isinstance(proposal, ShapesLatents):
            once = proposal.once(count)
            blank.noise_sd[:] = proposal.noise_sd(count)[:, None, :]
        return LatentTrack(normals, blank, outcomes // steps, once, np.zeros(count))

    def noise(
        self, step: int, states: StateBatch, detected: BoolArray, proposal: Proposal
    ) -> FloatArray | None:
        """Of the step that follows an outcome, ``[N, M]``; ``None`` before a step's last outcome.

        The outcome ``detected [N]`` was the one with index ``step``, at ``states [N]``.
        """
        if (step + 1) % self.turns:
            return None
        of_step, latents, normals = step // self.turns, self.latents, self.normals
        noise = normals.noise[:, of_step]
        if noise.shape[1] and isinstance(proposal, MovesLatents):
            if isinstance(proposal, ShapesLatents):
                moves = proposal.noise_moves(states, detected)
            else:
                mean, share = proposal.noise_mean(states, detected)
                moves = NoiseMoves(mean, share, mean, np.zeros(share.shape))
            noise = self._moved(noise, of_step, moves)
        latents.noise[:, of_step] = noise
        return latents.noise[:, of_step]

    def _moved(self, noise: FloatArray, of_step: int, moves: NoiseMoves) -> FloatArray:
        """Standard normals ``[N, M]`` of a step, moved."""
        latents, sd = self.latents, self.latents.noise_sd[:, of_step]
        due = np.where(self.once, moves.share * np.exp(self.log_waits), moves.share)
        latents.noise_mean[:, of_step], latents.noise_share[:, of_step] = moves.mean, due
        if latents.noise_narrow_mean is not None and latents.noise_narrow_share is not None:
            latents.noise_narrow_mean[:, of_step] = moves.narrow_mean
            latents.noise_narrow_share[:, of_step] = moves.narrow_share
        chance = ndtr(self.normals.choice[:, of_step])
        wide = noise + np.where((chance < due)[:, None], moves.mean, 0.0)
        narrow = (chance < moves.narrow_share * due)[:, None]
        noise = np.where(narrow, sd * noise + moves.narrow_mean, wide)
        if self.once.any():
            given_none = np.where(self.once, moves.share, 0.0)
            moved = log_moved(
                noise,
                moves.mean,
                sd,
                narrow_mean=moves.narrow_mean,
                narrow_share=moves.narrow_share,
            )
            self.log_waits[:] = log_waiting(self.log_waits, given_none, moved)
        return noise


def simulate(
    *,
    simulator: Simulator,
    pem: DetectorModel,
    proposal: Proposal,
    uniforms: FloatArray,
    normals: StandardNormals | None = None,
    tell: Tell | None = None,
    stays_from: int | None = None,
) -> RolloutBatch:
    """Roll out the scenario once for each row of ``uniforms``.

    These are independent uniforms ``[N, T-1]`` from [0, 1); a step misses where its own is below
    the probability of a miss under the proposal. Of environments side by side, as many rollouts
    are carried out at a time as there are. What each step is given goes to ``tell``. From the
    outcome with the index ``stays_from`` on the simulator steps no more: signals stay as they are,
    nothing is left to gain, and outcomes go on.

    Raises:
        SimulationError: A part of the user's raises something, or gives what does not fit.
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
                    tell=tell,
                    stays_from=stays_from,
                )
            parts.append(part)
        return RolloutBatch.concatenate(parts)
    track = None
    if normals is not None:
        track = LatentTrack.begun(normals, proposal, outcomes=steps)
    return _roll_out(
        begun(simulator, count=count, start=None if track is None else track.latents.start),
        simulator=simulator,
        pem=pem,
        proposal=proposal,
        uniforms=uniforms.T,
        track=track,
        tell=tell,
        stays_from=stays_from,
    )


def _roll_out(
    states: StateBatch,
    *,
    simulator: Simulator,
    pem: DetectorModel,
    proposal: Proposal,
    uniforms: FloatArray,
    track: LatentTrack | None = None,
    tell: Tell | None = None,
    stays_from: int | None = None,
) -> RolloutBatch:
    """Rollouts from initial ``states [N]`` for ``uniforms [T-1, N]``, latents by ``track``."""
    steps, step, outcomes = uniforms.shape[0], 0, 0
    detected = np.empty(uniforms.shape, dtype=np.bool_)
    under_pem = np.empty(uniforms.shape)
    under_proposal = np.empty(uniforms.shape)
    signals = _Track(states.signals, steps + 1, simulator=simulator)
    memory = _Track(kept_with_rollouts(states.memory), steps + 1, simulator=simulator)
    try:
        for step in range(steps):
            under_pem[step] = logit_of(pem, salient_of(simulator, states))
            under_proposal[step] = proposal.logit(states, under_pem[step])
            detected[step] = uniforms[step] >= expit(-under_proposal[step])
            noise = None if track is None else track.noise(step, states, detected[step], proposal)
            if tell is not None:
                tell(step, states, detected[step], noise)
            outcomes = step + 1
            if stays_from is None or step < stays_from:
                states = stepped(simulator, states, detected[step], noise)
            else:
                states = _over(stayed(simulator, states, detected[step]))
            signals.record(step + 1, states.signals)
            memory.record(step + 1, kept_with_rollouts(states.memory))
    except BaseException as error:  # parts of the user's may raise anything
        rollouts = range(uniforms.shape[1])
        if isinstance(error, SimulationError):
            error.outcomes = outcomes
        blame(error, "proposal", step=step // turns_of(simulator), rollouts=rollouts)
    return RolloutBatch(
        signals=signals.by_rollout(),
        memory=memory.by_rollout(),
        detected=detected.T,
        pem_logit=under_pem.T,
        proposal_logit=under_proposal.T,
        latents=None if track is None else track.latents,
    )


def _over(states: StateBatch) -> StateBatch:
    """States ``[N]`` as after a violation, from which on proposals leave the error model be."""
    told = {n: np.ones_like(v) for n, v in states.memory.items() if tells_violation(n)}
    return replace(states, memory={**states.memory, **told})


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
    """Signals ``[N, T]`` of rollouts with given outcomes ``[N, T-1]`` and latents.

    A scenario with K slots is as it was declared, with outcomes ``[N, T-1, K]``, or unrolled.
    ``start`` is ``[N, S]``, ``noise`` of its own steps ``[N, T-1, M]``; ``None``: all 0.

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
    """Which of ``count`` rollouts are carried out at a time: all, with environments few."""
    places = episodic(simulator)
    at_a_time = count if places is None else places.count
    return [slice(row, row + at_a_time) for row in range(0, count, max(at_a_time, 1))]


@runtime_checkable
class RowBoundProposal(Proposal, Protocol):
    """A proposal of N rollouts that differs from one to the next."""

    def rows(self, rows: slice) -> Proposal:
        """What some of the rollouts are sampled from."""
        ...


def of_rows(proposal: Proposal, rows: slice) -> Proposal:
    """What the chosen ones of the rollouts that ``proposal`` is for are sampled from."""
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
            names = [name for name, array in first.items() if array.dtype == dtype]
            block = np.empty((len(names), states, *first[names[0]].shape), dtype=dtype)
            self._values.update(zip(names, block, strict=True))
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
