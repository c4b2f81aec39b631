"""Risk budgets beside the runs: files named ``*.budget.toml`` in the recordings folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pemviz.config.risk_budget import load_budget
from pemviz.errors import InputError
from pemviz.reports import html
from pemviz.reports.budget_document import MARKS, budget_document, verdict_sentence
from pemviz.runs.result_file import RESULT_FILE
from pemviz.runs.risk_budget import judge_budget

ENDING = ".budget.toml"
MOST = 20
Row = Mapping[str, Any]


class Budgets:
    """Judged when asked for, and again when the file or a result that it names has changed."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._judged: dict[Path, tuple[tuple[int, ...], Row]] = {}

    def rows(self) -> list[Row]:
        """A line for each budget, by name: whether it is met, and its page."""
        try:
            found = sorted(path for path in self._root.iterdir() if path.name.endswith(ENDING))
        except OSError:
            return []
        return [self._row(path) for path in found[:MOST] if path.is_file()]

    def _row(self, path: Path) -> Row:
        name = path.name.removesuffix(ENDING)
        try:
            stamps = _stamps(path)
            known = self._judged.get(path)
            if known is None or known[0] != stamps:
                judged = judge_budget(path)
                first, *others = budget_document(judged).sections
                below = html.blocks_html(first.full[1:])  # the verdict stands above already
                row = {
                    "name": name,
                    "mark": MARKS[judged.outcome],
                    "verdict": verdict_sentence(judged),
                    "page": below + html.sections_html(others),
                }
                known = self._judged[path] = stamps, row
            return known[1]
        except InputError as error:
            return {"name": name, "mark": "open", "verdict": str(error), "page": ""}


def _stamps(path: Path) -> tuple[int, ...]:
    """When the budget and the results that it names were written.

    Raises:
        InputError: It is damaged.
    """
    runs = [run for hazard in load_budget(path).hazards for run in hazard.runs]
    files = (path, *(path.parent / run / RESULT_FILE for run in runs))
    return tuple(file.stat().st_mtime_ns if file.is_file() else 0 for file in files)
