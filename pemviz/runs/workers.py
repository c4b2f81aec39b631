"""Who simulates a run's rollouts: this process, several of this machine, or a cluster."""

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace

from pemviz.cluster import Cluster
from pemviz.errors import ConfigError
from pemviz.processes import ProcessPool, can_be_sent
from pemviz.runs.experiment import Experiment
from pemviz.runs.own_code import own_system
from pemviz.sampling.rollouts.pooled import PooledRunner


def check_one_kind(*, workers: int | None, scheduler: str | None) -> None:
    """Refuse processes of this machine and a cluster at once.

    Raises:
        ConfigError: Both are given.
    """
    if workers is not None and scheduler is not None:
        message = f"workers = {workers} and scheduler = {scheduler}: give only one of them"
        raise ConfigError(message)


def check_workers(experiment: Experiment, *, workers: int | None, scheduler: str | None) -> None:
    """Refuse workers where they could not help.

    Raises:
        ConfigError: Both kinds are given, there are to be none, the simulator or method has no
            use for any, or the scheduler's address is none.
    """
    check_one_kind(workers=workers, scheduler=scheduler)
    if workers is None and scheduler is None:
        return
    if workers is not None and workers < 1:
        message = f"workers = {workers}: must be at least 1"
        raise ConfigError(message)
    given = f"workers = {workers}" if scheduler is None else f"scheduler = {scheduler}"
    useless = no_use(experiment)
    if useless:
        raise ConfigError(f"{given}: {useless}")
    if scheduler is not None:
        Cluster(scheduler)


def no_use(experiment: Experiment) -> str:
    """Why workers could not help; empty where they can."""
    config = experiment.config
    if config.simulator == "vectorized" and not experiment.is_own_system:
        return "the vectorized simulator has no use for it; try simulator highway-env"
    if "restarts" in experiment.description.needs:
        return f"{config.method} simulates in this process alone; leave it out"
    return ""


def own_process(experiment: Experiment) -> int | None:
    """One worker, where other people's simulator can be kept out of this process; else ``None``.

    What it does there, an abort included, is survived.
    """
    problem = experiment.problem
    if own_system(experiment) is None or no_use(experiment):
        return None
    return 1 if can_be_sent(problem.simulator, problem.pem) else None


@contextmanager
def with_workers(
    experiment: Experiment,
    *,
    workers: int | None,
    scheduler: str | None,
    pause: Callable[[], None] = lambda: None,
) -> Generator[Experiment, None, None]:
    """Yield the experiment with its rollouts simulated by these; what died is told on stderr.

    ``pause`` is called now and then while they are waited for, and may raise.

    Raises:
        ConfigError: These could not help, see :func:`check_workers`, or the cluster cannot be used.
    """
    check_workers(experiment, workers=workers, scheduler=scheduler)
    limit_s, loses = experiment.problem.step_time_limit_s, experiment.config.lost != "end"
    if scheduler is not None:
        with Cluster(scheduler) as cluster:
            runner = PooledRunner(
                cluster.executor().submit,
                cluster.count,
                recount=lambda: cluster.count,
                is_there=lambda: cluster.is_there,
                limit_s=limit_s,
                pause=pause,
                loses=loses,
            )
            yield _simulated_by(experiment, runner)
    elif workers is not None:  # one too outlives what this process would not
        with ProcessPool(workers) as pool:
            runner = PooledRunner(
                pool.submit,
                workers,
                renew=pool.renew,
                retire=pool.retire,
                limit_s=limit_s,
                pause=pause,
                loses=loses,
            )
            yield _simulated_by(experiment, runner)
            _tell_of(runner)
    else:
        yield experiment


def _tell_of(runner: PooledRunner) -> None:
    """Say on stderr which workers did not stay."""
    if runner.retired:
        times = "once" if runner.retired == 1 else f"{runner.retired} times"
        why = "as memory grew that the simulator does not give back"
        print(f"worker processes were replaced {times}, {why}", file=sys.stderr)
    if runner.lost:
        words = "what they were at was simulated again, and is as it would have been"
        if runner.loses:
            words = "what they were at was simulated again, as far as that can be done"
        print(f"worker processes that were lost: {runner.lost}; {words}", file=sys.stderr)


def _simulated_by(experiment: Experiment, runner: PooledRunner) -> Experiment:
    return replace(experiment, problem=replace(experiment.problem, run_batches=runner))
