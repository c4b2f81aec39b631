"""The problems as experiments of pemviz's."""

from collections.abc import Sequence

from benchmarks.external.catalogue import Problem, named, problems
from benchmarks.external.systems import MotionDetector, MotionSimulator
from pemviz import Experiment, ExperimentConfig, build_experiment
from pemviz.errors import ConfigError


def experiment_of(problem: Problem, config: ExperimentConfig) -> Experiment:
    """What ``config``, with the problem's specification, asks for.

    Raises:
        InputError: The method cannot be had for it.
    """
    simulator = MotionSimulator(problem.motion, problem.name)
    return build_experiment(
        config,
        simulator=simulator,
        twin=simulator if problem.twin else None,
        pem=MotionDetector(problem.motion),
    )


def chosen(names: Sequence[str]) -> Sequence[Problem]:
    """The problems that ``names`` name, or whose names begin with one that names none; or all.

    Raises:
        InputError: No problem's name is, or begins, so.
    """
    every = problems()
    if not names:
        return every
    wanted: set[str] = set()
    for name in names:
        found = named(name)
        if not found:
            message = f"problems = {name!r}: must begin one of {'; '.join(p.name for p in every)}"
            raise ConfigError(message)
        wanted |= found
    return [one for one in every if one.name in wanted]
