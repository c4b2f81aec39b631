"""The least robust rollouts of a run: who they are, what was random in them, and their plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import rerun as rr

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.colors import (
    BLUE,
    DETECTED,
    GREEN,
    GREY,
    MISSED,
    ORANGE,
    PEM_IN_RECORDING,
    PROPOSAL_IN_RECORDING,
    PURPLE,
    SKY,
    VERMILLION,
)
from pemviz.latents import Latents
from pemviz.recording import paths, plot
from pemviz.recording.rollouts import THICK, THIN, series_colors
from pemviz.recording.shades import shade
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_rollout import (
    NOT_EVALUATED,
    DrawnRollout,
    drawn_rollout,
    faultless,
    faultless_probability,
    right_by_slot,
    slots_of,
)
from pemviz.runs.result import RankedRollout, RunResult
from pemviz.sampling.state.visibility import VISIBILITY
from pemviz.simulators.latents import NamesStarts, latent_counts, within
from pemviz.simulators.scene import TellsErrors
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Signal, Simulator, StageResult, place_of

MOST_NOISE_SERIES = 8
NOISE_COLORS = tuple(map(shade, (ORANGE, SKY, GREEN, PURPLE, VERMILLION, BLUE)))
MOST_STARTS = 6
OUTCOME_ROWS = 6
MISS_HEIGHT = 0.6
"""Of a row."""
DETECTION_RADIUS = 0.006
"""Half of a detection's height, in heights of the plot."""


@dataclass(frozen=True, eq=False)
class Randomness:
    """What was random in one rollout beside outcomes, in its scenario's terms where it has some.

    Start values with their units by name; by step ``[T-1]`` errors [m] or standard normals.
    """

    start: Mapping[str, tuple[float, str]]
    by_step: Mapping[str, FloatArray]
    in_m: bool

    @property
    def start_text(self) -> str:
        """In words; empty if there is nothing to tell."""
        shown = [f"{n} {v:.3g} {unit}".rstrip() for n, (v, unit) in self.start.items()]
        more = len(shown) - MOST_STARTS
        return ", ".join(shown[:MOST_STARTS] + [f"{more} more"] * (more > 0))


@dataclass(frozen=True)
class Track:
    """One rollout that is among the least robust.

    Attributes:
        signals: ``[T]`` by signal name.
        detected: ``[T-1]`` outcomes; with several slots, whether none of them errs.
        pem_probability: ``[T-1]`` P(detected) under the perception error model.
        proposal_probability: ``[T-1]`` P(detected) under the proposal.
        right_by_slot: ``[T-1]`` whether each of several slots does not err, by its name.
        outcomes: Of perception, ``[T-1]``, with several slots ``[T-1, K]``.
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


def update_tracks(
    tracks: Sequence[Track],
    stage: StageResult,
    result: RunResult,
    *,
    simulator: Simulator | SlotSimulator,
) -> tuple[Track, ...]:
    """The tracks of ``result``'s least robust rollouts, kept ones and those of a new stage."""

    def key(ranked: RankedRollout) -> tuple[int, int, int]:
        return ranked.repetition, ranked.stage, ranked.rollout

    logged = {key(track.ranked): track for track in tracks}
    current: list[Track] = []
    for ranked in result.least_robust:
        if key(ranked) in logged:
            current.append(logged[key(ranked)])
        elif (ranked.repetition, ranked.stage) == (stage.repetition, stage.stage):
            current.append(_track(stage, ranked, simulator))
    return tuple(current)


