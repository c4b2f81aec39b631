"""The page that puts all tables and figures together."""

import platform
from collections.abc import Sequence
from importlib import metadata

from pemviz._version import __version__
from pemviz.pem import Pem
from pemviz.reports.escape import markdown_code, markdown_table, markdown_text
from pemviz.reproduce.published import AUTHORS_PEM_DIGEST
from pemviz.reproduce.settings import Settings

VERSIONED = ("numpy", "scipy", "torch", "scikit-learn", "matplotlib")

INTRODUCTION = (
    "Innes & Ramamoorthy, *Testing Rare Downstream Safety Violations via Upstream Adaptive "
    "Sampling of Perception Error Models* (arXiv 2209.09674): our figures beside the published "
    "ones. 'not given here' marks a figure of the paper that is not known here."
)


def page_markdown(settings: Settings, *, pem: Pem, sections: Sequence[str], wall_s: float) -> str:
    """Introduction, sections, provenance.

    Args:
        settings: What was asked.
        pem: The error model that Tables II and III and the figures rest on.
        sections: Markdown of each table and figure.
        wall_s: How long it took.
    """
    parts = ["# The paper reproduced", INTRODUCTION, *(section.strip() for section in sections)]
    if "table1" in settings.parts and settings.data is None:
        parts.append(
            "## Table I: perception error models\n\nLeft out: it needs the paper's training set, "
            "given with `--data`."
        )
    parts += ["## Provenance", _provenance(settings, pem, wall_s)]
    return "\n\n".join(parts) + "\n"


def _provenance(settings: Settings, pem: Pem, wall_s: float) -> str:
    whose = "the authors' own network" if pem.digest == AUTHORS_PEM_DIGEST else "ours"
    versions = [f"pemviz {__version__}", f"Python {platform.python_version()}"]
    versions += [f"{name} {metadata.version(name)}" for name in VERSIONED]
    rows = [
        ("experiment", "preset `paper`, vectorized back end"),
        ("repetitions", str(settings.repetitions)),
        ("seed", str(settings.seed)),
        ("perception error model", f"{markdown_code(pem.name)}, {whose}"),
        ("its data", markdown_text(pem.data)),
        ("its digest (SHA-256)", markdown_code(pem.digest)),
        ("versions", markdown_text(", ".join(versions))),
        ("wall time", f"{wall_s:.0f} s with {settings.workers} processes"),
    ]
    return markdown_table(("what", "value"), rows)
