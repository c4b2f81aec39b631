"""The Why tab."""

from pemviz.panel.rundata import RunData


def why(run: RunData | None) -> str:
    return ""
