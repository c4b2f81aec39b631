"""Pages of commands, made from the dataclasses that their arguments are parsed into.

A block ``{pemviz-command}`` holds what is typed behind ``pemviz``; in its place stand what
``--help`` prints, and every option with what it takes, its default and what it does, each with an
anchor and an entry in the index. A command without a page is a warning, and so an error.
"""

import re
from importlib import import_module
from inspect import cleandoc
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from pemviz.cli.completion import argument_kinds
from pemviz.cli.help import HelpPage, Option, options_of
from pemviz.cli.main import COMMANDS
from pemviz.cli.pem.command import ACTIONS

LOGGER = logging.getLogger(__name__)
FOLDER = "reference/command-line"
BLOCK = re.compile(r"^```\{pemviz-command\}\n([\w -]+)\n```$", re.MULTILINE)
SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|$~])")
OPTION = re.compile(r"(?<![\w-])(--[a-z][\w.-]*\w)")
QUOTED = re.compile(r"'(pemviz [^']*)'")


def markdown(text: str) -> str:
    """Plain text with options and quoted commands as code, and nothing else as markup."""
    pieces = QUOTED.split(text)
    return "".join(
        f"`{piece}`" if place % 2 else _with_options(piece) for place, piece in enumerate(pieces)
    )


def _with_options(text: str) -> str:
    pieces = OPTION.split(text)
    return "".join(
        f"`{piece}`" if place % 2 else SPECIAL.sub(r"\\\1", piece)
        for place, piece in enumerate(pieces)
    )


def kinds() -> dict[str, Any]:
    """The dataclass of the arguments of each command, by what is typed behind ``pemviz``."""
    by_name = argument_kinds()
    actions = by_name.pop("pem")
    return {**by_name, **{f"pem {action}": kind for action, kind in actions.items()}}


def summary(command: str) -> str:
    """One line that says what a command does, as the overview of all has it."""
    first, _, action = command.partition(" ")
    return ACTIONS[action][1] if action else COMMANDS[first].summary


def page_name(command: str) -> str:
    """The name of a command's page."""
    return command.replace(" ", "-")


def option_text(option: Option) -> str:
    """An option as a directive."""
    is_switched_off = option.words.startswith("--no-") and option.default == "True"
    ends = {None: " Required.", "": "", "True": ""}
    default = ends.get(option.default, f" Default: `{option.default}`.")
    text = f"{markdown(option.text)}{default}"
    text = f"Leave this out: {text}" if is_switched_off else text
    return f"::::{{option}} {option.words}\n{text}\n::::\n"


def topics(page: HelpPage | None, options: list[Option]) -> dict[str, list[Option]]:
    """Options by topic; all under one where the command has no page."""
    if page is None or not page.topics:
        return {"": options}
    by_topic: dict[str, list[Option]] = {name: [] for name in (*page.topics, "more")}
    for option in options:
        by_topic[page.topic_of(option.name)].append(option)
    return {name: those for name, those in by_topic.items() if those}


def command_text(command: str) -> str:
    """The page of a command, below its title, as Markdown."""
    kind = kinds()[command]
    module = import_module(kind.__module__)
    page: HelpPage | None = getattr(module, "PAGE", None)
    first, _, action = command.partition(" ")
    about = getattr(import_module(COMMANDS[first].module), "DESCRIPTION", "") if not action else ""
    about = about or cleandoc(kind.__doc__ or "").replace("\n", " ")
    parts = [f"```{{program}} pemviz {command}\n```\n"]
    if page is None:
        parts.append(f"{markdown(about)}\n")
    else:
        parts.append(f"```text\n{page.text.strip()}\n```\n")
    for topic, options in topics(page, list(options_of(kind))).items():
        title = f"Options: {topic}" if topic else "Options"
        note = "" if page is None else page.notes.get(topic, "")
        parts.append(f"## {title}\n\n{markdown(note) if '- ' not in note else note}\n")
        parts.extend(option_text(option) for option in options)
    return "\n".join(parts)


def write_pages(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put a command's page in place of the block that names it, before anything is parsed."""

    def written(block: re.Match[str]) -> str:
        app.env.note_dependency(import_module(kinds()[block[1]].__module__).__file__ or "")
        return command_text(block[1])

    if docname.startswith(FOLDER):
        source[0] = BLOCK.sub(written, source[0])


class Commands(SphinxDirective):
    """A table of all commands, each with a link to its page."""

    def run(self) -> list[nodes.Node]:
        """The table's nodes."""
        rows = [
            f"| [`pemviz {name}`](/{FOLDER}/{page_name(name)}.md) | {markdown(summary(name))} |"
            for name in kinds()
        ]
        return self.parse_text_to_nodes("\n".join(["| command | what |", "|---|---|", *rows]))


def complain_of_missing_pages(app: Sphinx) -> None:
    """Every command has a page, and every page a command."""
    there = {path.stem for path in (app.srcdir / FOLDER).glob("*.md")}
    for name in sorted(there ^ {page_name(command) for command in kinds()}):
        LOGGER.warning("%s/%s.md: must be there exactly if there is such a command", FOLDER, name)


def setup(app: Sphinx) -> dict[str, Any]:
    """Let pages use the directives."""
    app.connect("source-read", write_pages)
    app.add_directive("pemviz-commands", Commands)
    app.connect("builder-inited", complain_of_missing_pages)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
