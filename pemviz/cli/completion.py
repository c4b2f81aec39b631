"""``pemviz completion``: what a shell needs to complete commands, options and their values."""

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any, Literal

import tyro

from pemviz.cli.main import COMMANDS
from pemviz.cli.parsing import parse_arguments
from pemviz.cli.pem.command import ACTIONS, module_of
from pemviz.errors import EXIT_DONE

DESCRIPTION = (
    "Print a script that has your shell complete pemviz's commands, options and choices. bash: "
    "pemviz completion bash > ~/.local/share/bash-completion/completions/pemviz; zsh: into a file "
    "_pemviz of a folder of your $fpath; fish: into ~/.config/fish/completions/pemviz.fish."
)

TABLE = "COMPLETION_SPEC = "
"""Begins the script's line that describes all commands."""


@dataclass(frozen=True, kw_only=True)
class CompletionArguments:
    """Options of ``pemviz completion``."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """Which shell the script is for."""


def run(words: Sequence[str]) -> int:
    """Print the script and return the exit code.

    Raises:
        InputError: There is no script for that shell.
    """
    arguments = parse_arguments(
        CompletionArguments, words, command="completion", description=DESCRIPTION
    )
    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.cli(
            _one_of(argument_kinds()),
            prog="pemviz",
            args=["--tyro-write-completion", arguments.shell, "-"],
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    for line in script.getvalue().splitlines():
        # shells take a line of a description for a word: what it names is on one
        print(line.replace("\\n", " ") if line.startswith(TABLE) else line)
    return EXIT_DONE


def argument_kinds() -> dict[str, Any]:
    """The dataclass of the arguments of each command; those of a command's actions by action."""
    kinds: dict[str, Any] = {
        name: _named(command.arguments) for name, command in COMMANDS.items() if command.arguments
    }
    actions = {
        action: _named(f"{module_of(action)}:{kind}") for action, (kind, _) in ACTIONS.items()
    }
    return {**kinds, "pem": actions}


def _named(place: str) -> Any:
    module, name = place.split(":")
    return getattr(import_module(module), name)


def _one_of(kinds: dict[str, Any]) -> Any:
    """The union of commands that tyro completes; a table of them is a command with actions."""
    arms = (
        Annotated[_one_of(kind) if isinstance(kind, dict) else kind, tyro.conf.subcommand(name)]
        for name, kind in kinds.items()
    )
    return reduce(or_, arms)
