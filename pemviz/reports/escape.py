"""Text that others wrote, made harmless in markdown and XML."""

import re
import unicodedata

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
# an underscore inside a word and a colon before a space do nothing, and read better as they are
MARKDOWN_ACTIVE = re.compile(r"[\\`*{}\[\]<>#|~@&$]|(?<![^\W_])_|_(?![^\W_])|:(?!\s|$)")
# categories: control, format (bidirectional overrides too), surrogate, private, unassigned
UNPRINTABLE = frozenset(("Cc", "Cf", "Cs", "Co", "Cn"))


def printable_line(text: str) -> str:
    """One line: runs of whitespace become a space, unprintable characters a replacement mark."""
    words = " ".join(text.split())
    return "".join(
        REPLACEMENT if unicodedata.category(character) in UNPRINTABLE else character
        for character in words
    )


def printable_lines(text: str) -> str:
    """Several lines, each as :func:`printable_line` but with its spaces kept."""
    lines = text.splitlines()
    return "\n".join(
        "".join(
            REPLACEMENT if unicodedata.category(character) in UNPRINTABLE else character
            for character in line.expandtabs(4)
        )
        for line in lines
    )


def markdown_text(text: str) -> str:
    """Text for a paragraph, list item or table cell that shows as it is.

    Whatever markdown could act on becomes a numeric character reference: neither a table's
    bars nor HTML, links, mentions or formulas can come out of ``text``.
    """
    escaped = MARKDOWN_ACTIVE.sub(lambda found: f"&#{ord(found[0])};", printable_line(text))
    return escaped.replace("www.", "www&#46;")


def markdown_code(text: str) -> str:
    """Text in fixed width, for the same places; a code span could not hold bars and backticks."""
    return f"<code>{markdown_text(text)}</code>"


def markdown_block(text: str, *, language: str = "text") -> str:
    """Several lines in a fence that is longer than any run of backticks in them."""
    printable = printable_lines(text)
    longest = run = 0
    for character in printable:
        run = run + 1 if character == "`" else 0
        longest = max(longest, run)
    fence = "`" * max(3, longest + 1)
    return f"{fence}{language}\n{printable}\n{fence}"


def markdown_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table of cells that are markdown already."""
    lines = [header, tuple("---" for _ in header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
