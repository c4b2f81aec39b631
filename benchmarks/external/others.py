"""Others' programs on the same problems: OpenTURNS' methods and ``rareeventestimation``'s.

Run by an interpreter of its own, from a checkout's root, without pemviz::

    python -m venv otenv && otenv/bin/pip install openturns rareeventestimation
    otenv/bin/python -m benchmarks.external.others --out others/runs.jsonl --budget 1200 20000
    python -m benchmarks external --others others/runs.jsonl

or by one command, at as many calls as a method of pemviz took on each problem::

    python -m benchmarks external --method auto --others-python otenv/bin/python

Each method is at its authors' settings: quantile levels of 10 %, and what their examples and
defaults have. A method whose number of calls follows from a sample size is given the size that
brings a first run, which does not count, to the budget; FORM with importance sampling spends it.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import signal
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.external.catalogue import Problem, named, problems
from benchmarks.external.motions import LimitFunction, Numbers, dimension, limit_function
from benchmarks.external.record import DONE, ENDLESS, Run, add_run, as_took, read_runs

LEVEL = 0.1
"""Quantile of the intermediate levels of subset sampling, NAIS and cross-entropy."""
MANY = 20
"""From so many dimensions on methods of ``rareeventestimation`` take what is made for many."""
CHAINS = 0.1
"""Chains of sequential importance sampling, as a share of its sample: its default."""
TOO_LONG = 2
"""So many runs of a method took too long on a problem: no more of them are begun."""
OPENTURNS, REE = "OpenTURNS", "rareeventestimation"
PACKAGES = (OPENTURNS.lower(), REE)


@dataclass
class Counted:
    """A limit function that counts how often it is called.

    Attributes:
        function: The function.
        dimension: Of its standard normals.
        calls: How many points it was evaluated at.
    """

    function: LimitFunction
    dimension: int
    calls: int = 0

    def __call__(self, points: Any) -> Numbers:
        """G at points ``[..., D]``, ``[...]``."""
        given = np.asarray(points, dtype=np.float64)
        flat = given.reshape(-1, self.dimension)
        self.calls += len(flat)
        return self.function(flat).reshape(given.shape[:-1])


@dataclass(frozen=True)
class Answer:
    """What a method says.

    Attributes:
        estimate: The probability.
        ends: Of its 95 % interval; ``None`` where it gives none.
        warned: What it says against itself.
    """

    estimate: float
    ends: tuple[float, float] | None = None
    warned: tuple[str, ...] = field(default=())


Method = Callable[[Counted, int, int], Answer]
"""A function, a sample size or a budget, and a seed to an answer."""


def _event(function: Counted, seed: int) -> Any:
    """OpenTURNS' event that the function is below 0."""
    ot: Any = importlib.import_module("openturns")
    ot.Log.Show(ot.Log.NONE)
    ot.RandomGenerator.SetSeed(seed)

    def each(sample: Any) -> Any:
        return function(np.asarray(sample))[:, None]

    count = function.dimension
    given = ot.RandomVector(ot.Normal(count))
    composed = ot.PythonFunction(count, 1, func_sample=each)
    return ot.ThresholdEvent(ot.CompositeRandomVector(composed, given), ot.Less(), 0.0)


