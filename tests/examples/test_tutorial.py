"""The tutorial runs from its first cell to its last, and its kept outputs are what it gives."""

from pathlib import Path

import nbclient
import nbformat
import pytest

TUTORIAL = Path(__file__).resolve().parents[2] / "examples" / "tutorial.ipynb"
LONGEST_CELL_S = 300


def outputs(notebook):
    """Kinds of what each code cell shows, and all text that it prints."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    kinds = [[sorted(out.get("data", {})) for out in cell.outputs] for cell in cells]
    printed = "".join(out.text for cell in cells for out in cell.outputs if "text" in out)
    return kinds, printed


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of what nbclient itself is made of
def test_the_tutorial_runs_and_shows_what_it_keeps():
    """Half a minute on two cores: a run with plan and memory curve, and five figures."""
    kept = nbformat.read(TUTORIAL, as_version=4)
    fresh = nbformat.read(TUTORIAL, as_version=4)
    for cell in fresh.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    nbclient.NotebookClient(fresh, timeout=LONGEST_CELL_S, kernel_name="python3").execute()
    kept_kinds, kept_text = outputs(kept)
    kinds, text = outputs(fresh)
    assert kinds == kept_kinds
    assert [kind for cell in kinds for kind in cell].count(["image/png", "text/plain"]) == 5
    # learning amplifies the last digit's rounding between machines: ten standard errors
    old, new = (float(words.split(",")[0]) for words in (kept_text, text))
    assert new == pytest.approx(old, rel=0.65)
    assert len(text.splitlines()) == len(kept_text.splitlines()) >= 4
