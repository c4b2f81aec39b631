"""How far ``mixture`` is off where the answer is known, over many seeds: a row for each case.

    python -m tests.sampling.exact_answers --seeds 50 --out exact-answers

Several obstacles, ghosts, errors of position, random starts and trackers, beside the answer by a
recursion or in closed form. Every run is a line of ``runs.jsonl`` in ``--out`` as soon as it is
there, and the same command goes on. A case misses the bar with a relative root mean square error
above 10 %, or where the exact binomial interval of the share of its intervals that hold the truth
lies outside 93 to 98 %. Half a minute to three minutes a case; exit code 1 if one misses.
"""

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pemviz
from benchmarks.accuracy import Accuracy, Outcome, run_once, summarise, with_budget
from pemviz.config import MethodName
from pemviz.config.toml_files import load_preset
from pemviz.runs.experiment import Experiment, build_method
from pemviz.sampling.zero_variance.reference import exact_log_probability
from tests.latent_toys import Drift, Flat, LargestError, RandomWalkStart, TwoDrifts, miss_of_either
from tests.lattice_walk import ToyPem, ToySimulator
from tests.sampling.test_slots import CASES as SLOTS
from tests.sampling.test_slots import truth as truth_of_slots
from tests.sampling.test_tracked import by_chains, tracker_of

ROLLOUTS = 2_400
LARGEST_RMSE = 0.1
COVERAGE = (0.93, 0.98)


@dataclass(frozen=True, kw_only=True)
class ExactCase:
    """A system whose failure probability is known.

    Attributes:
        name: In the table.
        spec: Its specification; empty: the preset's.
        simulator: A system of one's own, and ``pem`` its error model.
        truth: Gives the failure probability.
        tracker: Preset ``paper`` with this tracker, in place of a system of one's own.
    """

    name: str
    truth: Callable[[], float]
    spec: str = ""
    simulator: Any = None
    pem: Any = None
    tracker: str = ""

    def experiment(self) -> Experiment:
        """``mixture`` with 2,400 rollouts."""
        if self.tracker:
            return paper_with(self.tracker)
        config = with_budget(
            pemviz.ExperimentConfig(spec=self.spec, plan=False), method="mixture", rollouts=ROLLOUTS
        )
        return pemviz.build_experiment(config, simulator=self.simulator, pem=self.pem)


def paper_with(tracker: str, *, method: MethodName = "mixture") -> Experiment:
    config = replace(load_preset("paper"), plan=False)
    config = replace(config, scenario=replace(config.scenario, tracker=tracker))
    return pemviz.build_experiment(with_budget(config, method=method, rollouts=ROLLOUTS))


def by_recursion(tracker: str) -> float:
    """The failure probability of preset ``paper`` with a tracker, over all reachable states."""
    experiment = paper_with(tracker, method="zero-variance")
    assert experiment.twin is not None
    found = exact_log_probability(experiment.problem, twin=experiment.twin)
    assert found is not None
    return math.exp(found)


def of_slots(case: str) -> ExactCase:
    simulator, pem, _, _, spec = SLOTS[case]
    return ExactCase(
        name=case, spec=spec, simulator=simulator, pem=pem, truth=lambda: truth_of_slots(case)
    )


def tracked_walk(rule: tuple[int, int, int], name: str) -> ExactCase:
    walk, pem = ToySimulator(initial_gap=6, largest_gap=9, states=17), ToyPem(at_zero=6.5)
    return ExactCase(
        name=name,
        spec="always[0,16] (gap >= 0.5)",
        simulator=pemviz.tracked(walk, tracker_of(*rule)),
        pem=pem,
        truth=lambda: by_chains(rule, start=6, steps=16, largest=9, pem=pem),
    )


