"""``pemviz replay``: one rollout of a run again, alone, in a process of its own."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pemviz.cli.help import HelpPage
from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import Range, check_value
from pemviz.errors import EXIT_DONE, InputError, RunError

PAGE = HelpPage(
    text="""
usage: pemviz replay RUN [OPTIONS]   one rollout of a run again, alone
With the outcomes and latents that it had, in a process of its own: which step
it reaches, what the simulator was given there, what it raised or how the
process ended; or its robustness, and whether all is as the run kept it.

Which rollout
  --rank N              of those that the run keeps; 1 is the least robust [1]
  --stage N --rollout N as the message of a run that failed names it, be it kept
                        or not; also --repetition N
How
  --limit-s S           a step that takes longer has failed [the run's limit]
  --allow-python        where the run's error model is one of yours in Python
Examples
  pemviz replay recordings/RUN --stage 1 --rollout 17
  pemviz replay recordings/RUN --rank 3
  pemviz replay recordings/RUN --stage 1 --rollout 17 --limit-s 600
Exit codes: 0 it ran to the end, 1 it failed again, 2 bad input
More: --help OPTION, such as --help rank; --help-all for everything""",
)
EXIT_FAILED_AGAIN = 1
Rank = Annotated[int, Range(low=1)]
Number = Annotated[int, Range(low=0)]
LimitS = Annotated[float, Range(low=0.0, low_open=True)]


@dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Options of ``pemviz replay``."""

    run: tyro.conf.Positional[Path]
    """The run folder, of a run that is done, stopped or failed."""
    rank: Rank | None = None
    """Which of the rollouts that the run keeps: 1 is the least robust of those that carry the
    answer, as in the summary's list, and in the panel's where the least robust come
    first; at least 1. Left out: 1, or what --stage and --rollout say."""
    stage: Number | None = None
    """The rollout's stage, from 0."""
    rollout: Number | None = None
    """The rollout's number in its stage, from 0. One that the run does not keep is sampled again
    from the seed."""
    repetition: Number = 0
    """The rollout's repetition, from 0."""
    limit_s: LimitS | None = None
    """A step that takes longer has failed [s]; above 0. Left out: step_time_limit_s of the run."""
    allow_python: bool = False
    """Allow an error model that is module:attribute, whose code then runs."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The run cannot be read, or has no such rollout.
    """
    arguments = parse_arguments(ReplayArguments, words, command="replay", page=PAGE)
    for name, annotation in (
        ("rank", Rank),
        ("stage", Number),
        ("rollout", Number),
        ("repetition", Number),
        ("limit_s", LimitS),
    ):
        value = getattr(arguments, name)
        if value is not None:
            check_value(name=name, value=value, annotation=annotation)
    from pemviz.runs.replay import replay  # noqa: PLC0415  --help answers without it

    try:
        found = replay(
            arguments.run,
            stage=arguments.stage,
            rollout=arguments.rollout,
            repetition=arguments.repetition,
            rank=arguments.rank,
            limit_s=arguments.limit_s,
            allow_python=arguments.allow_python,
        )
    except RunError as error:  # it never came to the rollout
        raise InputError(str(error)) from error
    if found.traceback_text:
        print(found.traceback_text, file=sys.stderr)
    print(found)
    return EXIT_FAILED_AGAIN if found.failed else EXIT_DONE
