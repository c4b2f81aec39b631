"""The least robust rollouts of a run: who they are, and their plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.colors import PEM_ON_BLACK, PROPOSAL_ON_BLACK, rgba
from pemviz.recording import paths
from pemviz.recording.latents import Randomness, log_noise, randomness
from pemviz.recording.outcomes import OutcomeRow, log_outcomes
from pemviz.recording.rollouts import THICK, THIN, series_colors
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.reports.estimate_words import share_text
from pemviz.runs.drawn_rollout import (
    NOT_ASKED,
    DrawnRollout,
    drawn_rollout,
    faultless,
    faultless_probability,
    right_by_slot,
    slots_of,
)
from pemviz.runs.result import RankedRollout, RunResult
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Signal, Simulator, StageResult, place_of

RANKED_BY_RULE = 3


@dataclass(frozen=True)
class Track:
    """One rollout that is among the least robust.

    Attributes:
        ranked: Which it is, and its scores.
        signals: ``[T]`` by signal name.
        detected: ``[T-1]`` outcomes; with several slots, whether none of them errs.
        pem_probability: ``[T-1]`` P(detected) under the perception error model.
        proposal_probability: ``[T-1]`` P(detected) under the proposal.
        right_by_slot: ``[T-1]`` whether each of several slots does not err, by its name.
        outcomes: Of perception, ``[T-1]``, with several slots ``[T-1, K]``.
        random: What was random in it beside outcomes.
        start: Latents at the start ``[S]``; ``None``: the scenario has none.
        drawn: Where its cars are, of a scenario that tells.
    """

    ranked: RankedRollout
    signals: dict[str, FloatArray]
    detected: BoolArray
    pem_probability: FloatArray
    proposal_probability: FloatArray
    right_by_slot: Mapping[str, BoolArray]
    outcomes: BoolArray
    random: Randomness
    start: FloatArray | None = None
    drawn: DrawnRollout | None = None

    @property
    def name(self) -> str:
        """Which it is."""
        ranked = self.ranked
        repetition = f"repetition {ranked.repetition}, " if ranked.repetition else ""
        return f"{repetition}stage {ranked.stage}, rollout {ranked.rollout}"

    @property
    def title(self) -> str:
        """For labels and legends."""
        return f"{self.name}, robustness {self.ranked.robustness:.3g}"


def update_tracks(
    tracks: Sequence[Track],
    stage: StageResult,
    result: RunResult,
    *,
    simulator: Simulator | SlotSimulator,
) -> tuple[Track, ...]:
    """The tracks of ``result``'s least robust rollouts, kept ones and those of a new stage."""
    logged = {_key(track.ranked): track for track in tracks}
    current: list[Track] = []
    for ranked in result.least_robust:
        key = _key(ranked)
        if key in logged:
            current.append(logged[key])
        elif (ranked.repetition, ranked.stage) == (stage.repetition, stage.stage):
            current.append(_track(stage, ranked, simulator))
    return tuple(current)


def _key(ranked: RankedRollout) -> tuple[int, int, int]:
    return (ranked.repetition, ranked.stage, ranked.rollout)


def _track(
    stage: StageResult, ranked: RankedRollout, simulator: Simulator | SlotSimulator
) -> Track:
    rollouts, slots = stage.scored.rollouts, slots_of(simulator)
    row = place_of(ranked.rollout, stage.drawn)
    signals = {name: values[row].copy() for name, values in rollouts.signals.items()}
    memory = {name: values[row].copy() for name, values in rollouts.memory.items()}
    return Track(
        ranked=ranked,
        signals=signals,
        detected=np.array(faultless(rollouts.detected[row], slots=slots)),
        pem_probability=faultless_probability(rollouts.pem_logit[row], slots=slots),
        proposal_probability=faultless_probability(rollouts.proposal_logit[row], slots=slots),
        right_by_slot=right_by_slot(rollouts.detected[row], slots=slots),
        outcomes=rollouts.detected[row].copy(),
        random=randomness(
            simulator, latents=rollouts.latents, row=row, signals=signals, memory=memory
        ),
        start=None if rollouts.latents is None else rollouts.latents.start[row].copy(),
        drawn=drawn_rollout(
            simulator,
            signals=signals,
            detected=rollouts.detected[row],
            memory=memory,
        ),
    )


def rules_table(by_rule: Mapping[str, Sequence[RankedRollout]]) -> str:
    """The least robust rollouts of each rule as markdown; nothing without rules."""
    if not by_rule:
        return ""
    rows = [
        (
            markdown_text(name),
            f"{one.robustness:.3g}{'' if one.violated else ' (holds)'}",
            share_text(one.share),
            f"repetition {one.repetition}, stage {one.stage}, rollout {one.rollout}",
        )
        for name, ranked in by_rule.items()
        for one in ranked[:RANKED_BY_RULE]
    ]
    words = "\n\n## Of each rule\n\nShares are of the answer to the rule.\n\n"
    return words + markdown_table(("rule", "robustness", "share", "which"), rows)


def log_worst_plots(
    file: RecordingFile,
    tracks: Sequence[Track],
    *,
    signals: Sequence[Signal],
    stage: int,
    dt_s: float,
) -> None:
    """Signals of all tracks, outcomes of each, detection probabilities of the least robust."""
    steps = tracks[0].detected.size
    acting = StepTimes(stage=stage, count=steps, dt_s=dt_s)
    drawn = tracks[::-1]
    violated = np.array([track.ranked.violated for track in drawn])
    for signal in signals:
        path = paths.worst_series(signal.key)
        values = np.array([track.signals[signal.name] for track in drawn])
        file.style(
            path,
            names=[track.title for track in drawn],
            colors=series_colors(violated),
            widths=[THICK if track is tracks[0] else THIN for track in drawn],
        )
        file.series(path, values, times=StepTimes(stage=stage, count=steps + 1, dt_s=dt_s))
    file.style(
        paths.WORST_DETECTION,
        names=["perception error model", "proposal it was sampled from"],
        colors=[rgba(PEM_ON_BLACK), rgba(PROPOSAL_ON_BLACK)],
        widths=[2.0, 2.0],
    )
    worst = tracks[0]
    file.series(
        paths.WORST_DETECTION,
        np.array([worst.pem_probability, worst.proposal_probability]),
        times=acting,
    )
    log_noise(file, worst.random, stage=stage, dt_s=dt_s)
    log_outcomes(file, _rows(tracks), stage=stage, dt_s=dt_s)


def _rows(tracks: Sequence[Track]) -> Sequence[OutcomeRow]:
    """Outcomes by rank, with several slots a row for each of them."""
    rows: list[OutcomeRow] = []
    for rank, track in enumerate(tracks, start=1):
        for slot, (name, right) in enumerate(track.right_by_slot.items()):
            asked = None if track.drawn is None else track.drawn.answers[:, slot] != NOT_ASKED
            rows.append(OutcomeRow(f"rank {rank}, {name}", right, asked))
        if not track.right_by_slot:
            rows.append(OutcomeRow(f"rank {rank}", track.detected))
    return rows
