"""Pages of the documentation ask no other host for anything.

With ``PEMVIZ_SITE`` of a site that was built, else of a page that is built here by the same
configuration, which takes Sphinx (``pip install '.[docs]'``).
"""

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}
"""Attributes of which a browser fetches the value to show the page."""
NOT_LOADED = {"canonical", "index", "search", "next", "prev"}
"""Of links: ``rel`` of those that lead somewhere."""
ELSEWHERE = re.compile(r"(?:https?:)?//", re.IGNORECASE)
IN_STYLE = re.compile(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", re.IGNORECASE)
PAGE = """# Everything that a page may need

Math, $p = 1$, and a picture, ![a picture](picture.png).

```{math}
p = \\int q
```

```python
import pemviz
```

:::{grid-item-card} A card
:::

```{toctree}
other
```
"""


class Fetched(HTMLParser):
    """What a browser fetches for a page, by address."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag in LOADED and values.get("rel") not in NOT_LOADED:
            self.addresses.append(values.get(LOADED[tag]) or "")
        self.addresses += [values["srcset"]] if "srcset" in values else []


def asked_elsewhere(page):
    """What a page of HTML fetches from another host."""
    reader = Fetched()
    reader.feed(page)
    return [one for one in reader.addresses if ELSEWHERE.match(one)] + IN_STYLE.findall(page)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if given := os.environ.get("PEMVIZ_SITE"):
        return Path(given)
    for name in ("sphinx", "myst_nb", "furo", "sphinx_design", "sphinx_copybutton"):
        pytest.importorskip(name, reason="the site is built with pip install '.[docs]'")
    source = tmp_path_factory.mktemp("docs")
    for name in ("conf.py", "_ext", "_static"):
        place = ROOT / "docs" / name
        (shutil.copytree if place.is_dir() else shutil.copy)(place, source / name)
    (source / "index.md").write_text(PAGE)
    (source / "other.md").write_text("# Another page\n")
    shutil.copy(ROOT / "assets" / "pictures" / "panel-run.png", source / "picture.png")
    built = source / "built"
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", str(source), str(built)]
    subprocess.run(command, check=True, timeout=240)
    return built


def test_no_page_asks_another_host(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) >= 3
    found = {
        page.relative_to(site).as_posix(): asked
        for page in pages
        if (asked := asked_elsewhere(page.read_text(encoding="utf-8")))
    }
    assert found == {}


def test_no_style_asks_another_host(site):
    styles = [p for p in sorted(site.rglob("*.css")) if "mathjax" not in p.parts]
    assert len(styles) >= 3
    assert [p.name for p in styles if IN_STYLE.search(p.read_text(encoding="utf-8"))] == []


def test_formulas_are_drawn_by_what_comes_with_the_site(site):
    with_math = [p for p in site.rglob("*.html") if "math notranslate" in p.read_text()]
    assert with_math
    for page in with_math:
        loaded = re.findall(r'src="([^"]*mathjax[^"]*\.js)[^"]*"', page.read_text())
        assert loaded
        assert all((page.parent / name).resolve().is_file() for name in loaded)


@pytest.mark.parametrize(
    "page",
    [
        '<script defer src="https://cdn.example.org/x.js"></script>',
        "<link rel='stylesheet' href='//fonts.example.org/x.css'>",
        '<img alt="" src="http://example.org/x.png">',
        "<style>@import url(https://example.org/x.css)</style>",
    ],
)
def test_what_asks_another_host_is_found(page):
    assert asked_elsewhere(page)


def test_a_link_to_another_host_is_none_that_asks_it():
    assert not asked_elsewhere('<a href="https://arxiv.org/abs/2209.09674">a paper</a>')
    assert not asked_elsewhere('<link rel="canonical" href="https://example.org/">')
