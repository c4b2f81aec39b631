"""What a page says, as data: sections of texts, tables and charts, before any medium draws it.

A medium has one renderer: :mod:`pemviz.reports.terminal`, :mod:`pemviz.reports.markdown`,
:mod:`pemviz.reports.html`. They decide how a block looks, never what it says: every number here
has its digits and every interval its caveats.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from pemviz.charts.chart import Chart

Tone = Literal["plain", "strong", "large", "quiet"]
Mark = Literal["yes", "no", "open"]


class Verbatim(str):
    """Text that others wrote, such as a formula or a digest: media set it in fixed width."""

    __slots__ = ()


@dataclass(frozen=True)
class Strip:
    """A cell that shows when something happens: words, and ends of marks as shares of it."""

    text: str
    spans: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Headline:
    """The answer in a few words, and what it is per."""

    text: str
    given: str = ""


def headline_text(headline: Headline) -> str:
    """The answer and what it is per, in one line."""
    return ", ".join(filter(None, (headline.text, headline.given)))


@dataclass(frozen=True)
class Paragraph:
    """A sentence or more."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class Caution:
    """What a reader must not miss."""

    text: str


@dataclass(frozen=True)
class Verdict:
    """What was decided: by sign, by words and, where there are any, by colour."""

    mark: Mark
    text: str


Cell = str | Strip | Verdict


def cell_text(cell: Cell) -> str:
    """A cell in words."""
    return cell if isinstance(cell, str) else cell.text


@dataclass(frozen=True)
class Bullets:
    """Texts below each other."""

    items: tuple[str, ...]
    numbered: bool = False


@dataclass(frozen=True)
class Code:
    """Several lines in fixed width."""

    text: str
    language: str = "text"


@dataclass(frozen=True)
class Table:
    """Rows of cells.

    Attributes:
        columns: Heads; all empty: a table of names and what they are.
        name: Stands over it, and is read to who does not see it.
        note: Stands beneath it.
        numbers: Columns that are set to the right.
        places: Number of each of the first rows that a click gives to ``target``.
        target: Which control of an interactive page takes clicks on rows.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    name: str = ""
    note: str = ""
    numbers: tuple[int, ...] = ()
    places: tuple[int, ...] = ()
    target: str = ""


@dataclass(frozen=True)
class Figure:
    """A chart and what it shows.

    Attributes:
        words: What media without pictures show in its place.
        target: Which control of an interactive page takes clicks on its points.
    """

    chart: Chart
    caption: str = ""
    words: "tuple[Block, ...]" = ()
    target: str = ""


@dataclass(frozen=True)
class Folded:
    """Blocks that an interactive page opens when asked; elsewhere they stand open."""

    title: str
    blocks: "tuple[Block, ...]"


Block = Headline | Paragraph | Caution | Verdict | Bullets | Code | Table | Figure | Folded


@dataclass(frozen=True)
class Section:
    """One subject: what a reader in a hurry needs, and all that is to be said."""

    key: str
    title: str
    brief: tuple[Block, ...]
    full: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """Sections in the order in which they are read, those that have something to say."""

    title: str
    sections: tuple[Section, ...]

    def choose(self, keys: Sequence[str]) -> Iterator[Section]:
        """Those of these sections that there are, in the order of ``keys``."""
        by_key = {section.key: section for section in self.sections}
        return (by_key[key] for key in keys if key in by_key)

    def blocks(self, *keys: str, brief: bool = False) -> tuple[Block, ...]:
        """All blocks of these sections, without their titles."""
        chosen = self.choose(keys)
        return tuple(b for section in chosen for b in (section.brief if brief else section.full))


def facts(rows: Sequence[tuple[str, str]]) -> Table:
    """A table of names and what they are."""
    return Table(columns=("", ""), rows=tuple(rows))


def figure(
    chart: Chart | None, *, caption: str = "", words: tuple[Block, ...] = (), target: str = ""
) -> tuple[Block, ...]:
    """A figure, or ``words`` alone where there is nothing to draw."""
    if chart is None:
        return words
    return (Figure(chart, caption=caption, words=words, target=target),)
