"""What was random beside outcomes in the least robust rollouts: starts, errors, visibility."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, rgba
from pemviz.latents import Latents
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.sampling.state.visibility import VISIBILITY
from pemviz.simulators.latents import latent_counts
from pemviz.simulators.starts import named_starts
from pemviz.simulators.told_errors import tells_errors

MOST_SERIES = 8
MOST_STARTS = 6
COLORS = (ORANGE, SKY, GREEN, PURPLE, VERMILLION, BLUE)


@dataclass(frozen=True, eq=False)
class Randomness:
    """Of one rollout.

    Attributes:
        start: What it started with, value and unit by name.
        by_step: ``[T-1]`` by name: errors [m], or standard normals.
        in_m: Whether they are errors.
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


def randomness(
    simulator: object,
    *,
    latents: Latents | None,
    row: int,
    signals: Mapping[str, FloatArray],
    memory: Mapping[str, AnyArray],
) -> Randomness:
    """What was random in one of N rollouts, in the terms of its scenario where it has some.

    Args:
        simulator: The scenario.
        latents: Of all N rollouts.
        row: Which rollout.
        signals: Its own, ``[T]`` by name.
        memory: Likewise.
    """
    start = {} if latents is None else _start(simulator, latents.start[row : row + 1])
    if VISIBILITY.name in signals:
        start |= {"visibility u in the end": (float(signals[VISIBILITY.name][-1]), "")}
    if latents is None or not latents.noise.shape[2]:
        return Randomness(start, {}, in_m=False)
    telling = tells_errors(simulator)
    told = {} if telling is None else telling.told_errors(signals, memory)
    noise = {f"latent {place}": values for place, values in enumerate(latents.noise[row].T)}
    return Randomness(start, told or noise, in_m=bool(told))


def _start(simulator: object, start: FloatArray) -> dict[str, tuple[float, str]]:
    named = named_starts(simulator)
    if named is None:
        return {f"latent {place} at": (float(z), "") for place, z in enumerate(start[0])}
    values = named.start_values(start)
    return {
        signal.name.replace("_", " "): (float(values[signal.name][0]), signal.unit)
        for signal in named.starts
    }


def noise_title(simulator: object) -> str:
    """Names what is drawn of the least robust rollout's steps; empty if they have no latents."""
    if not latent_counts(simulator).noise:
        return ""
    if tells_errors(simulator) is None:
        return "Rank 1: standard normals against step"
    return "Rank 1: error of measured places [m] against step"


def starts_table(each: Sequence[Randomness]) -> str:
    """What rollouts were given at their start as markdown, by rank; nothing if that is nothing."""
    rows = [(f"{rank}", markdown_text(one.start_text)) for rank, one in enumerate(each, start=1)]
    if not any(words for _, words in rows):
        return ""
    table = markdown_table(("rank", "started with"), rows)
    return f"\n\n## Random at the start\n\n{table}"


def log_noise(file: RecordingFile, shown: Randomness, *, stage: int, dt_s: float) -> None:
    """The least robust rollout's errors or latents against time."""
    series = dict(list(shown.by_step.items())[:MOST_SERIES])
    if not series:
        return
    unit = " [m]" if shown.in_m else ""
    colors = [rgba(COLORS[place % len(COLORS)]) for place in range(len(series))]
    file.style(
        paths.WORST_NOISE,
        names=[f"{name}{unit}" for name in series],
        colors=colors,
        widths=[2.0] * len(series),
    )
    values = np.array(list(series.values()))
    times = StepTimes(stage=stage, count=values.shape[1], dt_s=dt_s)
    file.series(paths.WORST_NOISE, values, times=times)
