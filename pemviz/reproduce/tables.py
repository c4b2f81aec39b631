"""Tables as markdown for people and CSV for programs."""

import csv
import io
from dataclasses import dataclass

from pemviz.reports.escape import markdown_table, markdown_text

Cell = str | float | int | None


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        key: Its name in the CSV file, with its unit.
        title: Its heading in markdown; empty leaves it out there.
        form: Format of its numbers in markdown.
        absent: Shown in markdown where there is no figure.
    """

    key: str
    title: str
    form: str = ".3g"
    absent: str = "-"


@dataclass(frozen=True)
class Table:
    """A table with a sentence for every difference that needs one.

    Attributes:
        name: Of its files.
        title: Its heading.
        columns: The columns.
        rows: As many cells as columns each.
        remarks: Sentences beneath it.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    remarks: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Heading, table and remarks."""
        titled = [index for index, column in enumerate(self.columns) if column.title]
        header = tuple(self.columns[index].title for index in titled)
        rows = [
            tuple(_shown(row[index], self.columns[index]) for index in titled) for row in self.rows
        ]
        parts = [f"## {self.title}", markdown_table(header, rows)]
        if self.remarks:
            parts.append("\n".join(f"- {remark}" for remark in self.remarks))
        return "\n\n".join(parts) + "\n"

    def csv(self) -> str:
        """All columns with every digit; an empty cell where there is no figure."""
        return csv_text(
            [column.key for column in self.columns],
            [["" if cell is None else cell for cell in row] for row in self.rows],
        )


def csv_text(header: list[str], rows: list[list[str | float | int]]) -> str:
    """Comma-separated values."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def _shown(cell: Cell, column: Column) -> str:
    if cell is None:
        return column.absent
    return markdown_text(cell) if isinstance(cell, str) else format(cell, column.form)
