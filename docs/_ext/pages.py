"""``{pages}``: a toctree that takes pages in the order listed, those that are there, then others.

What is named and not there, and a pattern that nothing more fits, are left out without a warning:
a page appears with its file, in its place.
"""

from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.directives.other import TocTree
from sphinx.util.matching import patfilter


class Pages(TocTree):
    """Resolves names and patterns before the toctree sees them."""

    def run(self) -> list[nodes.Node]:
        """The toctree's nodes."""
        there = set(self.env.found_docs) - {self.env.docname}
        found: dict[str, None] = {}
        for entry in self.content:
            found |= dict.fromkeys(sorted(patfilter(there, entry)))
        self.content = StringList(list(found), source=self.env.docname)
        self.env.note_reread()  # pages come and go
        return super().run()


def setup(app: Sphinx) -> dict[str, Any]:
    """Let pages use the directive."""
    app.add_directive("pages", Pages)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