def _track(
    stage: StageResult, ranked: RankedRollout, simulator: Simulator | SlotSimulator
) -> Track:
    rollouts, slots = stage.scored.rollouts, slots_of(simulator)
    row = place_of(ranked.rollout, stage.sampled)
    signals = {name: values[row].copy() for name, values in rollouts.signals.items()}
    memory = {name: values[row].copy() for name, values in rollouts.memory.items()}
    detected, latents = rollouts.detected[row], rollouts.latents
    return Track(
        ranked=ranked,
        signals=signals,
        detected=np.array(faultless(detected, slots=slots)),
        pem_probability=faultless_probability(rollouts.pem_logit[row], slots=slots),
        proposal_probability=faultless_probability(rollouts.proposal_logit[row], slots=slots),
        right_by_slot=right_by_slot(detected, slots=slots),
        outcomes=detected.copy(),
        random=_randomness(simulator, latents, row, signals, memory),
        start=None if latents is None else latents.start[row].copy(),
        drawn=drawn_rollout(simulator, signals=signals, detected=detected, memory=memory),
    )


def _randomness(
    simulator: object,
    latents: Latents | None,
    row: int,
    signals: Mapping[str, FloatArray],
    memory: Mapping[str, AnyArray],
) -> Randomness:
    """Of one rollout, by latents of all of them and by signals and memory of its own."""
    start: dict[str, tuple[float, str]] = {}
    if latents is not None:
        normals, named = latents.start[row : row + 1], within(simulator, NamesStarts)
        if named is None:
            start = {f"latent {place} at": (float(z), "") for place, z in enumerate(normals[0])}
        else:
            values = named.start_values(normals)
            start = {
                one.name.replace("_", " "): (float(values[one.name][0]), one.unit)
                for one in named.starts
            }
    if VISIBILITY.name in signals:
        start["visibility u in the end"] = float(signals[VISIBILITY.name][-1]), ""
    if latents is None or not latents.noise.shape[2]:
        return Randomness(start, {}, in_m=False)
    telling = within(simulator, TellsErrors)
    errors = {} if telling is None else telling.measurement_errors(signals, memory)
    noise = {f"latent {place}": values for place, values in enumerate(latents.noise[row].T)}
    return Randomness(start, errors or noise, in_m=bool(errors))


def noise_title(simulator: object) -> str:
    """Names what is drawn of the least robust rollout's steps; empty if they have no latents."""
    if not latent_counts(simulator).noise:
        return ""
    if within(simulator, TellsErrors) is None:
        return "Rank 1: standard normals against step"
    return "Rank 1: error of measured places [m] against step"


def log_worst_plots(
    file: RecordingFile,
    tracks: Sequence[Track],
    *,
    signals: Sequence[Signal],
    stage: int,
    dt_s: float,
) -> None:
    """Signals and outcomes of all tracks; of the least robust P(detected) and what was random."""

    def series(path: str, values: AnyArray) -> None:
        file.series(path, values, times=StepTimes(stage, count=values.shape[1], dt_s=dt_s))

    drawn, worst = tracks[::-1], tracks[0]
    violated = np.array([track.ranked.violated for track in drawn])
    for signal in signals:
        path = paths.worst_series(signal.key)
        file.style(
            path,
            names=[f"{one.name}, robustness {one.ranked.robustness:.3g}" for one in drawn],
            colors=series_colors(violated),
            widths=[THICK if track is worst else THIN for track in drawn],
        )
        series(path, np.array([track.signals[signal.name] for track in drawn]))
    file.style(
        paths.WORST_DETECTION,
        names=["perception error model", "proposal it was sampled from"],
        colors=[shade(PEM_IN_RECORDING), shade(PROPOSAL_IN_RECORDING)],
        widths=[2.0, 2.0],
    )
    series(paths.WORST_DETECTION, np.array([worst.pem_probability, worst.proposal_probability]))
    if noise := dict(list(worst.random.by_step.items())[:MOST_NOISE_SERIES]):
        unit = " [m]" if worst.random.in_m else ""
        file.style(
            paths.WORST_NOISE,
            names=[f"{name}{unit}" for name in noise],
            colors=[NOISE_COLORS[place % len(NOISE_COLORS)] for place in range(len(noise))],
            widths=[2.0] * len(noise),
        )
        series(paths.WORST_NOISE, np.array(list(noise.values())))
    _log_outcomes(file, tracks, stage=stage, dt_s=dt_s)


