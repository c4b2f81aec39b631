"""The error of everything a user can get wrong about a formula."""

from __future__ import annotations

from pemviz.errors import InputError


class FormulaError(InputError):
    """A formula is malformed, ill-typed, or does not fit the signals it is asked of.

    ``str(error)`` is one line. Where the mistake has a place in a text, that line
    names it, and ``explain()`` (also a note of the exception) shows it.

    Attributes:
        line: line of the mistake, counted from 1; None without a text.
        column: column of the mistake, counted from 1; None without a text.
        excerpt: the offending line of the text with a caret under the mistake.
    """

    def __init__(
        self,
        message: str,
        *,
        line: int | None = None,
        column: int | None = None,
        excerpt: str | None = None,
    ) -> None:
        where = "" if line is None else f"formula, line {line}, column {column}: "
        super().__init__(where + message)
        self.line = line
        self.column = column
        self.excerpt = excerpt
        if excerpt is not None:
            self.add_note(excerpt)

    def explain(self) -> str:
        """The message and, below it, the offending line with a caret (several lines)."""
        return str(self) if self.excerpt is None else f"{self}\n{self.excerpt}"


EXCERPT_WIDTH = 76


def shorten(text: object, length: int = 40) -> str:
    """``text`` cut to ``length`` characters."""
    whole = str(text)
    return whole if len(whole) <= length else whole[: length - 3] + "..."


def error_at(text: str, position: int, message: str) -> FormulaError:
    """The error that points at ``text[position]`` (or just behind the text's end)."""
    position = min(max(position, 0), len(text))
    line_start = text.rfind("\n", 0, position) + 1
    line_end = text.find("\n", position)
    line_text = text[line_start : line_end if line_end >= 0 else len(text)]
    column = position - line_start
    first = max(0, column - EXCERPT_WIDTH // 2)
    printable = "".join(
        c if c.isprintable() else " " for c in line_text[first : first + EXCERPT_WIDTH]
    )
    excerpt = f"  {printable}\n  {' ' * (column - first)}^"
    line = text.count("\n", 0, position) + 1
    return FormulaError(message, line=line, column=column + 1, excerpt=excerpt)