def _simulated(algorithm: Any, size: int, *, block: int) -> Answer:
    """An algorithm's answer after so many evaluations of its own kind."""
    algorithm.setBlockSize(block)
    algorithm.setMaximumOuterSampling(max(1, size // block))
    with contextlib.suppress(AttributeError):
        algorithm.setMaximumCoefficientOfVariation(0.0)
    algorithm.run()
    result = algorithm.getResult()
    value = float(result.getProbabilityEstimate())
    half = 0.5 * float(result.getConfidenceLength(0.95))
    return Answer(value, (max(0.0, value - half), value + half))


def subset(function: Counted, size: int, seed: int) -> Answer:
    """Subset simulation (Au, Beck 2001)."""
    ot: Any = importlib.import_module("openturns")
    return _simulated(ot.SubsetSampling(_event(function, seed), 2.0, LEVEL), size, block=10)


def nais(function: Counted, size: int, seed: int) -> Answer:
    """Nonparametric adaptive importance sampling (Morio 2012)."""
    ot: Any = importlib.import_module("openturns")
    return _simulated(ot.NAIS(_event(function, seed), LEVEL), size, block=10)


def cross_entropy(function: Counted, size: int, seed: int) -> Answer:
    """Cross-entropy importance sampling in the standard space, means and spreads of normals."""
    ot: Any = importlib.import_module("openturns")
    algorithm = ot.StandardSpaceCrossEntropyImportanceSampling(_event(function, seed), LEVEL)
    return _simulated(algorithm, size, block=10)


def form(function: Counted, size: int, seed: int) -> Answer:
    """FORM, then importance sampling around its design point with what is left of the calls."""
    ot: Any = importlib.import_module("openturns")
    solver = ot.AbdoRackwitz()
    solver.setStartingPoint(np.zeros(function.dimension))
    solver.setMaximumIterationNumber(100)
    solver.setMaximumCallsNumber(max(100, size // 2))
    algorithm = ot.FORM(solver, _event(function, seed))
    algorithm.run()
    left = max(100, size - function.calls)
    return _simulated(ot.PostAnalyticalImportanceSampling(algorithm.getResult()), left, block=10)


def directional(function: Counted, size: int, seed: int) -> Answer:
    """Directional sampling: random directions, roots by 'safe and slow'."""
    ot: Any = importlib.import_module("openturns")
    return _simulated(ot.DirectionalSampling(_event(function, seed)), size, block=1)


def _ree(name: str, function: Counted, size: int, seed: int, **options: Any) -> Answer:
    ree: Any = importlib.import_module("rareeventestimation")
    np.random.seed(seed)  # noqa: NPY002  it samples from numpy's own
    problem = ree.NormalProblem(function, function.dimension, size)
    problem.set_sample(size, seed=seed)
    solution = getattr(ree, name)(seed=seed, **options).solve(problem)
    if solution is None:
        message = "gives no solution"
        raise RuntimeError(message)
    value = float(solution.prob_fail_hist[-1])
    return Answer(value, warned=() if solution.msg == "Success" else (str(solution.msg),))


def _many(function: Counted, few: str, many: str) -> str:
    return many if function.dimension >= MANY else few


def cbree(function: Counted, size: int, seed: int) -> Answer:
    """Consensus-based rare event estimation (Althaus, Papaioannou, Ullmann 2024)."""
    model = _many(function, "GM", "vMFNM")
    return _ree("CBREE", function, size, seed, mixture_model=model)


def sis(function: Counted, size: int, seed: int) -> Answer:
    """Sequential importance sampling (Papaioannou, Papadimitriou, Straub 2016)."""
    model = _many(function, "GM", "aCS")
    whole = next(n for n in range(size, 0, -1) if (CHAINS * n).is_integer())  # or it refuses
    return _ree("SIS", function, whole, seed, mixture_model=model)


def enkf(function: Counted, size: int, seed: int) -> Answer:
    """The ensemble Kalman filter (Wagner, Papaioannou, Ullmann 2022)."""
    model = _many(function, "GM", "vMFNM")
    return _ree("ENKF", function, size, seed, mixture_model=model)


SIZED: Mapping[str, Method] = {
    f"{OPENTURNS}: SubsetSampling": subset,
    f"{OPENTURNS}: NAIS": nais,
    f"{OPENTURNS}: cross-entropy": cross_entropy,
    f"{OPENTURNS}: directional": directional,
    f"{REE}: CBREE": cbree,
    f"{REE}: SIS": sis,
    f"{REE}: EnKF": enkf,
}
"""Those whose calls follow from a sample size."""
METHODS: Mapping[str, Method] = {**SIZED, f"{OPENTURNS}: FORM and IS": form}
"""All; the last one stops at a budget."""


class TooLongError(Exception):
    """A run took more processor time than it may."""


@contextlib.contextmanager
def within(seconds: int) -> Any:
    """End what takes more processor time; quietly, whatever it prints."""

    def stop(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One method at one budget on one problem.

    Attributes:
        problem: The problem.
        name: The method's name.
        budget: Calls.
        label: What that budget is called.
        limit_s: A run that takes more processor time is ended [s].
    """

    problem: Problem
    name: str
    budget: int
    label: str
    limit_s: int

    def size(self) -> int:
        """What the method is given, so that its calls come to about the budget; tens."""
        if self.name not in SIZED:
            return self.budget
        size = max(100, self.budget // 8)
        for seed in (10_001, 10_002):
            function = self._counted()
            with contextlib.suppress(Exception), within(self.limit_s):
                METHODS[self.name](function, size, seed)
            if function.calls:
                size = 10 * max(2, round(size * self.budget / function.calls / 10))
                size = min(size, self.budget)
        return size

    def run(self, seed: int, size: int) -> Run:
        """The method once; what it raises, or takes too long for, is no answer."""
        function = self._counted()
        began = time.process_time()
        run = Run(
            problem=self.problem.name,
            method=self.name,
            budget=self.label,
            seed=seed,
            estimate=None,
        )
        try:
            with within(self.limit_s):
                answer = METHODS[self.name](function, size, seed)
        except TooLongError:
            run = replace(run, warned=(f"{ENDLESS} {self.limit_s} s",))
        except Exception as error:
            run = replace(run, warned=(f"{type(error).__name__}: {str(error)[:200]}",))
        else:
            low, high = answer.ends or (None, None)
            run = replace(run, estimate=answer.estimate, low=low, high=high, warned=answer.warned)
        if run.estimate is not None and not np.isfinite(run.estimate):
            run = replace(run, estimate=None, low=None, high=None, warned=("no number",))
        return replace(run, calls=function.calls, seconds=time.process_time() - began)

    def _counted(self) -> Counted:
        return Counted(limit_function(self.problem.motion), dimension(self.problem.motion))


def main(words: Sequence[str] | None = None) -> None:
    """Carry out what is not in the file yet, what takes few calls first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the file that runs are added to")
    parser.add_argument("--problems", nargs="*", default=[], help="names, or how they begin")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help=", ".join(METHODS))
    parser.add_argument("--budget", nargs="*", type=int, default=[1200, 20_000], help="calls")
    parser.add_argument("--like", type=Path, help="a file of runs: budgets are what they took")
    parser.add_argument("--like-method", default="auto", help="runs of which method")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--limit-s", type=int, default=120, help="a run that takes longer is ended")
    given = parser.parse_args(words)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for package in PACKAGES:
        importlib.import_module(package)  # that takes seconds, which are no run's
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    for task in _tasks(given):
        _carry_out(task, seeds, given.out)


def _tasks(given: argparse.Namespace) -> Sequence[Task]:
    names = [one.name for one in problems()]
    wanted = set().union(*(named(name, names) for name in given.problems))
    chosen = [
        one
        for one in problems()
        if (one.name in wanted or not given.problems) and not one.twin and not one.missing
    ]  # with a twin it is the same problem to them
    label = as_took(given.like_method)
    if given.like is None:
        budgets = [(one, str(calls), calls) for calls in given.budget for one in chosen]
    else:
        took = _took(read_runs(given.like).values(), given.like_method)
        budgets = [(one, label, took[one.name]) for one in chosen if one.name in took]
        budgets.sort(key=lambda item: item[-1])
    return [
        Task(problem=one, name=name, budget=calls, label=words, limit_s=given.limit_s)
        for one, words, calls in budgets
        for name in given.methods
    ]


def _took(runs: Iterable[Run], method: str) -> Mapping[str, int]:
    """How many calls a method took on each problem until it said that it was done, on average."""
    calls: dict[str, list[int]] = {}
    for run in runs:
        if run.method == method and run.budget == DONE and run.calls:
            calls.setdefault(run.problem, []).append(run.calls)
    return {name: round(sum(some) / len(some)) for name, some in calls.items()}


def _carry_out(task: Task, seeds: Sequence[int], out: Path) -> None:
    key, done = (task.problem.name, task.name, task.label), read_runs(out)
    missing = [seed for seed in seeds if (*key, seed) not in done]
    endless = sum(done[*key, seed].is_endless for seed in seeds if (*key, seed) in done)
    size = task.size() if missing and endless < TOO_LONG else 0
    for seed in missing:
        if endless == TOO_LONG:
            break
        run = task.run(seed, size)
        endless += run.is_endless
        add_run(out, run)
    print(*key, f"{task.budget} calls", f"{len(missing)} runs", flush=True)


if __name__ == "__main__":
    main()
