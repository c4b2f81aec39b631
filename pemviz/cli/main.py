"""The command line: finds the command, reports errors in one line, sets the exit code."""

import faulthandler
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module

from pemviz._version import __version__
from pemviz.config.ranges import did_you_mean
from pemviz.errors import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_FAILED,
    HelpShown,
    InputError,
    PemvizError,
)
from pemviz.faults import exception_text, presentable, traceback_of


@dataclass(frozen=True)
class Command:
    """A command, imported when it is called.

    Attributes:
        module: Has a function ``run`` that takes the remaining arguments and returns the
            exit code.
        summary: One line for the overview.
        arguments: Module and name of the dataclass of its arguments; empty of one that has actions
            instead, which its module's ``ACTIONS`` names.
    """

    module: str
    summary: str
    arguments: str


COMMANDS = {
    "assess": Command(
        "pemviz.cli.assess",
        "from your detector's files to an answer and a report, in one go",
        "pemviz.cli.assess:AssessArguments",
    ),
    "record": Command(
        "pemviz.cli.record",
        "run an experiment and keep it in a run folder",
        "pemviz.cli.record_arguments:RecordArguments",
    ),
    "sweep": Command(
        "pemviz.cli.sweep",
        "run many experiments: settings times seeds",
        "pemviz.cli.sweep:SweepArguments",
    ),
    "pem": Command("pemviz.cli.pem.command", "collect, fit, evaluate, show error models", ""),
    "serve": Command(
        "pemviz.cli.serve", "show the panel in the browser", "pemviz.cli.serve:ServeArguments"
    ),
    "open": Command(
        "pemviz.cli.open",
        "show a run's recording in rerun's viewer",
        "pemviz.recording.open:OpenArguments",
    ),
    "replay": Command(
        "pemviz.cli.replay",
        "one rollout of a run again, alone: what does the simulator do",
        "pemviz.cli.replay:ReplayArguments",
    ),
    "report": Command(
        "pemviz.cli.report",
        "one page for a safety case from runs and sweeps",
        "pemviz.cli.report:ReportArguments",
    ),
    "budget": Command(
        "pemviz.cli.budget",
        "hold a risk budget against runs: is it met, what decides",
        "pemviz.cli.budget:BudgetArguments",
    ),
    "export": Command(
        "pemviz.cli.export",
        "a rollout of a run as a file for other tools",
        "pemviz.cli.export:ExportArguments",
    ),
    "reproduce": Command(
        "pemviz.cli.reproduce",
        "the paper's tables and figures beside its numbers",
        "pemviz.cli.reproduce:ReproduceArguments",
    ),
    "completion": Command(
        "pemviz.cli.completion",
        "a script that has your shell complete commands and options",
        "pemviz.cli.completion:CompletionArguments",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if sys.__stderr__ is not None and not faulthandler.is_enabled():
        faulthandler.enable(sys.__stderr__)  # a simulator's library may abort: tell where
    try:
        try:
            return _answer(words)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # whoever read what is printed has had enough: nothing to complain of
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED


def _answer(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return EXIT_DONE if words else EXIT_BAD_INPUT
    if words[0] == "--version":
        print(f"pemviz {__version__}")
        return EXIT_DONE
    return carry_out(words[0], partial(run_command, words[0]), words[1:])


def carry_out(name: str, run: Callable[[Sequence[str]], int], words: Sequence[str]) -> int:
    """A command's exit code; what it cannot do is told in one line.

    Args:
        name: The command's.
        run: What it does with its words.
        words: After the command.

    Raises:
        BrokenPipeError: Nobody reads what is printed any more.
    """
    try:
        return run(words)
    except InputError as error:
        _show(error.traceback_text)
        return _complain(str(error), code=EXIT_BAD_INPUT)
    except PemvizError as error:
        _show(getattr(error, "traceback_text", ""))
        return _complain(str(error), code=EXIT_FAILED)
    except (BrokenPipeError, HelpShown):  # a run makes a failed one of what its code raises
        raise
    except OSError as error:  # a full disk, a folder that went away
        where = "" if error.filename is None else f" ({error.filename})"
        return _complain(f"{error.strerror or error}{where}", code=EXIT_FAILED)
    except KeyboardInterrupt:
        return _complain("interrupted", code=EXIT_FAILED)
    except BaseException as raised:  # exit codes 0 and 1 are for runs that were judged
        if isinstance(raised, SystemExit) and isinstance(raised.__context__, BrokenPipeError):
            raise raised.__context__ from None  # what rich makes of it
        error = presentable(raised)
        _show(traceback_of(error))
        return _complain(f"{name} failed: {exception_text(error)}", code=EXIT_FAILED)


def run_command(name: str, words: Sequence[str]) -> int:
    """Carry out a command, which is imported only now: some take seconds; gives its exit code.

    Raises:
        InputError: There is no such command, or as the command does.
    """
    command = COMMANDS.get(name)
    if command is None:
        guess = did_you_mean(name, COMMANDS)
        message = f"{name!r} is no command; there are: {', '.join(COMMANDS)}{guess}"
        raise InputError(message)
    return import_module(command.module).run(words)


def _overview() -> str:
    width = max(len(name) for name in COMMANDS)
    lines = [f"  {name.ljust(width)}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: pemviz COMMAND [OPTIONS]",
            "",
            "How likely is a rare violation, how far is that open, what causes it?",
            "",
            *lines,
            "",
            "pemviz COMMAND --help explains a command's options.",
        ]
    )


def _show(traceback_text: str) -> None:
    if traceback_text:
        print(traceback_text, file=sys.stderr)


def _complain(message: str, *, code: int) -> int:
    print(f"pemviz: {' '.join(message.split())}", file=sys.stderr)
    return code
