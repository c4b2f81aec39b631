"""The engine: runs an experiment and notifies observers of what happens."""

import contextlib
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import metadata
from typing import Any

from threadpoolctl import threadpool_limits

from pemviz import faults
from pemviz._version import __version__
from pemviz.arrays import read_only
from pemviz.config import ExperimentConfig, Rule
from pemviz.errors import PemvizError, RunError, one_line
from pemviz.runs import events, supplements
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.interpretation import (
    Interpreted,
    interpret,
    interpret_repetition,
    refits_of,
)
from pemviz.runs.losses import LostOfRepetition, LostWeights, with_lost
from pemviz.runs.own_code import own_system
from pemviz.runs.ranking import with_stage
from pemviz.runs.rates import assumed_encounters
from pemviz.runs.result import LostRollouts, PemInfo, RuleAnswer, RunResult, memory_of
from pemviz.runs.specification import may_leave_bounds
from pemviz.runs.workers import with_workers
from pemviz.sampling.estimates.diagnostics import not_repeatable
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.kept import KeepsColumns
from pemviz.sampling.method import (
    AnswersRules,
    Foreseen,
    ForeseesRollouts,
    LearnsOnSurrogate,
    Method,
    PoolsStages,
    SurrogateLearning,
)
from pemviz.sampling.rollouts.repeat import (
    RepeatedAhead,
    Repeats,
    SomeOfStage,
    repeated,
    to_repeat,
)
from pemviz.simulators.detector_loop import DetectorItself
from pemviz.simulators.latents import latent_counts
from pemviz.simulators.own_randomness import fixed_randomness
from pemviz.types import Estimate, ScoredRollouts, StageResult

VERSIONED = ("numpy", "scipy", "torch", "highway-env", "rerun-sdk", "viser")

LATENTS = "beside perception, independent standard normals that the simulator maps are random"
ONE_COURSE = (
    "what the simulator samples at random of its own is the same in every rollout, as it states: "
    "the answer is for this one course of it"
)
OBSERVED = (
    "the detector itself is in the loop, and says of rendered images what it would say on the road"
)
INDEPENDENT = "misses are independent of each other given the state"
BOUNDED = "metric agm, which ranks rollouts and no more, counts what is beyond a bound as the bound"
ASSUMPTIONS = (
    "perception never reports an obstacle that is not there",
    "there is one obstacle, the lead car",
    "the dynamics are those of the simulator, not of a real car",
    "the perception error model holds where the scenario goes, beyond its training data too",
)
OWN_SYSTEM_ASSUMPTIONS = (
    "perception reports one thing, detected or not, at every step",
    "the simulator says how the system behaves; it gives the same again for the same outcomes",
    "the detector model holds where the scenario goes",
)