def latent_cases() -> Sequence[ExactCase]:
    """Closed forms, all near 1e-9 but for the start, whose twin is quantised."""
    one, missed = LargestError(), LargestError(needs_miss=True)
    total = Drift(start_sd_m=0.0)
    all_three, two = Drift(miss_m=0.4), TwoDrifts(miss_m=0.4)
    walk, seldom = RandomWalkStart(median=6.0), ToyPem(at_zero=5.0)
    errs = Flat(0.1)
    flat = {"car": Flat(0.05), "ghost": Flat(0.95)}
    return (
        ExactCase(
            name="position error of one step",
            spec=one.spec(6.4), simulator=one, pem=errs,
            truth=lambda: one.probability(6.4, miss=0.1),
        ),
        ExactCase(
            name="position error of one step, if missed",
            spec=missed.spec(6.0), simulator=missed, pem=errs,
            truth=lambda: missed.probability(6.0, miss=0.1),
        ),
        ExactCase(
            name="sum of position errors",
            spec=total.spec(4.8), simulator=total, pem=errs,
            truth=lambda: total.probability(4.8, miss=0.1),
        ),
        ExactCase(
            name="sum of errors, start and misses",
            spec=all_three.spec(7.2), simulator=all_three, pem=errs,
            truth=lambda: all_three.probability(7.2, miss=0.1),
        ),
        ExactCase(
            name="the same with two slots",
            spec=two.spec(7.2), simulator=two, pem=flat,
            truth=lambda: two.probability(7.2, miss=miss_of_either(0.05, 0.05)),
        ),
        ExactCase(
            name="random start",
            spec="always[0,14] (gap >= 0.5)", simulator=walk, pem=seldom,
            truth=lambda: walk.probability(seldom),
        ),
    )  # fmt: skip


def cases() -> Sequence[ExactCase]:
    tracked = ("2/3", "2/3,coast=0.2", "2/3,coast=0.5")
    return (
        *(of_slots(case) for case in SLOTS),
        *latent_cases(),
        tracked_walk((2, 3, 0), "walk, tracker 2 of 3"),
        tracked_walk((2, 3, 2), "walk, tracker 2 of 3, coasting"),
        *(
            ExactCase(
                name=f"paper, tracker {one}", tracker=one, truth=lambda one=one: by_recursion(one)
            )
            for one in tracked
        ),
    )  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--cases", nargs="*", default=[], help="those whose names begin so")
    parser.add_argument("--out", type=Path, default=Path("exact-answers"))
    asked = parser.parse_args(words)
    asked.out.mkdir(parents=True, exist_ok=True)
    seeds = range(asked.first_seed, asked.first_seed + asked.seeds)
    print(
        "| case | truth | runs | median | RMSE | hold the truth | warned | bar |\n"
        + "|---" * 8
        + "|"
    )
    met = True
    for case in cases():
        if not asked.cases or case.name.startswith(tuple(asked.cases)):
            row = carry_out(case, seeds, path=asked.out / "runs.jsonl")
            met &= meets(row)
            print(line_of(row), flush=True)
    return 0 if met else 1


def carry_out(case: ExactCase, seeds: Sequence[int], *, path: Path) -> Accuracy:
    """The figures of one case; runs that ``path`` holds are not carried out again."""
    truth, finished = case.truth(), read(path)
    experiment = case.experiment()
    for seed in seeds:
        if key_of(case, truth, seed) in finished:
            continue
        config = replace(experiment.config, seed=seed)
        method = build_method(config, back_end=experiment.back_end)
        outcome = run_once(method, experiment.problem, truth)
        line = json.dumps({"key": key_of(case, truth, seed), **asdict(outcome)})
        with path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
    finished = read(path)
    outcomes = [finished[key_of(case, truth, seed)] for seed in seeds]
    return summarise(outcomes, scenario=case.name, method="mixture", truth=truth)


def key_of(case: ExactCase, truth: float, seed: int) -> str:
    return f"{case.name} | {truth:.10g} | {seed}"


def read(path: Path) -> Mapping[str, Outcome]:
    """Outcomes by key; a line that was not finished counts as none."""
    outcomes: dict[str, Outcome] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            fields = json.loads(line)
        except ValueError:
            continue
        key = fields.pop("key")
        outcomes[key] = Outcome(**fields)
    return outcomes


def meets(row: Accuracy) -> bool:
    low, high = COVERAGE
    return (
        row.relative_rmse <= LARGEST_RMSE and low <= row.coverage_high and row.coverage_low <= high
    )


def line_of(row: Accuracy) -> str:
    held = f"{row.coverage:.0%} ({row.coverage_low:.0%} to {row.coverage_high:.0%})"
    return (
        f"| {row.scenario} | {row.truth:.3g} | {row.runs} | {row.median_ratio:.3f} "
        f"| {row.relative_rmse:.1%} | {held} | {row.warned:.0%} "
        f"| {'met' if meets(row) else 'missed'} |"
    )


if __name__ == "__main__":
    raise SystemExit(main())
