"""``python -m benchmarks``: measure speed on this machine, or the methods' accuracy."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import Literal

from rich.console import Console
from rich.table import Table

from benchmarks.figures import Figure
from benchmarks.scale import HEADER, ScaleRow, ScaleStudy, cells, reasons, run_scale
from benchmarks.whole_runs import WholeRunArguments, print_whole_runs
from pemviz.cli.main import carry_out
from pemviz.cli.parsing import parse_arguments
from pemviz.errors import EXIT_DONE

PROGRAM = "python -m benchmarks"
Part = Literal["paper", "plain", "simulators", "encounters", "stl", "recording", "workers", "scale"]


@dataclass(frozen=True, kw_only=True)
class BenchArguments:
    """Measure speed on this machine.

    ``accuracy`` measures how wrong the methods are on scenarios with known answers, ``trust``
    whether answers that nothing warns of are right, ``external`` both on published problems beside
    others' programs, ``scale`` how time and memory grow, ``compare`` how many times faster pemviz
    is than what one would write else, ``runs`` how long ten runs that a user would make take,
    ``surrogates`` how many rollouts of a slow simulator a fast one saves; they have options of
    their own.
    """

    part: tuple[Part, ...] = (
        "paper",
        "plain",
        "simulators",
        "encounters",
        "stl",
        "recording",
    )
    """What to measure: the paper's experiment, plain rollouts (which loop this installation has),
    both back ends, those of the logical scenarios, the robustness metrics, size and cost of a
    recording; workers (11 minutes) how slow rollouts are shared out; scale (a few minutes) how time
    and memory grow."""
    json: bool = False
    """Print the figures as one JSON object and nothing else."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return carry_out("benchmarks", run, words)


def run(words: Sequence[str]) -> int:
    """Measure and print.

    Raises:
        InputError: The arguments are wrong.
    """
    studies = {
        "compare": _compare,
        "accuracy": _accuracy,
        "trust": _trust,
        "external": _external,
        "runs": _runs,
        "scale": _scale,
        "surrogates": _surrogates,
    }
    if words and words[0] in studies:
        return studies[words[0]](words[1:])
    arguments = parse_arguments(
        BenchArguments, words, command="", program=PROGRAM, default=BenchArguments()
    )
    measured = {part: list(_measure(part)()) for part in arguments.part if part != "scale"}
    grown = list(run_scale(ScaleStudy())) if "scale" in arguments.part else None
    if arguments.json:
        figures_by_part = {part: [asdict(f) for f in figures] for part, figures in measured.items()}
        scale = {} if grown is None else {"scale": [asdict(row) for row in grown]}
        print(json.dumps({**figures_by_part, **scale}))
        return EXIT_DONE
    if measured:
        _print_figures(measured)
    if grown is not None:
        _print_scale(grown)
    return EXIT_DONE


def _print_figures(measured: Mapping[str, Sequence[Figure]]) -> None:
    table = Table(title="medians of one run on this machine", title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    table.add_column("unit")
    table.add_column("goal")
    for figures in measured.values():
        for figure in figures:
            table.add_row(figure.name, f"{figure.value:.3g}", figure.unit or "-", figure.goal)
        table.add_section()
    Console().print(table)


def _compare(words: Sequence[str]) -> int:
    from benchmarks.compare_command import run as run_comparison  # noqa: PLC0415

    return run_comparison(words)


def _runs(words: Sequence[str]) -> int:
    return print_whole_runs(
        parse_arguments(WholeRunArguments, words, command="runs", program=PROGRAM)
    )


def _scale(words: Sequence[str]) -> int:
    study = parse_arguments(ScaleStudy, words, command="scale", program=PROGRAM)
    rows = run_scale(study)
    if study.json:
        print(json.dumps({"scale": [asdict(row) for row in rows]}))
    else:
        _print_scale(list(rows))
    return EXIT_DONE


def _print_scale(rows: Sequence[ScaleRow]) -> None:
    table = Table(title="scale: Monte Carlo runs, kept", title_justify="left")
    for name in HEADER:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*cells(row))
    Console().print(table)
    for line in reasons(rows):
        print(line)


def _accuracy(words: Sequence[str]) -> int:
    from benchmarks.accuracy_report import accuracy_lines  # noqa: PLC0415
    from benchmarks.accuracy_study import AccuracyStudy, run_study  # noqa: PLC0415

    study = parse_arguments(AccuracyStudy, words, command="accuracy", program=PROGRAM)
    print("\n".join(accuracy_lines(run_study(study))))
    return EXIT_DONE


def _trust(words: Sequence[str]) -> int:
    from benchmarks.trust_cases import trust_cases  # noqa: PLC0415
    from benchmarks.trust_report import case_lines, report_lines  # noqa: PLC0415
    from benchmarks.trust_study import TrustStudy, chosen, run_trust  # noqa: PLC0415

    study = parse_arguments(TrustStudy, words, command="trust", program=PROGRAM)
    if study.list:
        print("\n".join(case_lines(chosen(study.cases, trust_cases()))))
        return EXIT_DONE
    print("\n".join(report_lines(run_trust(study))))
    return EXIT_DONE


def _surrogates(words: Sequence[str]) -> int:
    from benchmarks.surrogates import SurrogateStudy, run_surrogates, surrogate_lines  # noqa: PLC0415

    study = parse_arguments(SurrogateStudy, words, command="surrogates", program=PROGRAM)
    print("\n".join(surrogate_lines(run_surrogates(study))))
    return EXIT_DONE


def _external(words: Sequence[str]) -> int:
    from benchmarks.external.command import run as run_external  # noqa: PLC0415

    return run_external(words, program=PROGRAM)


MEASURES = {
    "paper": "paper.paper_figures",
    "plain": "plain_rollouts.plain_rollout_figures",
    "simulators": "simulators.simulator_figures",
    "encounters": "encounters.scenario_figures",
    "stl": "stl.stl_figures",
    "recording": "recording.recording_figures",
    "workers": "slow_rollouts.slow_rollout_figures",
}


def _measure(part: Part) -> Callable[[], Sequence[Figure]]:
    module, name = MEASURES[part].split(".")
    return getattr(import_module(f"benchmarks.{module}"), name)  # only what is asked for


if __name__ == "__main__":
    sys.exit(main())
