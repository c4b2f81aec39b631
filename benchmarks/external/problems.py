"""The problems as experiments of pemviz's."""

from collections.abc import Sequence

from benchmarks.external.catalogue import Problem, named, problems
from benchmarks.external.systems import MotionDetector, MotionSimulator
from benchmarks.external.whole_systems import WHOLE, WholeSystem
from pemviz import Experiment, ExperimentConfig, build_experiment
from pemviz.errors import ConfigError

AnyProblem = Problem | WholeSystem


def experiment_of(problem: AnyProblem, config: ExperimentConfig) -> Experiment:
    """What ``config``, with the problem's specification, asks for.

    Raises:
        InputError: The method cannot be had for it.
    """
    if isinstance(problem, WholeSystem):
        return build_experiment(config, simulator=problem.system(), pem=problem.detector)
    simulator = MotionSimulator(problem.motion, problem.name)
    return build_experiment(
        config,
        simulator=simulator,
        twin=simulator if problem.twin else None,
        pem=MotionDetector(problem.motion),
    )


def every() -> Sequence[AnyProblem]:
    """All problems, those of whole simulators last."""
    return (*problems(), *WHOLE)


def chosen(names: Sequence[str]) -> Sequence[AnyProblem]:
    """The problems that ``names`` name, or whose names begin with one that names none; or all.

    Raises:
        InputError: No problem's name is, or begins, so.
    """
    if not names:
        return every()
    wanted: set[str] = set()
    for name in names:
        found = named(name, [one.name for one in every()])
        if not found:
            message = f"problems = {name!r}: must begin one of {'; '.join(p.name for p in every())}"
            raise ConfigError(message)
        wanted |= found
    return [one for one in every() if one.name in wanted]
