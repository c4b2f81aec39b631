"""``python -m benchmarks external`` in words: problems, truths, the study's table."""

from collections.abc import Iterator, Sequence

from benchmarks.external.problems import AnyProblem, chosen
from benchmarks.external.study import ExternalStudy, run_study
from benchmarks.external.truths import WAYS
from benchmarks.external.whole_systems import WholeSystem
from pemviz.cli.parsing import parse_arguments
from pemviz.errors import EXIT_DONE


def run(words: Sequence[str], *, program: str) -> int:
    """Carry out the command.

    Raises:
        InputError: The arguments are wrong.
    """
    study = parse_arguments(ExternalStudy, words, command="external", program=program)
    if study.list:
        lines = list_lines(chosen(study.problems))
    elif study.truths:
        lines = truth_lines(chosen(study.problems))
    else:
        lines = run_study(study)
    for line in lines:
        print(line, flush=True)
    return EXIT_DONE


def list_lines(problems: Sequence[AnyProblem]) -> Iterator[str]:
    """A Markdown table of the problems."""
    yield "| problem | source | probability | found by |"
    yield "|---|---|---|---|"
    for one in problems:
        error = f" +- {one.relative_error:.2g}" if one.relative_error else ""
        yield f"| {one.name} | {one.source} | {one.truth:.8g}{error} | {one.how} |"


def truth_lines(problems: Sequence[AnyProblem]) -> Iterator[str]:
    """Each probability as it stands, as it is found again, and how far these are apart."""
    yield "| problem | stands | found again | apart | standard errors | by |"
    yield "|---|---|---|---|---|---|"
    for one in problems:
        ways = (one.found_again,) if isinstance(one, WholeSystem) else WAYS[one.name]
        for way in ways:
            again = way()
            apart = again.value / one.truth - 1.0
            error = (again.relative_error**2 + one.relative_error**2) ** 0.5
            errors = f"{apart / error:+.1f}" if error else "-"
            yield (
                f"| {one.name} | {one.truth:.7g} | {again.value:.7g} | {apart:+.1e} | {errors} "
                f"| {again.how} |"
            )
