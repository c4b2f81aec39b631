"""Predictive checks of an error model as a document: verdicts, and what each rests on."""

from pemviz.pem.models.predictive_check import (
    CHECK_MEANS,
    FAMILY_WISE,
    VARIANT_WORDS,
    CheckedQuantity,
    ModelCheck,
    by_quantity,
    check_rows,
    expected_words,
    title_words,
    verdict_lines,
)
from pemviz.reports.document import (
    Block,
    Bullets,
    Cell,
    Document,
    Paragraph,
    Section,
    Table,
    Verdict,
)


def check_document(check: ModelCheck, *, model: str, table: str) -> Document:
    """All that is said of a check of a model, or a kind of model, against a table of tracks."""
    on_what, *verdicts = verdict_lines(check)
    marks = [
        Verdict("no" if variant.refuted else "yes", line)
        for variant, line in zip(check.variants, verdicts, strict=True)
    ]
    said: list[Block] = [Paragraph(on_what), *marks]
    head, rows = check_rows(check)
    table_of_all = Table(tuple(head), tuple(rows), numbers=(1,))
    return Document(
        f"Predictive checks of {model} on {table}",
        (
            Section("verdict", "Verdict", (*said, _short_table(check)), tuple(said)),
            Section("quantities", "What was compared", (), (Paragraph(CHECK_MEANS), table_of_all)),
            Section("limits", "Limits", (), (Bullets(LIMITS),)),
        ),
    )


LIMITS = (
    "The p-values take the fitted model as given: that it was fitted to a limited number of "
    "sequences is not part of them, so with few sequences a right kind of model is refuted "
    "more often.",
    "Under the model tracks are independent given their states. Obstacles of one drive that are "
    "missed together, as by rain or glare, are a difference that the checks may find.",
    "Misses are counted where a labelled track is: what the detector reports elsewhere is not "
    "looked at.",
)


def _short_table(check: ModelCheck) -> Table:
    """What was observed, and the mean of each variant with a sign for its verdict."""
    head = ("quantity", "observed", *(VARIANT_WORDS[one.name] for one in check.variants))
    rows = tuple((*title_words(each[0]), *map(_cell, each)) for each in by_quantity(check))
    note = f"x: refuted, at a family-wise rate of {FAMILY_WISE:.0%} a variant"
    return Table(head, rows, note=note, numbers=tuple(range(1, len(head))))


def _cell(one: CheckedQuantity) -> Cell:
    return f"{'x ' if one.refuted else ''}{expected_words(one)}"
