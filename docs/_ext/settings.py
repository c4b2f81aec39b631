"""The page of settings, made from the dataclasses of the configuration.

``{pemviz-settings}`` writes every field that belongs to a topic or to a table of the file, with
type, range, unit, default and meaning; ``{pemviz-starts}`` and ``{pemviz-presets}`` write tables.
"""

import re
from dataclasses import MISSING, Field, fields
from types import MappingProxyType
from typing import Any, get_type_hints

from commands import markdown
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from pemviz.config import EncounterConfig, ExperimentConfig, ScenarioConfig
from pemviz.config.encounters import FALSE_POSITIVE_GAP, NEIGHBOUR_GAP, START_VALUES
from pemviz.config.ranges import allowed_text, allows_none, field_docs
from pemviz.config.settings import SumoConfig
from pemviz.config.toml_files import preset_names, preset_words
from pemviz.config.topics import TOPICS, topic_of

TABLES = MappingProxyType(
    {"scenario": ScenarioConfig, "encounter": EncounterConfig, "sumo": SumoConfig}
)
OWN = MappingProxyType(
    {
        "rules": ("table of name = formula", "none"),
        "start": ("table of name = value or distribution", "the logical scenario's"),
    }
)
"""Fields that are spelled in files otherwise than they are held."""
UNIT = re.compile(r"\[([^\]\s]+)\]")


def field_text(kind: type, one: "Field[Any]", *, table: str = "") -> str:
    """A field as a directive."""
    annotation = get_type_hints(kind, include_extras=True)[one.name]
    words = field_docs(kind)[one.name]
    allowed, default = OWN.get(one.name, (allowed_text(annotation), ""))
    unit = UNIT.search(words)
    if unit and "number" in allowed:
        allowed = allowed.replace("number", f"number [{unit[1]}]", 1)
    if not default:
        default = _default(one)
    if allows_none(annotation) and default == "none":
        default = "left out"
    name = f"{table}.{one.name}" if table else one.name
    return "\n".join(
        [
            f"::::{{confval}} {name}",
            f":type: {markdown(allowed)}",
            f":default: {markdown(default)}",
            "",
            markdown(words),
            "::::",
            "",
        ]
    )


def _default(one: "Field[Any]") -> str:
    value = one.default if one.default is not MISSING else None
    if isinstance(value, bool):
        return str(value).lower()
    if value is None or value == ():
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


class Settings(SphinxDirective):
    """Writes the settings of a topic, or of a table of the file."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The settings' nodes."""
        part = self.arguments[0]
        if part in TABLES:
            kind, table = TABLES[part], part
            chosen = fields(kind)
        else:
            kind, table = ExperimentConfig, ""
            chosen = tuple(
                one for one in fields(kind)
                if one.name not in TABLES and (_topic(one.name) == part)
            )  # fmt: skip
        text = "\n".join(field_text(kind, one, table=table) for one in chosen)
        return self.parse_text_to_nodes(text)


def _topic(name: str) -> str | None:
    return topic_of({"rules": "rule"}.get(name, name), TOPICS)


class Starts(SphinxDirective):
    """Writes the start values of every logical scenario."""

    def run(self) -> list[nodes.Node]:
        """The table's nodes."""
        rows = [
            f"| {name} | `{value.name}` | {value.unit} | `{value.distribution}` |"
            for name, values in (
                *START_VALUES.items(),
                ("all, with `encounter.neighbour`", (NEIGHBOUR_GAP,)),
                ("all, with `encounter.ghost_probability`", (FALSE_POSITIVE_GAP,)),
            )
            for value in values
        ]
        head = ["| logical scenario | name | unit | distribution |", "|---|---|---|---|"]
        return self.parse_text_to_nodes("\n".join([*head, *rows]))


class Presets(SphinxDirective):
    """Writes a table of the shipped presets."""

    def run(self) -> list[nodes.Node]:
        """The table's nodes."""
        rows = [f"| `{name}` | {markdown(preset_words(name))} |" for name in preset_names()]
        return self.parse_text_to_nodes("\n".join(["| preset | what |", "|---|---|", *rows]))


def setup(app: Sphinx) -> dict[str, Any]:
    """Let pages use the directives."""
    app.add_directive("pemviz-settings", Settings)
    app.add_directive("pemviz-starts", Starts)
    app.add_directive("pemviz-presets", Presets)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
