"""Observers for programs: the least robust rollout of a run, and every stage, kept whole."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.runs.drawn_rollout import faultless, right_by_slot, slots_of
from pemviz.runs.events import Event, RunStarted, StageDone
from pemviz.runs.result import RankedRollout
from pemviz.simulators.slots import Slot
from pemviz.types import ShownInNotebooks, StageResult, place_of


@dataclass(frozen=True)
class Rollout(ShownInNotebooks):
    """One rollout.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        robustness: Under the run's metric.
        violated: Whether the formula fails, see :func:`pemviz.stl.violated`.
        nll: Negative log-likelihood of its outcomes under the error model [nats].
        time_s: ``[T]`` times of its states [s].
        signals: ``[T]`` by name.
        detected: ``[T-1]`` perception's outcomes; with several slots, whether none of them errs.
        right_by_slot: ``[T-1]`` whether each of several slots does not err, by its name.
        start: ``[S]`` latents at its start, where the simulator takes some.
        noise: ``[T-1, M]`` latents of its steps, likewise.
        rank: From 1, the least robust of those that carry the answer.
    """

    repetition: int
    stage: int
    robustness: float
    violated: bool
    nll: float
    time_s: FloatArray
    signals: Mapping[str, FloatArray]
    detected: BoolArray
    right_by_slot: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])
    start: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    rank: int = 1

    @property
    def missed_steps(self) -> IntArray:
        """Steps at which perception missed, ascending."""
        return np.flatnonzero(~self.detected)

    def __str__(self) -> str:
        ranges = [f"{n} {np.min(v):.3g} to {np.max(v):.3g}" for n, v in self.signals.items()]
        verdict, latents = "violates" if self.violated else "holds", ""
        if self.start.size:
            latents = f"latents at the start {', '.join(f'{z:.2f}' for z in self.start)}; "
        if self.noise.size:
            latents += f"noise {np.min(self.noise):.2f} to {np.max(self.noise):.2f}; "
        name = "least robust rollout" if self.rank == 1 else f"rollout of rank {self.rank}"
        return (
            f"{name}: {verdict}, robustness {self.robustness:.3g}, stage "
            f"{self.stage}; {self._errors_text()}; {latents}{', '.join(ranges)}; "
            f"NLL {self.nll:.3g} nats"
        )

    def _errors_text(self) -> str:
        steps, missed = self.detected.size, self.missed_steps
        if not self.right_by_slot:
            return f"misses {missed.size} of {steps} steps ({_runs_text(missed)})"
        errors = {name: np.flatnonzero(~right) for name, right in self.right_by_slot.items()}
        texts = [f"{name} at {at.size} ({_runs_text(at)})" for name, at in errors.items()]
        return f"of {steps} steps perception errs about {', '.join(texts)}"


class LeastRobust:
    """Observer that keeps the least robust rollout that carries the answer, as far as a run is.

    Which one that is, :attr:`pemviz.runs.result.RunResult.least_robust` says.

    Attributes:
        rollout: The rollout; ``None`` before the first stage is done.
    """

    def __init__(self) -> None:
        self.rollout: Rollout | None = None
        self._dt_s = 1.0
        self._slots: tuple[Slot, ...] = ()

    def __str__(self) -> str:
        return "no rollout yet" if self.rollout is None else str(self.rollout)

    def notify(self, event: Event) -> None:
        """Look at the rollouts of every stage."""
        match event:
            case RunStarted():
                self._dt_s, self._slots = event.simulator.dt_s, slots_of(event.simulator)
            case StageDone():
                first, stage = event.result.least_robust[0], event.stage
                if (first.repetition, first.stage) == (stage.repetition, stage.stage):
                    self.rollout = self._kept(first, stage)
            case _:
                pass

    def _kept(self, first: RankedRollout, stage: StageResult) -> Rollout:
        rollouts, index = stage.scored.rollouts, place_of(first.rollout, stage.sampled)
        detected, latents = rollouts.detected[index], rollouts.latents
        rollout = Rollout(
            repetition=stage.repetition,
            stage=stage.stage,
            robustness=first.robustness,
            violated=first.violated,
            nll=first.nll,
            time_s=np.arange(rollouts.detected.shape[1] + 1) * self._dt_s,
            signals={name: np.array(values[index]) for name, values in rollouts.signals.items()},
            detected=np.array(faultless(detected, slots=self._slots)),
            right_by_slot=right_by_slot(detected, slots=self._slots),
        )
        if latents is None:
            return rollout
        start, noise = np.array(latents.start[index]), np.array(latents.noise[index])
        return replace(rollout, start=start, noise=noise)


def _runs_text(steps: IntArray) -> str:
    """Ascending steps as runs: ``0-3, 7``."""
    if steps.size == 0:
        return "none"
    runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1)
    return ", ".join(f"{r[0]}-{r[-1]}" if r.size > 1 else f"{r[0]}" for r in runs)


class KeptStages:
    """Observer that keeps all stages; a large run's rollouts take memory accordingly.

    With ``keep = "violations"`` a large stage that is learned from may hold some of its rollouts
    alone, see :attr:`pemviz.types.StageResult.sampled`.

    Attributes:
        started: What the run reported at its start; ``None`` before.
        stages: Every stage that is done, of all repetitions.
    """

    def __init__(self) -> None:
        self.started: RunStarted | None = None
        self.stages: list[StageResult] = []

    def notify(self, event: Event) -> None:
        """Keep what a stage brings; a new run replaces an earlier one."""
        match event:
            case RunStarted():
                self.started, self.stages = event, []
            case StageDone():
                self.stages.append(event.stage)
            case _:
                pass
