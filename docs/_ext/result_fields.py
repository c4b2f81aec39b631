"""Tables of what ``result.json`` holds, made from its schema.

In place of a block ``{pemviz-result}`` stands a table for the document and for each type in it.
"""

from typing import Any

from commands import markdown
from result_schema import result_schema
from sphinx.application import Sphinx

BLOCK = "```{pemviz-result}\n```\n"
ELSEWHERE = ("ExperimentConfig", "ScenarioConfig", "EncounterConfig", "SumoConfig")
"""Types that the page of settings has."""


def kind_of(schema: dict[str, Any]) -> str:
    """What a value is, in words, with a link where it is a table of its own."""
    if "anyOf" in schema:
        return " or ".join(kind_of(arm) for arm in schema["anyOf"])
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        target = "settings.md" if name in ELSEWHERE else f"#result-{name.lower()}"
        return f"[{name}]({target})"
    if "enum" in schema:
        return ", ".join("null" if one is None else f"`{one}`" for one in schema["enum"])
    kind = schema["type"]
    if isinstance(kind, list):
        return f"{kind_of({**schema, 'type': kind[0]})} or null"
    return f"list of {kind_of(schema['items'])}" if kind == "array" else _plain_kind(schema)


def _plain_kind(schema: dict[str, Any]) -> str:
    kind = schema["type"]
    inner = schema.get("additionalProperties")
    if kind == "object" and isinstance(inner, dict):
        return f"table of {kind_of(inner)} by name"
    return "table" if kind == "object" else f"{kind}{_limits(schema)}"


def _limits(schema: dict[str, Any]) -> str:
    words = {
        "minimum": "at least", "exclusiveMinimum": "above",
        "maximum": "at most", "exclusiveMaximum": "below",
    }  # fmt: skip
    told = [f"{word} {schema[key]:g}" for key, word in words.items() if key in schema]
    shown = [one for one in told if not one.endswith(("1e+300", "9.0072e+15"))]
    return f", {' and '.join(shown)}" if shown else ""


def table_of(schema: dict[str, Any]) -> str:
    """The fields of a table as Markdown."""
    rows = [
        f"| `{name}` | {kind_of(field)}{'' if name in schema['required'] else '; may be absent'} "
        f"| {markdown(field.get('description', ''))} |"
        for name, field in schema["properties"].items()
    ]
    return "\n".join(["| field | type | what |", "|---|---|---|", *rows, ""])


def result_text() -> str:
    """All tables as Markdown."""
    schema = result_schema()
    parts = [table_of(schema)]
    for name, kind in schema["$defs"].items():
        if name not in ELSEWHERE:
            head = f"(result-{name.lower()})=\n### {name}\n\n{markdown(kind['description'])}\n\n"
            parts.append(head + table_of(kind))
    return "\n".join(parts)


def write_tables(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the tables in place of the block, before anything is parsed."""
    del app
    if docname.startswith("reference/"):
        source[0] = source[0].replace(BLOCK, result_text())


def setup(app: Sphinx) -> dict[str, Any]:
    """Let pages have the tables."""
    app.connect("source-read", write_tables)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
