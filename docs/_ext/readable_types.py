"""Types in signatures as the source has them: ``FloatArray``, and a number without its range.

Sphinx writes out what an annotation stands for, which takes lines for an array. This puts itself
in front of the function that does so, and has to be imported before ``sphinx.ext.autodoc``.
"""

import re
from typing import Annotated, Any, get_args, get_origin

import sphinx.util.inspect
import sphinx.util.typing
from docutils import nodes
from sphinx.application import Sphinx

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, Rows

ALIASES = (
    ("FloatArray", FloatArray),
    ("BoolArray", BoolArray),
    ("IntArray", IntArray),
    ("Array", AnyArray),
    ("Rows", Rows),
)
FUNCTION = re.compile(r"<function (?:[\w.]*\.)?(\w+)[^>]*>")
MODULES = re.compile(r"~(?:\w+\.)+")
written_out = sphinx.util.typing.stringify_annotation


def readable(annotation: Any, *arguments: Any, **options: Any) -> str:
    """An annotation in words, arrays by their names and without ranges."""
    if get_origin(annotation) is Annotated:
        return readable(get_args(annotation)[0], *arguments, **options)
    name = next((name for name, alias in ALIASES if annotation == alias), None)
    return name or written_out(annotation, *arguments, **options)


sphinx.util.typing.stringify_annotation = readable
sphinx.util.inspect.stringify_annotation = readable


def signature_text(*event: Any) -> tuple[str, str] | None:
    """A signature that parses: names without their modules, no value that is made by a call.

    A protocol has none, as it is not made by calling it.
    """
    _, _, _, thing, _, signature, returned = event
    if getattr(thing, "_is_protocol", False):
        return "", ""
    if signature is None:
        return None
    plain = FUNCTION.sub(r"\1", signature.replace("<factory>", "..."))
    return MODULES.sub("", plain), returned


def with_dashes(app: Sphinx, page: nodes.document) -> None:
    """A dash between a parameter and what it is, which Sphinx writes as two hyphens."""
    del app
    for text in list(page.findall(nodes.Text)):
        if text.astext() == " -- ":
            text.parent.replace(text, nodes.Text(": "))


def setup(app: Sphinx) -> dict[str, Any]:
    """Tidy signatures."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-signature", signature_text)
    app.connect("doctree-read", with_dashes)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
