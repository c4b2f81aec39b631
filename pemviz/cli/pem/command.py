"""``pemviz pem``: perception error models, from detections to a calibrated surrogate."""

from collections.abc import Callable, Sequence
from importlib import import_module
from keyword import iskeyword
from typing import Any

from pemviz.cli.help import HelpPage
from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import did_you_mean
from pemviz.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError

ACTIONS = {
    "compare": ("CompareArguments", "failure probability under several models, and their ratios"),
    "collect": ("CollectArguments", "match detections with labels, of any format, into a table"),
    "fit": ("FitArguments", "train a model on such a table"),
    "evaluate": ("EvaluateArguments", "cross-validate models: scores, calibration, tables"),
    "memory": ("MemoryArguments", "how misses follow each other on video; are they independent?"),
    "check": ("CheckArguments", "does a model give tracks like those that were observed?"),
    "show": ("ShowArguments", "draw P(missed) against distance"),
    "export": ("ExportArguments", "for Autoware's scenario simulator, or as a plain table"),
    "import": ("ImportArguments", "noise parameters of that simulator as a model"),
}


def module_of(action: str) -> str:
    """The module of an action; no module can be imported that is called import."""
    return f"pemviz.cli.pem.{action}{'_' * iskeyword(action)}"


def run(words: Sequence[str]) -> int:
    """Carry out ``pemviz pem ACTION``.

    Raises:
        InputError: The action or its arguments are wrong.
    """
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return EXIT_DONE if words else EXIT_BAD_INPUT
    if words[0] not in ACTIONS:
        guess = did_you_mean(words[0], ACTIONS)
        message = f"pem {words[0]!r}: must be one of {', '.join(ACTIONS)}{guess}"
        raise InputError(message)
    module = import_module(module_of(words[0]))
    kind: type[Any] = getattr(module, ACTIONS[words[0]][0])
    carry_out: Callable[[Any], int] = module.run
    page: HelpPage | None = getattr(module, "PAGE", None)
    return carry_out(parse_arguments(kind, words[1:], command=f"pem {words[0]}", page=page))


def _overview() -> str:
    lines = [f"  {name.ljust(9)} {summary}" for name, (_, summary) in ACTIONS.items()]
    return "\n".join(["usage: pemviz pem ACTION [OPTIONS]", "", *lines])