def run_experiment(
    config: ExperimentConfig,
    *,
    run_id: str = "run",
    observers: Sequence[events.Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Validate ``config``, run it and return its result.

    Args:
        config: The configuration.
        run_id: The run's name in its result.
        observers: Notified of everything that happens; they do not change the result.
        should_stop: Called several times a second; ends the run at its next step.

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
    observers: Sequence[events.Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: bool = False,
    before_s: float = 0.0,
) -> RunResult:
    """Run an experiment that is already built.

    Args:
        experiment: What :func:`build_experiment` gives.
        run_id: The run's name in its result.
        observers: Notified of everything that happens; they do not change the result.
        should_stop: Called several times a second; ends the run at its next step.
        workers: So many processes of this machine simulate the rollouts, to the same result; the
            program must then begin its work under ``if __name__ == "__main__":``.
        scheduler: The workers of the Dask cluster do whose scheduler has this address.
        progress: Show on standard error how far the run is: a bar on a terminal, lines elsewhere.
        before_s: What a run took that is gone on with, until it was interrupted [s].

    Raises:
        ConfigError: Workers are of no use, or the cluster cannot be used; nothing was simulated.
        RunError: The run failed. What a simulator, an error model or a method of the user's raised
            is its cause, SystemExit and KeyboardInterrupt included.
        KeyboardInterrupt: A signal's; the run has stopped.
    """

    def pause(*_: int) -> None:
        if should_stop():
            raise faults.StopRequested

    with (
        _shown(progress) as shown,
        with_workers(experiment, workers=workers, scheduler=scheduler, pause=pause) as worked,
    ):
        runner = _Runner(worked, run_id, [*shown, *observers], pause, before_s=before_s)
        return _run(runner)


@contextlib.contextmanager
def _shown(progress: bool) -> Generator[Sequence[events.Observer]]:
    if not progress:
        yield ()
        return
    from pemviz.runs.progress import progress_observer  # noqa: PLC0415  rich is slow to import

    with progress_observer() as observer:
        yield (observer,)


def _run(runner: "_Runner") -> RunResult:
    with faults.signals_distinguished():
        try:
            # matrices are small: threads that wait for each other cost more than they bring, most
            # of all beside another run, and the last digit would depend on their number
            with threadpool_limits(limits=1, user_api="blas"):
                runner.carry_out()
        except faults.StopRequested:
            pass
        except BaseException as raised:
            error = faults.presentable(raised)
            outside = faults.from_outside(error)
            if outside is not None:
                runner.finish("stopped")
                raise outside  # noqa: B904  what led to the error
            cause = error.__cause__ if isinstance(error, faults.SimulationError) else None
            raise runner.failed(error) from cause or error  # what the user's code raised
        return runner.finish("done" if runner.complete else "stopped")


class _Runner:
    """Carries a run's mutable progress; everything it hands out is frozen."""

    def __init__(
        self,
        experiment: Experiment,
        run_id: str,
        observers: Sequence[events.Observer],
        pause: Callable[..., None],
        *,
        before_s: float,
    ) -> None:
        problem = replace(experiment.problem, progress=pause, pause=pause)
        self._experiment = replace(experiment, problem=problem)
        self._observers = observers
        self._pause = pause
        self._began = time.perf_counter() - before_s
        self._interpreted = Interpreted(_empty_result(experiment, run_id))
        self._by_rule: list[Mapping[str, Estimate]] = []
        self._repeats = Repeats()
        self._lost = LostWeights()
        self._at: tuple[int, int] | None = None
        self._observers_error: BaseException | None = None
        self.complete = False

    def carry_out(self) -> None:
        experiment = self._experiment
        self._notify(
            events.RunStarted(
                config=experiment.config,
                signals=experiment.declared.signals,
                simulator=experiment.declared,
                pem=experiment.pem,
                stages=experiment.method.stages,
                planned_rollouts=experiment.planned_rollouts,
                result=self._interpreted.result,
            ),
        )
        for repetition in range(experiment.config.repetitions):
            self._repeat(repetition)
        experiment = replace(experiment, twin_doubt=self._twin_doubt())
        for add in supplements.IN_ORDER:
            self._keep(add(self._interpreted.result, experiment=experiment))
        self.complete = True

    def _twin_doubt(self) -> str:
        """What is wrong with all that a fast twin tells; a warning of the result too."""
        found, result = self._repeats, self._interpreted.result
        if found.twin_differing == 0:
            return ""
        doubt = (
            f"the fast twin is another system: its verdict on {found.twin_differing} of "
            f"{found.on_twin} rollouts with the same outcomes is not the simulator's"
        )
        self._keep(replace(result, warnings=(*result.warnings, doubt)))
        return doubt

    def finish(self, status: Any) -> RunResult:
        result = self._keep(replace(self._interpreted.result, status=status))
        self._notify(events.RunDone(result=result))
        return result

    def failed(self, error: BaseException) -> RunError:
        """Notify the observers; the error is for the caller."""
        ours = error is self._observers_error or isinstance(error, PemvizError)
        text = getattr(error, "traceback_text", "") if ours else faults.traceback_of(error)
        rollout, message = self._rollout_of(error), self._placed(error)
        result = self._keep(replace(self._interpreted.result, status="failed", message=message))
        event = events.RunFailed(message=message, result=result)
        for observer in self._observers:
            # the observer that failed the run may fail again; the others must still hear
            with contextlib.suppress(OSError, ValueError, PemvizError):
                self._notify(event, observer)
        return RunError(message, traceback_text=text, rollout=rollout)

    def _rollout_of(self, error: BaseException) -> tuple[int, int, int] | None:
        """Repetition, stage and number of the rollout that an error names, if it names one."""
        rollouts = error.rollouts if isinstance(error, faults.SimulationError) else None
        if self._at is None or rollouts is None or len(rollouts) != 1:
            return None
        if self._experiment.description.interval_basis == "runs":  # they go on from each other
            return None
        repetition, stage = self._at
        return repetition, stage + getattr(error, "ahead", 0), rollouts[0]

    def _placed(self, error: BaseException) -> str:
        """What went wrong, and in which stage."""
        if self._at is None:
            if isinstance(error, faults.SimulationError):  # of others than a stage's
                error.rollouts = error.among = None
            return (
                str(error)
                if isinstance(error, PemvizError)
                else one_line(faults.exception_text(error))
            )
        (repetition, stage), repetitions = self._at, self._experiment.config.repetitions
        of = f", repetition {repetition + 1} of {repetitions}" if repetitions > 1 else ""
        if isinstance(error, faults.SimulationError):
            error.during = f"stage {stage + error.ahead}{of}"
            return str(error)
        what = str(error) if isinstance(error, PemvizError) else faults.exception_text(error)
        return one_line(f"{what} (stage {stage}{of})")

    def _repeat(self, repetition: int) -> None:
        method, problem = self._experiment.method, self._experiment.problem
        state, stage, some = method.init(problem, repetition=repetition), 0, list[SomeOfStage]()
        lost = LostOfRepetition()

        def progress(done: int, total: int, *, again: bool = False) -> None:
            told = events.RolloutsDone(repetition, stage, done=done, total=total, again=again)
            self._notify(told)
            self._pause()

        def searched(count: int) -> None:
            self._notify(events.RolloutsSearched(repetition, stage, count))
            self._pause()

        ahead = RepeatedAhead(problem)
        watched = replace(problem, progress=progress, searched=searched, seen=ahead.saw)
        while not method.is_done(state):
            self._at = repetition, stage
            state, result = method.step(watched, state)
            some.append(to_repeat(problem, result))
            self._at = None
            if problem.lost != "end":
                lost = lost.with_stage(result, problem)
                told = (self._lost + lost.weighed()).told(problem)
                self._keep(replace(self._interpreted.result, lost=told))
            foresees = isinstance(method, ForeseesRollouts)
            self._notify_of_stage(result, method.foreseen(state) if foresees else None)
            for interpreted in interpret(
                self._interpreted, experiment=self._experiment, stage=result
            ):
                self._interpreted = interpreted
            stage += 1
        self._interpreted = interpret_repetition(
            self._interpreted, experiment=self._experiment, state=state
        )
        # of all stages at once: with many workers each would take as long as all do
        watched = replace(problem, progress=partial(progress, again=True))
        repeats = repeated(watched, some, twin=self._experiment.twin, ahead=ahead)
        self._repeats += repeats
        rules = self._experiment.config.rules
        pooled = method.pooled_log_weight(state) if isinstance(method, PoolsStages) else None
        weighed = lost.weighed(pooled)
        self._lost += weighed
        noted = partial(_noted, repeats=repeats, lost=weighed.told(problem))
        estimate = noted(method.estimate(state))
        estimates = (*self._interpreted.result.repetitions, estimate)
        by_rule = estimates_by_rule(method, state, rules)
        self._by_rule.append({name: noted(found) for name, found in by_rule.items()})
        answers: list[RuleAnswer] = []
        for rule in rules:
            whole = summarise_repetitions([found[rule.name] for found in self._by_rule])
            refits = refits_of(self._interpreted, rule.name)
            answers.append(RuleAnswer(rule.name, rule.formula, whole, refits=refits))
        result = replace(
            self._interpreted.result,
            repetitions=estimates,
            estimate=summarise_repetitions(estimates),
            rules=tuple(answers),
            surrogate=self._with_surrogate(state),
            lost=self._lost.told(problem),
        )
        self._notify(
            events.RepetitionDone(
                repetition=repetition,
                estimate=estimate,
                result=self._keep(result),
                columns=method.kept_columns(state) if isinstance(method, KeepsColumns) else {},
            )
        )

    def _with_surrogate(self, state: object) -> SurrogateLearning | None:
        """What repetitions so far have learned on a surrogate, this one's among them."""
        method, result = self._experiment.method, self._interpreted.result
        here = method.surrogate_learning(state) if isinstance(method, LearnsOnSurrogate) else None
        before, done = result.surrogate, len(result.repetitions)
        if here is None or before is None:
            return here or before
        probability = (done * before.probability + here.probability) / (done + 1)
        return replace(here, rollouts=before.rollouts + here.rollouts, probability=probability)

    def _notify(self, event: events.Event, *only: events.Observer) -> None:
        """Of what observers raise, a KeyboardInterrupt counts as a person's."""
        try:
            events.notify_all(only or self._observers, event)
        except BaseException as error:
            self._observers_error = error
            if isinstance(error, KeyboardInterrupt):
                faults.mark_from_outside(error)
            if isinstance(error, Exception | KeyboardInterrupt):
                raise
            message = f"an observer raises {faults.exception_text(error)}"
            raise RunError(message, traceback_text=faults.traceback_of(error)) from error

    def _notify_of_stage(self, stage: StageResult, foreseen: Foreseen | None) -> None:
        result = self._keep(with_stage(self._interpreted.result, stage))
        folding = self._experiment.folding
        scored = stage.scored if folding is None else folding.scored(stage.scored)
        frozen = replace(stage, scored=_frozen(scored))
        self._notify(events.StageDone(stage=frozen, result=result, foreseen=foreseen))

    def _keep(self, result: RunResult) -> RunResult:
        """Keep what is known by now, with the time that it took."""
        total_s = time.perf_counter() - self._began
        timed = replace(result, timings_s={**result.timings_s, "total": total_s})
        self._interpreted = replace(self._interpreted, result=timed)
        return timed


def _noted(estimate: Estimate, *, repeats: Repeats, lost: LostRollouts | None) -> Estimate:
    """The estimate with what is wrong where rollouts were not the same again, or were lost."""
    estimate = with_lost(estimate, lost)
    found = not_repeatable(
        repeated=repeats.count, differing=repeats.differing, example=repeats.example
    )
    return replace(estimate, diagnostics=(*found, *estimate.diagnostics))


def _frozen(scored: ScoredRollouts) -> ScoredRollouts:
    """What cannot be written to; likelihoods that are computed, read-only as they are, stay so."""
    frozen = scored.map(read_only)
    computed = {n: v for n, v in vars(scored.rollouts).items() if n.startswith("log_")}
    vars(frozen.rollouts).update(computed)
    return frozen


def _empty_result(experiment: Experiment, run_id: str) -> RunResult:
    """The result before anything is simulated; 'stopped' is what a killed run leaves."""
    pem, errors = experiment.pem, experiment.back_end.position_errors
    return RunResult(
        run_id=run_id,
        status="stopped",
        config=experiment.config,
        pem=PemInfo(name=pem.name, digest=pem.digest, data=pem.data),
        versions=versions(),
        simulator=own_system(experiment),
        memory=None if isinstance(pem, DetectorItself) else memory_of(pem),
        latents=latent_counts(experiment.problem.simulator) or None,
        position_errors=None
        if errors is None
        else PemInfo(name=errors.name, digest=errors.digest, data=errors.card.data),
        assumptions=_assumptions(experiment),
        warnings=experiment.warnings,
    )


def _assumptions(experiment: Experiment) -> tuple[str, ...]:
    config, position_errors = experiment.config, experiment.back_end.position_errors
    first, *others = OWN_SYSTEM_ASSUMPTIONS if experiment.is_own_system else ASSUMPTIONS
    if latents := latent_counts(experiment.problem.simulator):
        others = [f"{LATENTS}: {latents}", *others]
    if fixed_randomness(experiment.problem.simulator):
        others = [ONE_COURSE, *others]
    if config.encounters_per_hour is not None:
        others = [*others, assumed_encounters(config.encounters_per_hour)]
    if position_errors is not None:
        report, several = position_errors.card.report, experiment.is_own_system
        largest = f"{report['axes'][0]['largest']:.3g} m" if report else "not reported"
        measured = "measured places, each slot's on its own" if several else "the measured distance"
        others = [
            f"the ego brakes by {measured}, off as position errors {position_errors.name} say; the "
            f"largest error in their data is {largest}, larger ones are the word of their tails",
            *others,
        ]
    if config.metric == "agm" and may_leave_bounds(experiment.problem.simulator):
        others = [*others, BOUNDED]
    if experiment.folding is not None:
        slots = experiment.folding.simulator.slots
        alone = "" if len(slots) == 1 else "; errors of slots are independent given the state"
        names = ", ".join(slot.name for slot in slots)
        first = f"perception reports something or nothing, at every step, for {names}{alone}"
    memory = memory_of(experiment.pem)
    if isinstance(experiment.pem, DetectorItself):
        return (OBSERVED, *(other for other in others if other != OWN_SYSTEM_ASSUMPTIONS[-1]))
    if memory.is_independent:
        return (first, INDEPENDENT, *others)
    tau_s, frailty = memory.tau_s, memory.frailty
    how = [f"with a memory time of {tau_s:.3g} s"] if tau_s else []
    how += [f"by objects differing, frailty {frailty:.3g}, all rollout long"] if frailty else []
    how += [f"by {label}" for label in memory.hidden]
    bursts = f"given the state, misses hang together {' and '.join(how)}, and no more"
    return (first, bursts, *others)


def versions() -> dict[str, str]:
    """Versions of pemviz and of what its results may depend on, by package."""
    by_package = {"pemviz": __version__}
    for name in VERSIONED:
        with contextlib.suppress(metadata.PackageNotFoundError):
            by_package[name] = metadata.version(name)
    return by_package


def estimates_by_rule(
    method: Method[Any], state: Any, rules: Sequence[Rule]
) -> Mapping[str, Estimate]:
    """Each rule's estimate by a repetition that is done.

    Raises:
        TypeError: The method answers none.
    """
    if not rules:
        return {}
    if not isinstance(method, AnswersRules):
        raise TypeError(f"method {method.name} answers no rules")
    return {rule.name: method.estimate(method.under_rule(state, rule.name)) for rule in rules}
