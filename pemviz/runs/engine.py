"""The engine: runs an experiment and tells observers what happens."""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import metadata
from typing import Any

from pemviz._version import __version__
from pemviz.analysis.explanation import explain
from pemviz.analysis.model_uncertainty import (
    ENOUGH_FAILURES,
    data_bound,
    extrapolation_warnings,
    member_estimates,
    model_interval,
)
from pemviz.arrays import read_only
from pemviz.config import ExperimentConfig
from pemviz.errors import PemvizError, RunError
from pemviz.pem import PemEnsemble
from pemviz.pem.judging.reweight import MemberEstimates
from pemviz.runs.events import (
    Observer,
    RepetitionDone,
    RolloutsDone,
    RunDone,
    RunFailed,
    RunStarted,
    StageDone,
    notify_all,
)
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.result import PemInfo, RunResult, with_stage
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.problem import Problem
from pemviz.sampling.value_twisted.reference import agreement_warning, reference
from pemviz.types import StageResult

VERSIONED = ("numpy", "scipy", "torch", "highway-env", "rerun-sdk", "viser")

ASSUMPTIONS = (
    "perception never reports an obstacle that is not there",
    "misses are independent of each other given the state",
    "there is one obstacle, the lead car",
    "the dynamics are those of the simulator, not of a real car",
    "the perception error model holds where the scenario goes, beyond its training data too",
)
OWN_SYSTEM_ASSUMPTIONS = (
    "perception reports one thing, detected or not, at every step",
    "misses are independent of each other given the state",
    "the simulator says how the system behaves; it gives the same again for the same outcomes",
    "the detector model holds where the scenario goes",
)


class _StopRequested(Exception):  # noqa: N818  not an error: the user asked
    """Raised between batches when the run is to stop."""


