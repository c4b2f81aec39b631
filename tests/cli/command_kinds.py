"""Every command with the dataclass of its arguments, for tests of what names options."""

from importlib import import_module

from pemviz.cli.completion import argument_kinds
from pemviz.cli.help import options_of

KINDS = argument_kinds()
COMMANDS = {
    **{name: kind for name, kind in KINDS.items() if not isinstance(kind, dict)},
    **{f"pem {action}": kind for action, kind in KINDS["pem"].items()},
}
"""By what is typed behind ``pemviz``."""
PAGES = [name for name, kind in COMMANDS.items() if hasattr(import_module(kind.__module__), "PAGE")]
"""Those whose help is a page by purpose."""

BY_PRESET = {"record": {"--no-plan"}}
"""What a preset has switched on, an option of this name switches off."""


def option_names(command):
    """A command's options as they are typed."""
    words = (option.words.split()[0] for option in options_of(COMMANDS[command]))
    return {word for word in words if word.startswith("--")} | BY_PRESET.get(command, set())
