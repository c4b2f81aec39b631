"""README as a package index shows it leads nowhere that is not there."""

import re
import tomllib
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]


def shown():
    """README after the substitutions that the build makes."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    hook = project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    text = "".join((ROOT / part["path"]).read_text(encoding="utf-8") for part in hook["fragments"])
    for one in hook["substitutions"]:
        text = re.sub(one["pattern"], one["replacement"], text)
    return text


def targets(text):
    for block in MarkdownIt().enable("table").parse(text):
        for token in block.children or ():
            yield from (token.attrs[key] for key in ("href", "src") if key in token.attrs)


def test_links_and_pictures_are_whole_addresses():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    relative = [one for one in targets(readme) if not one.startswith("https://")]
    assert len(relative) > 3
    assert [one for one in targets(shown()) if not one.startswith("https://")] == []
    assert len(shown()) > 0.8 * len(readme)
