"""How fast robustness is: against numpy written by hand, against rtamt, and with size."""

from __future__ import annotations

import json
import math
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from benchmarks.figures import Figure
from pemviz.arrays import FloatArray
from pemviz.errors import RunError
from pemviz.stl import Agm, Classical, Formula, Metric, SmoothCumulative, parse, robustness

ROLLOUTS, STATES = 10_000, 100

ALWAYS = "always[0,99] (d >= 2)"
NESTED = "always[0,60] (not (d < 5) or eventually[0,20] (v < 1))"
UNTIL = "(a > 0) until[0,50] (b > 0)"

METRICS: Mapping[str, Metric] = {
    "classical": Classical(),
    "agm": Agm({"d": (-25.0, 25.0), "v": (0.0, 40.0), "a": (-10.0, 10.0), "b": (-10.0, 10.0)}),
    "smooth-cumulative": SmoothCumulative(),
}

ORACLE_PYTHON = "PEMVIZ_ORACLE_PYTHON"
"""Environment variable that names a Python in whose environment rtamt is installed."""

# Runs in rtamt's environment: the formula is parsed once, then one trace after the other.
RTAMT_PROGRAM = """
import json, sys, time
import rtamt
traces = json.load(sys.stdin)
spec = rtamt.StlDiscreteTimeSpecification()
spec.declare_var("d", "float")
spec.set_sampling_period(1, "s", 0.1)
spec.spec = "always[0:99] (d >= 2)"
spec.parse()
times_s = []
for _ in range(5):
    began = time.process_time()
    values = [
        spec.evaluate({"time": list(range(len(trace))), "d": trace})[0][1] for trace in traces
    ]
    times_s.append((time.process_time() - began) / len(traces))
print(json.dumps([min(times_s), values]))
"""