def run_experiment(
    config: ExperimentConfig,
    *,
    run_id: str = "run",
    observers: Sequence[Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Validate ``config``, run it and return its result.

    Args:
        config: What is asked.
        run_id: The run's name in its result.
        observers: Told of everything that happens; they do not change the result.
        should_stop: Asked between batches of rollouts.

    Raises:
        InputError: The configuration is wrong; observers hear nothing.
        RunError: The run failed; observers have heard :class:`RunFailed`.
    """
    return run(
        build_experiment(config), run_id=run_id, observers=observers, should_stop=should_stop
    )


def run(
    experiment: Experiment,
    *,
    run_id: str = "run",
    observers: Sequence[Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Run an experiment that is already built; see :func:`run_experiment`."""
    runner = _Runner(experiment, run_id, observers, should_stop)
    try:
        runner.carry_out()
    except _StopRequested:
        pass
    except KeyboardInterrupt:
        runner.finish("stopped")
        raise
    except Exception as error:  # a simulator or model of the user's may raise anything
        message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        runner.fail(message)
        raise RunError(message) from error
    return runner.finish("done" if runner.complete else "stopped")


class _Runner:
    """Carries a run's mutable progress; everything it hands out is frozen."""

    def __init__(
        self,
        experiment: Experiment,
        run_id: str,
        observers: Sequence[Observer],
        should_stop: Callable[[], bool],
    ) -> None:
        self._experiment = experiment
        self._observers = observers
        self._should_stop = should_stop
        self._began = time.perf_counter()
        self._result = _empty_result(experiment, run_id)
        self._members: list[MemberEstimates] = []
        self._explained: tuple[int, int] | None = None
        self.complete = False

    def carry_out(self) -> None:
        experiment = self._experiment
        notify_all(
            self._observers,
            RunStarted(
                config=experiment.config,
                signals=experiment.problem.simulator.signals,
                simulator=experiment.problem.simulator,
                stages=experiment.method.stages,
                planned_rollouts=experiment.planned_rollouts,
                result=self._result,
            ),
        )
        for repetition in range(experiment.config.repetitions):
            self._repeat(repetition)
        self._compare()
        self.complete = True

    def finish(self, status: Any) -> RunResult:
        self._result = replace(self._result, status=status)
        self._time()
        notify_all(self._observers, RunDone(result=self._result))
        return self._result

    def fail(self, message: str) -> None:
        self._result = replace(self._result, status="failed", message=message)
        self._time()
        event = RunFailed(message=message, result=self._result)
        for observer in self._observers:
            # the observer that failed the run may fail again; the others must still hear
            with contextlib.suppress(OSError, ValueError, PemvizError):
                observer.notify(event)

    def _repeat(self, repetition: int) -> None:
        method = self._experiment.method
        problem = self._stoppable(self._experiment.problem)
        state = method.init(problem, repetition=repetition)
        stage = 0
        while not method.is_done(state):
            watched = replace(problem, progress=self._progress(repetition, stage))
            state, result = method.step(watched, state)
            self._tell_stage(result)
            self._judge(result)
            stage += 1
        estimate = method.estimate(state)
        estimates = (*self._result.repetitions, estimate)
        self._result = replace(
            self._result, repetitions=estimates, estimate=summarise_repetitions(estimates)
        )
        self._time()
        notify_all(
            self._observers,
            RepetitionDone(repetition=repetition, estimate=estimate, result=self._result),
        )

    def _judge(self, stage: StageResult) -> None:
        """From a repetition's final rollouts: causes, other models' answers, thin data."""
        experiment = self._experiment
        if stage.kind != "final" or not experiment.has_likelihood_ratios:
            return
        self._explain(stage)
        if experiment.ensemble is not None and self._failures_before(stage) < ENOUGH_FAILURES:
            self._ask_members(stage, experiment.ensemble)
        if not self._result.warnings:
            self._judge_data(stage)

    def _failures_before(self, stage: StageResult) -> int:
        """In earlier parts of the same repetition's final batch."""
        return sum(
            s.failures
            for s in self._result.stages
            if (s.repetition, s.kind) == (stage.repetition, "final") and s.stage < stage.stage
        )

    def _ask_members(self, stage: StageResult, ensemble: PemEnsemble) -> None:
        simulator = self._experiment.problem.simulator
        found = member_estimates(stage.scored, simulator=simulator, ensemble=ensemble)
        self._members.append(found)
        if any(s.failures for s in self._result.stages if s.kind == "final"):
            interval = model_interval(self._members)
            self._result = replace(self._result, pem_interval=interval)

    def _explain(self, stage: StageResult) -> None:
        """Of a final batch in parts, the part with most failures explains best."""
        known = self._explained
        if known and known[0] == stage.repetition and known[1] >= stage.failures:
            return
        experiment = self._experiment
        explanation = explain(
            stage,
            features=experiment.features,
            farthest_m=experiment.back_end.farthest_m,
            target=experiment.config.target,
        )
        if explanation is not None:
            self._explained = stage.repetition, stage.failures
            self._result = replace(self._result, explanation=explanation)

    def _judge_data(self, stage: StageResult) -> None:
        """Once a run: where the model extrapolates, and what its data alone allow."""
        experiment = self._experiment
        warnings = extrapolation_warnings(
            stage.scored, simulator=experiment.problem.simulator, pem=experiment.pem
        )
        bound = None
        if experiment.twin is not None:
            twin = replace(self._stoppable(experiment.problem), simulator=experiment.twin)
            bound = data_bound(twin, pem=experiment.pem, seed=experiment.config.seed)
        if bound is not None:
            warnings = (
                *warnings,
                "the training data alone, without the model's guesses, allow a failure "
                f"probability up to {bound.probability:.1g} ({bound.confidence:.0%})",
            )
        self._result = replace(self._result, warnings=warnings, data_bound=bound)

    def _compare(self) -> None:
        """The reference beside the estimate, with a warning where they disagree."""
        experiment, estimate = self._experiment, self._result.estimate
        twin = experiment.twin
        if not experiment.config.reference or estimate is None or twin is None:
            return
        known = reference(self._stoppable(experiment.problem), twin=twin)
        disagreement = agreement_warning(estimate, known)
        warnings = self._result.warnings + ((disagreement,) if disagreement else ())
        self._result = replace(self._result, reference=known, warnings=warnings)

    def _progress(self, repetition: int, stage: int) -> Callable[[int, int], None]:
        def progress(done: int, total: int) -> None:
            notify_all(
                self._observers,
                RolloutsDone(repetition=repetition, stage=stage, done=done, total=total),
            )
            self._pause()

        return progress

    def _stoppable(self, problem: Problem) -> Problem:
        """The problem with a stop between batches and during long work."""

        def progress(done: int, total: int) -> None:  # noqa: ARG001
            self._pause()

        return replace(problem, progress=progress, pause=self._pause)

    def _pause(self) -> None:
        if self._should_stop():
            raise _StopRequested

    def _tell_stage(self, stage: StageResult) -> None:
        frozen = replace(stage, scored=stage.scored.map(read_only))
        self._result = with_stage(self._result, frozen)
        self._time()
        notify_all(self._observers, StageDone(stage=frozen, result=self._result))

    def _time(self) -> None:
        total_s = time.perf_counter() - self._began
        self._result = replace(self._result, timings_s={**self._result.timings_s, "total": total_s})


def _empty_result(experiment: Experiment, run_id: str) -> RunResult:
    """The result before anything is simulated; 'stopped' is what a killed run leaves."""
    pem = experiment.pem
    return RunResult(
        run_id=run_id,
        status="stopped",
        config=experiment.config,
        pem=PemInfo(name=pem.name, digest=pem.digest, data=pem.data),
        versions=versions(),
        assumptions=OWN_SYSTEM_ASSUMPTIONS if experiment.is_own_system else ASSUMPTIONS,
    )


def versions() -> dict[str, str]:
    """Versions of pemviz and of what its results may depend on, by package."""
    found = {"pemviz": __version__}
    for name in VERSIONED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