@dataclass(frozen=True, eq=False)
class _OutcomeRow:
    """Whether perception was right ``[T-1]``, and whether there was anything to be right about."""

    name: str
    right: BoolArray
    applies: BoolArray


def _log_outcomes(file: RecordingFile, tracks: Sequence[Track], *, stage: int, dt_s: float) -> None:
    """Misses against time by rank, with several slots a row for each, and where the time is."""
    rows: list[_OutcomeRow] = []
    for rank, track in enumerate(tracks, start=1):
        always = np.ones(track.detected.size, dtype=np.bool_)
        for slot, (name, right) in enumerate(track.right_by_slot.items()):
            in_view = (
                always if track.drawn is None else track.drawn.answers[:, slot] != NOT_EVALUATED
            )
            rows.append(_OutcomeRow(row_name(rank, name), right, in_view))
        if not track.right_by_slot:
            rows.append(_OutcomeRow(row_name(rank), track.detected, always))
    rows = rows[:OUTCOME_ROWS]
    steps = rows[0].right.size
    frame = outcome_frame([row.name for row in rows], steps=steps, dt_s=dt_s)
    log = partial(file.at_stage, stage=stage)
    plot.log_axes(log, paths.OUTCOMES, frame)
    for place, row in enumerate(rows, start=1):
        log(paths.outcomes(place), _misses(frame, row, place=place, dt_s=dt_s))
    entries = [(0, "missed", shade(MISSED)), (1, "detected", shade(DETECTED))]
    if not all(np.all(row.applies) for row in rows):
        entries.append((2, "not in view", shade(GREY)))
    plot.log_legend(log, paths.OUTCOMES, frame, entries)
    times, path = StepTimes(stage, count=steps + 1, dt_s=dt_s), paths.part(paths.OUTCOMES, "time")
    strips = [[frame.upright(step * dt_s)] for step in range(times.count)]
    file.static(path, rr.LineStrips2D.from_fields(colors=[shade(PURPLE)], radii=[plot.ui(1.0)]))
    file.along(path, rr.LineStrips2D.columns(strips=strips), times=times)


def row_name(rank: int, slot: str = "") -> str:
    """Whose outcomes a row has: of several slots one."""
    return f"rank {rank}, {slot}" if slot else f"rank {rank}"


def outcome_frame(names: Sequence[str], *, steps: int, dt_s: float) -> plot.Frame:
    """Time to the right, rows downwards, the first on top."""
    ticks = tuple((float(place), name) for place, name in enumerate(names, start=1))
    y = plot.Axis(low=len(names) + 0.5, high=0.5, ticks=ticks)
    x = plot.number_axis(0.0, steps * dt_s, unit="s")
    return plot.Frame(x=x, y=y, shape=plot.named_rows(names))


def _misses(frame: plot.Frame, row: _OutcomeRow, *, place: int, dt_s: float) -> rr.LineStrips2D:
    """A line along the row, and across it a stroke as wide as a step for every miss."""
    steps = row.right.size
    turns = np.flatnonzero(np.diff(row.applies)) + 1
    runs = list(pairwise([0, *turns.tolist(), steps]))
    lines = [frame.places(np.array(run) * dt_s, np.full(2, float(place))) for run in runs]
    shades = [shade(DETECTED if row.applies[first] else GREY) for first, _ in runs]
    ends = np.array([place - MISS_HEIGHT / 2, place + MISS_HEIGHT / 2])
    middles_s = (np.flatnonzero(~row.right & row.applies) + 0.5) * dt_s
    missed = [frame.places(np.full(2, middle_s), ends) for middle_s in middles_s]
    half_step = frame.shape.width / steps / 2.0
    return rr.LineStrips2D(
        [*lines, *missed],
        colors=[*shades, *[shade(MISSED)] * len(missed)],
        radii=[*[DETECTION_RADIUS] * len(lines), *[half_step] * len(missed)],
        draw_order=20.0,
    )
