"""One rollout of a run again, alone, in a process of its own: what does the simulator do there?

A rollout that the run folder holds has the outcomes and latents that it had. One of a stage that
was not finished is sampled again from the seed, by the proposals of the finished stages: neither
depends on how many rollouts are simulated at a time.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.config.toml_files import load_config
from pemviz.errors import InputError, RunError
from pemviz.faults import SimulationError
from pemviz.pem.models.protocol import Pem
from pemviz.processes import ProcessPool
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.kept_rollout import read_kept_rollout
from pemviz.runs.reading import CONFIG, result_left
from pemviz.runs.rollout_files import (
    LATENTS,
    ROLLOUT,
    ROLLOUTS_FILE,
    latents_of,
    load_rollouts,
    stage_files,
)
from pemviz.runs.run_folder import Archive, check_resumable, going_on
from pemviz.sampling.folding import declared_signals
from pemviz.sampling.problem import Problem, nothing_finished, score
from pemviz.sampling.rollouts.apart import Apart, GivenStep, simulate_apart
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.repeat import task_of
from pemviz.sampling.rollouts.runners import BatchRunner, BatchTask
from pemviz.sampling.rollouts.simulate import LatentTrack
from pemviz.simulators.check import ROUNDING
from pemviz.types import RolloutBatch, Simulator


@dataclass(frozen=True)
class Replayed:
    """What came of a rollout that was simulated again.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        steps: Of a rollout.
        step: The one that went wrong; of a rollout that ran to the end ``steps``.
        fault: What went wrong, in one line; empty if nothing did.
        traceback_text: Of what the simulator raised, from its frames on; empty if nothing.
        state: Signals that the step at fault was given, or of the last state, by name.
        outcomes: ``[step + 1]`` that perception reported up to there, by slot; where it answers
            one thing a step under the one name ``""``.
        start: Latents at the start.
        noise: Latents of the step at fault.
        robustness: Under the run's metric; ``None`` if it did not run to the end.
        violated: Whether the specification is; likewise.
        kept: Whether the run folder holds it.
        difference: What is not as the run kept it, in words; empty if all is, or nothing kept.
        had_failed: Whether it is the one that the run ended at.
    """

    repetition: int
    stage: int
    rollout: int
    steps: int
    step: int
    fault: str
    traceback_text: str
    state: dict[str, float]
    outcomes: dict[str, tuple[bool, ...]]
    start: tuple[float, ...]
    noise: tuple[float, ...]
    robustness: float | None
    violated: bool | None
    kept: bool
    difference: str
    had_failed: bool = False

    @property
    def failed(self) -> bool:
        """Whether it did not run to the end."""
        return bool(self.fault)

    def __str__(self) -> str:
        of = f", repetition {self.repetition}" if self.repetition else ""
        lines = [f"rollout {self.rollout} of stage {self.stage}{of}"]
        lines += self._fault_lines() if self.failed else self._end_lines()
        if self.start:
            lines.append(f"latents at the start: {_numbers(self.start)}")
        for name, outcomes in self.outcomes.items():
            of_slot = f" of {name}" if name else ""
            bits = "".join(str(int(one)) for one in outcomes)
            lines.append(f"outcomes{of_slot}, 1 detected, 0 missed: {bits or 'none'}")
        return "\n".join(lines)

    def _fault_lines(self) -> list[str]:
        given = ", ".join(f"{name} {value:.6g}" for name, value in self.state.items())
        noise = f", noise {_numbers(self.noise)}" if self.noise else ""
        lines = [f"failed at step {self.step} of {self.steps}: {self.fault}"]
        return [*lines, f"the step was given: {given}{noise}"] if given else lines

    def _end_lines(self) -> list[str]:
        if not self.kept:
            same = "the run kept nothing of it"
        elif self.difference:
            same = f"not equal to what the run kept ({self.difference}): a random simulator?"
        else:
            same = "equal to what the run kept"
        verdict = "violated" if self.violated else "holds"
        end = f"ran to the end: robustness {self.robustness:.6g}, {verdict}; {same}"
        if not self.had_failed:
            return [end]
        why = "has its cause been removed, or does it depend on a count, a clock, other rollouts?"
        return [end, f"but the run ended at it: {why}"]


def replay(
    folder: Path | str,
    *,
    stage: int | None = None,
    rollout: int | None = None,
    repetition: int = 0,
    rank: int | None = None,
    experiment: Experiment | None = None,
    limit_s: float | None = None,
    allow_python: bool = False,
) -> Replayed:
    """Simulate one rollout of a run again, alone, in a process of its own.

    The program must begin its work under ``if __name__ == "__main__":``.

    Args:
        folder: The run folder, be the run done or not.
        stage: The rollout's stage, as the message of a failed run has it.
        rollout: Its number in the stage, likewise.
        repetition: Its repetition, from 0.
        rank: In place of all three: of those that the folder keeps, 1 is the least robust. It is
            taken where nothing is given.
        experiment: With a simulator of your own: what :func:`build_experiment` gave for the run.
        limit_s: A step that takes longer is a fault [s]; ``None``: the run's own limit.
        allow_python: As for :func:`build_experiment`.

    Raises:
        InputError: The run cannot be read, has no such rollout, or its method numbers none.
        RunError: Simulator or error model cannot be sent to another process.
    """
    folder = Path(folder)
    if (stage is None) != (rollout is None):
        raise InputError("stage and rollout: give both, or a rank")
    if stage is None or rollout is None:
        found = read_kept_rollout(folder, rank=1 if rank is None else rank)
        repetition, stage, rollout = found.repetition, found.stage, found.rollout
    elif rank is not None:
        raise InputError(f"rank = {rank}: give it, or stage and rollout")
    if not (folder / CONFIG).is_file():
        raise InputError(f"run {folder}: has no {CONFIG}")
    if experiment is None:
        experiment = build_experiment(load_config(folder / CONFIG), allow_python=allow_python)
    check_resumable(experiment, folder)
    place = repetition, stage, rollout
    kept = _kept(folder, experiment, place)
    problem = experiment.problem
    if kept is None:
        simulator, pem, task = _sampled(folder, experiment, place)
    else:
        simulator, pem, task = problem.simulator, problem.pem, kept.task
    limit_s = problem.step_time_limit_s if limit_s is None else limit_s
    came = simulate_apart(simulator, pem, task, limit_s=limit_s)
    replayed = _replayed(experiment, place, task, came, kept)
    return replace(replayed, had_failed=_ended_at(folder, place))


def _ended_at(folder: Path, place: tuple[int, int, int]) -> bool:
    """Whether a run failed in a rollout, by what its result says."""
    result, (repetition, stage, rollout) = result_left(folder), place
    if result is None or result.status != "failed":
        return False
    where = f"stage {stage}"
    if result.config.repetitions > 1:
        where += f", repetition {repetition + 1} of {result.config.repetitions}"
    message = result.message or ""
    return f" rollout {rollout}, " in message.replace(" (", ", (") and f"({where})" in message


@dataclass(frozen=True)
class _Kept:
    """What a run folder holds of a rollout: the task that repeats it, and signals by key."""

    task: BatchTask
    signals: dict[str, Any]


def _kept(folder: Path, experiment: Experiment, place: tuple[int, int, int]) -> _Kept | None:
    """What the folder holds of a rollout; ``None``: it does not hold it."""
    if not stage_files(folder) and not (folder / ROLLOUTS_FILE).exists():
        return None
    table = load_rollouts(folder)
    repetition, stage, rollout = place
    rows = np.flatnonzero((table["repetition"] == repetition) & (table["stage"] == stage))
    numbers = table[ROLLOUT][rows] if ROLLOUT in table else np.arange(rows.size)
    row = rows[numbers == rollout]
    if row.size == 0:
        return None
    one = {name: values[row] for name, values in table.items()}
    try:
        latents = latents_of(one)
    except ValueError as error:
        raise InputError(f"rollouts {folder}: {error}") from error
    detected, folding = one["detected"], experiment.folding
    if folding is not None:
        detected = (detected ^ ~folding.simulator.nominal).reshape(1, -1)
    signals = {n: v[0] for n, v in one.items() if not n.startswith(LATENTS)}
    return _Kept(task_of(detected, latents), signals)


def _sampled(
    folder: Path, experiment: Experiment, place: tuple[int, int, int]
) -> tuple[Simulator, Pem, BatchTask]:
    """The task of a rollout that the folder does not hold, as the run samples it."""
    repetition, stage, rollout = place
    where = f"run {folder}"
    if experiment.description.interval_basis == "runs":
        name = experiment.config.method
        message = f"{where}: {name} goes on from its rollouts; only what is kept can be repeated"
        raise InputError(message)
    if not 0 <= repetition < experiment.config.repetitions:
        most = experiment.config.repetitions - 1
        raise InputError(f"repetition = {repetition}: must be from 0 to {most}")
    going = going_on(experiment, Archive(folder, experiment.declared.signals))
    method, problem = experiment.method, going.problem
    number, state = 0, method.init(problem, repetition=repetition)
    with ProcessPool(1) as pool:  # what there still is to simulate ends no more than it
        limit_s = problem.step_time_limit_s
        loses = experiment.config.lost != "end"
        runner = PooledRunner(pool.submit, 1, renew=pool.renew, limit_s=limit_s, loses=loses)
        problem = replace(problem, run_batches=runner)
        try:
            while number < stage and not method.is_done(state):
                state, _ = method.step(problem, state)
                number += 1
            if method.is_done(state):
                raise InputError(f"stage = {stage}: {where} has the stages 0 to {number - 1}")
            sought = replace(problem, finished=nothing_finished)
            return _Finding(runner).search(method, sought, state, rollout=rollout, where=where)
        except SimulationError as error:
            error.during = f"stage {number}"
            message = f"{where} does not hold what comes before, and to simulate it fails: {error}"
            raise RunError(message, traceback_text=error.traceback_text) from error


class _AskedError(SimulationError):
    """What a stage asks to have simulated, in place of its rollouts."""

    def __init__(self, simulator: Simulator, pem: Pem, tasks: list[BatchTask]) -> None:
        super().__init__("asked for", rollouts=range(sum(len(one.uniforms) for one in tasks)))
        self.simulator, self.pem, self.tasks = simulator, pem, tasks


@dataclass
class _Finding:
    """Carries out a stage up to the batch that has a rollout; a ``BatchRunner`` meanwhile.

    How rollouts are numbered a fault alone knows: what samples them counts on it. So a fault that
    names all of a request is raised, and the request simulated if the rollout is not among them.

    Attributes:
        runner: Simulates those.
        done: Of each request that is, in order.
        asked: How many requests there were since the stage began.
    """

    runner: BatchRunner
    done: list[list[RolloutBatch]] = field(default_factory=list[list[RolloutBatch]])
    asked: int = 0

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        self.asked += 1
        if self.asked <= len(self.done):
            yield from self.done[self.asked - 1]
            return
        raise _AskedError(simulator, pem, list(tasks))

    def search(
        self, method: Any, problem: Problem, state: Any, *, rollout: int, where: str
    ) -> tuple[Simulator, Pem, BatchTask]:
        """Simulator, error model and task of the rollout.

        Raises:
            InputError: The stage has none of that number.
        """
        watched, last = replace(problem, run_batches=self, step_time_limit_s=None), -1
        while True:
            self.asked = 0
            try:
                method.step(watched, state)
            except _AskedError as error:
                asked = error
            else:
                allowed = f"must be from 0 to {last}"
                raise InputError(f"rollout = {rollout}: {allowed} in {where}")
            if asked.rollouts is not None:  # else they are none of the stage's
                last = max(last, asked.rollouts[-1])
                if rollout in asked.rollouts:
                    row = _row_of(asked.tasks, rollout - asked.rollouts[0])
                    return asked.simulator, asked.pem, row
            self.done.append(list(self.runner(asked.simulator, asked.pem, asked.tasks)))


def _replayed(
    experiment: Experiment,
    place: tuple[int, int, int],
    task: BatchTask,
    came: Apart,
    kept: _Kept | None,
) -> Replayed:
    problem, given = experiment.problem, came.given
    repetition, stage, rollout = place
    outcomes = task.uniforms.shape[1]
    start: tuple[float, ...] = ()
    if task.normals is not None:
        begun = LatentTrack.begun(task.normals, task.proposal, outcomes=outcomes)
        start = tuple(begun.latents.start[0].tolist())
    names = [signal.name for signal in declared_signals(problem.simulator)]
    state = {name: given[-1].signals[name] for name in names} if given else {}
    robustness, violated, difference = None, None, ""
    steps = outcomes // problem.turns
    step = given[-1].outcome // problem.turns if given else 0
    if came.rollouts is not None:
        scored = score(problem.without_rules(), came.rollouts)
        robustness, violated = float(scored.robustness[0]), bool(scored.violated[0])
        step, state = steps, {name: float(came.rollouts.signals[name][0, -1]) for name in names}
        difference = "" if kept is None else _difference(experiment, came.rollouts, kept)
    return Replayed(
        repetition=repetition,
        stage=stage,
        rollout=rollout,
        steps=steps,
        step=step,
        fault=came.fault,
        traceback_text=came.traceback_text,
        state=state,
        outcomes=_by_slot(experiment, given),
        start=start,
        noise=given[-1].noise if given and came.rollouts is None else (),
        robustness=robustness,
        violated=violated,
        kept=kept is not None,
        difference=difference,
    )


def _by_slot(experiment: Experiment, given: Sequence[GivenStep]) -> dict[str, tuple[bool, ...]]:
    """What perception reported, step by step; with slots, by their names."""
    nominal = [one.detected for one in given]
    if experiment.folding is None:
        return {"": tuple(nominal)}
    slots = experiment.folding.simulator.slots
    return {
        slot.name: tuple(one == slot.nominal for one in nominal[number :: len(slots)])
        for number, slot in enumerate(slots)
    }


def _difference(experiment: Experiment, rollouts: RolloutBatch, kept: _Kept) -> str:
    """Which signal is not as it was kept, where first; empty if all are."""
    folding = experiment.folding
    signals = rollouts.signals if folding is None else folding.signals(rollouts.signals)
    for signal in experiment.declared.signals:
        was, now = kept.signals[signal.key], signals[signal.name][0]
        scale = np.maximum(np.abs(was), signal.high - signal.low)
        other = np.flatnonzero(~(np.abs(now - was) <= ROUNDING * scale))
        if other.size:
            step = int(other[0])
            return f"{signal.name} {was[step]:.6g} and now {now[step]:.6g} at step {step}"
    return ""


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _row_of(tasks: list[BatchTask], row: int) -> BatchTask:
    for task in tasks:
        if row < len(task.uniforms):
            return task.take(slice(row, row + 1))
        row -= len(task.uniforms)
    raise IndexError(row)