def stl_figures(*, repeats: int = 15, rtamt_python: str | None = None) -> Sequence[Figure]:
    """Time every metric on 10,000 rollouts of 100 states, in double precision.

    Every time is the best of several: what else the machine does only ever adds.

    Args:
        repeats: Measurements of each kind.
        rtamt_python: A Python that has rtamt; by default what the environment variable
            PEMVIZ_ORACLE_PYTHON names. Without one, the comparison is left out.
    """
    batch = random_batch(rollouts=ROLLOUTS, states=STATES)
    python = rtamt_python or os.environ.get(ORACLE_PYTHON)
    return (
        *_against_hand_written(batch, repeats),
        *_between_metrics(batch, repeats, python),
        *_with_size(max(2, repeats // 5)),
    )


def random_batch(*, rollouts: int, states: int) -> dict[str, FloatArray]:
    """Signals d, v, a, b [rollouts, states]: a gap that wanders, a speed, and noise."""
    rng = np.random.default_rng(0)
    shape = rollouts, states
    gap = 10.0 + np.cumsum(rng.normal(-0.05, 0.3, shape) * (100 / states) ** 0.5, axis=1)
    return {
        "d": np.clip(gap, -24.0, 24.0),
        "v": rng.uniform(0.0, 20.0, shape),
        "a": np.clip(rng.normal(0.5, 1.0, shape), -9.0, 9.0),
        "b": np.clip(rng.normal(-1.0, 1.0, shape), -9.0, 9.0),
    }


def always_by_hand(batch: Mapping[str, FloatArray]) -> FloatArray:
    """Classical robustness of ALWAYS, [N]."""
    return (batch["d"] - 2.0).min(axis=1)


def nested_by_hand(batch: Mapping[str, FloatArray]) -> FloatArray:
    """Classical robustness of NESTED, [N]; the window of 21 steps by doubling."""
    reached = 1.0 - batch["v"][:, :81]
    for stretch in (1, 2, 4, 8, 5):  # 1 + 1 + 2 + 4 + 8 + 5 = 21
        reached = np.maximum(reached[:, :-stretch], reached[:, stretch:])
    return np.maximum(batch["d"][:, :61] - 5.0, reached).min(axis=1)


def until_by_hand(batch: Mapping[str, FloatArray]) -> FloatArray:
    """Classical robustness of UNTIL, [N]."""
    held = np.minimum.accumulate(batch["a"][:, :51], axis=1)
    return np.minimum(held, batch["b"][:, :51]).max(axis=1)


BY_HAND: Mapping[str, Callable[[Mapping[str, FloatArray]], FloatArray]] = {
    ALWAYS: always_by_hand,
    NESTED: nested_by_hand,
    UNTIL: until_by_hand,
}


def _best_times_s(functions: Sequence[Callable[[], object]], repeats: int) -> list[float]:
    """The shortest time [s] of each function; they take turns, so that they share the noise."""
    best = [math.inf] * len(functions)
    for _ in range(repeats + 1):
        for index, function in enumerate(functions):
            began = time.perf_counter()
            function()
            best[index] = min(best[index], time.perf_counter() - began)
    return best


def _against_hand_written(batch: Mapping[str, FloatArray], repeats: int) -> Iterator[Figure]:
    for text, by_hand in BY_HAND.items():
        formula = parse(text)

        def ours(formula: Formula = formula) -> FloatArray:
            return robustness(formula, batch, Classical())

        def theirs(by_hand: Callable[..., FloatArray] = by_hand) -> FloatArray:
            return by_hand(batch)

        ours_s, theirs_s = _best_times_s((ours, theirs), 2 * repeats)
        ratio = ours_s / theirs_s
        yield Figure(f"stl, classical of {text} / by hand", ratio, "", "at most 1.5")


def _between_metrics(
    batch: Mapping[str, FloatArray], repeats: int, python: str | None
) -> Iterator[Figure]:
    per_rollout_s = _per_rollout_s(batch, repeats)
    for name, time_s in per_rollout_s.items():
        yield Figure(f"stl, {name} of {ALWAYS}, per rollout", time_s * 1e6, "us")
        if name != "classical":
            ratio = time_s / per_rollout_s["classical"]
            yield Figure(f"stl, {name} / classical", ratio, "", "at most 60")
    if python:
        gaps = batch["d"][:200]
        rtamt_s = time_rtamt(python, gaps)
        yield Figure(f"stl, rtamt of {ALWAYS}, per rollout", rtamt_s * 1e6, "us")
        for name, time_s in per_rollout_s.items():
            yield Figure(f"stl, rtamt / {name}", rtamt_s / time_s, "", "at least 1000")


def _per_rollout_s(batch: Mapping[str, FloatArray], repeats: int) -> Mapping[str, float]:
    formula = parse(ALWAYS)

    def evaluate(metric: Metric) -> Callable[[], FloatArray]:
        return lambda: robustness(formula, batch, metric)

    times_s = _best_times_s([evaluate(metric) for metric in METRICS.values()], repeats)
    return {name: time_s / ROLLOUTS for name, time_s in zip(METRICS, times_s, strict=True)}


def time_rtamt(python: str, gaps: FloatArray) -> float:
    """Processor seconds of rtamt per trace of ``gaps [N, 100]``, in its best pass.

    Args:
        python: A Python that has rtamt.
        gaps: Of ALWAYS.

    Raises:
        RunError: There is no such Python, or it has no rtamt.
        RuntimeError: Its robustness is not ours.
    """
    try:
        answer = subprocess.run(  # noqa: S603 (the interpreter that the user named)
            [python, "-c", RTAMT_PROGRAM],
            input=json.dumps(gaps.tolist()),
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise RunError(f"{ORACLE_PYTHON} = {python}: rtamt cannot be run there ({error})") from None
    time_s, values = json.loads(answer.stdout)
    if not np.allclose(values, robustness(parse(ALWAYS), {"d": gaps}, Classical()), atol=1e-12):
        raise RuntimeError("rtamt and pemviz disagree: the comparison would mean nothing")
    return float(time_s)


def _with_size(repeats: int) -> Iterator[Figure]:
    """Time per value of a signal, which stays the same where cost is linear."""
    sizes = ((1_000, 100), (10_000, 100), (100_000, 100), (1_000, 1_000), (1_000, 10_000))
    for rollouts, states in sizes:
        batch = random_batch(rollouts=rollouts, states=states)
        texts = {
            "always": f"always[0,{states - 1}] (d >= 2)",
            "nested": NESTED.replace("60", str(states - 21)),
        }
        for kind, text in texts.items():
            formula = parse(text)
            for name, metric in METRICS.items():

                def ours(formula: Formula = formula, metric: Metric = metric) -> FloatArray:
                    return robustness(formula, batch, metric)  # noqa: B023 (called at once)

                (time_s,) = _best_times_s((ours,), repeats)
                label = f"stl, {name}, {kind}, N = {rollouts}, T = {states}"
                yield Figure(label, time_s / (rollouts * states) * 1e9, "ns/value")
