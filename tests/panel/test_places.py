"""What the table of runs and the page of a run ask for, without a browser."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from pemviz.errors import InputError
from pemviz.panel.arguments import Arguments
from pemviz.panel.controller import Controller, PanelState
from pemviz.panel.hub import Hub
from pemviz.panel.ranking import rank
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.run_place import DOCUMENTS, DRAWN, RunPlace
from pemviz.panel.runs_place import RunsPlace
from pemviz.panel.site import dumps
from pemviz.runs.answers import answers
from tests.budgets import hazard, write_budget


class Scene:
    """Notes what it is to show."""

    def __init__(self) -> None:
        self.shown = None

    def show(self, drawn, *, step):
        self.shown = (drawn, step)

    def at(self, step, *, follow):
        self.shown = (step, follow)


class Page:
    def __init__(self) -> None:
        self.scene = Scene()


@pytest.fixture
def place(kept, tmp_path):
    root = tmp_path / "recordings"
    shutil.copytree(kept[0], root / kept[0].name)
    controller = Controller(root)
    yield RunsPlace(Hub(controller, RecordingsFolder(root)))
    controller.close()


def ask(place, name, **values):
    found = place.requests[name](Page(), Arguments(values))
    dumps(found)  # all of it can be said
    return found


def test_rows_tell_what_results_do(place, kept, live_run):
    rows = ask(place, "runs")["rows"]
    row = next(row for row in rows if row["name"] == kept[0].name)
    first = answers(live_run.result)[0]
    assert row["probability"] == first.estimate.probability
    assert (row["low"], row["high"]) == (first.open.low, first.open.high)
    assert row["rollouts"] == live_run.simulated
    assert row["kept"]
    assert [row["name"] for row in rows if not row["kept"]] == ["sample"]


def test_what_is_deleted_comes_back_until_it_is_forgotten(place, kept):
    name = kept[0].name
    ask(place, "note", run=name, text="the first")
    ask(place, "delete", runs=[name])
    assert name not in [row["name"] for row in ask(place, "runs")["rows"]]
    ask(place, "put_back", runs=[name])
    (row,) = [row for row in ask(place, "runs")["rows"] if row["name"] == name]
    assert row["note"] == "the first"
    ask(place, "delete", runs=[name])
    ask(place, "delete", runs=[])  # the next deletion is for good
    with pytest.raises(InputError, match="cannot be brought back"):
        ask(place, "put_back", runs=[name])


@pytest.mark.parametrize("name", ["../x", ".x", "", "a/b", "/etc"])
def test_no_name_reaches_out_of_the_folder(place, name):
    for request in ("delete", "put_back"):
        with pytest.raises(InputError):
            ask(place, request, runs=[name])
    for address in (f"{name}/result.json", f"{name}/../result.json", "x/notes.txt"):
        with pytest.raises(InputError):
            place.download(address)


def test_a_run_under_way_is_not_deleted(place, live_run, monkeypatch):
    state = PanelState(run=replace(live_run, running=True), running=True)
    monkeypatch.setattr(type(place._hub.controller), "state", property(lambda self: state))
    with pytest.raises(InputError, match="is under way"):
        ask(place, "delete", runs=[live_run.name])


def test_files_are_those_of_the_run(place, kept):
    name, content = place.download(f"{kept[0].name}/result.json")
    assert name.endswith("result.json")
    assert content == (kept[0] / "result.json").read_bytes()


def test_the_ranking_is_that_of_the_run(live_run):
    place = RunPlace(lambda name: live_run)
    found = ask(place, "ranking", run="x", among="all", first="least robust", count=200)
    expected = rank(live_run, live_run.config.metric, among="all")
    assert found["count"] == expected.order.size == live_run.kept
    assert [row["index"] for row in found["rows"]] == expected.order[:200].tolist()
    later = ask(place, "ranking", run="x", among="all", first="least robust", start=7, count=3)
    assert [row["rank"] for row in later["rows"]] == [8, 9, 10]


def test_a_rollout_has_the_values_of_the_tables(live_run):
    place, page = RunPlace(lambda name: live_run), Page()
    asked = Arguments({"run": "x", "among": "all", "first": "least robust", "rank": 3})
    found = place.requests["rollout"](page, asked)
    index = int(rank(live_run, live_run.config.metric, among="all").order[2])
    gap_m = live_run.rollouts["gap_m"][index]
    reading = found["readings"][0]
    assert (reading["name"], reading["unit"]) == ("gap", "m")
    np.testing.assert_allclose(reading["values"], gap_m, rtol=1e-3)
    contact = found["contact"]
    missed = np.flatnonzero(~live_run.rollouts["detected"][index][:contact])
    assert set(found["misses"]) <= set(missed.tolist())
    assert page.scene.shown[1] == found["step"]
    assert len(found["charts"]) == 3
    for chart in found["charts"]:
        assert 0 < chart["left"] < chart["right"] <= 1


@pytest.mark.parametrize("page", [*DOCUMENTS, *DRAWN])
def test_pages_say_something_and_nothing_in_them_acts(loaded_run, page):
    place = RunPlace(lambda name: loaded_run)
    found = ask(place, "page", run="x", page=page)["html"]
    assert len(found) > 200
    assert "onclick" not in found


def test_a_point_that_is_clicked_is_the_rollout_that_it_stands_for(loaded_run):
    place = RunPlace(lambda name: loaded_run)
    found = ask(place, "pick", run="x", target="point", number=11)
    rows = ask(place, "ranking", run="x", among=found["among"], first=found["first"],
        start=found["rank"] - 1, count=1)["rows"]  # fmt: skip
    assert rows[0]["index"] == 11
    assert ask(place, "pick", run="x", target="point", number=10**6) is None


def test_runs_stand_beside_each_other(loaded_run):
    place = RunPlace(lambda name: loaded_run)
    assert loaded_run.name in ask(place, "compare", runs=["a", "b"])
    with pytest.raises(InputError, match="at most 6"):
        ask(place, "compare", runs=["a"] * 7)


def test_a_summary_of_a_run_without_an_estimate_says_so(live_run):
    bare = replace(live_run, result=replace(live_run.result, estimate=None))
    found = ask(RunPlace(lambda name: bare), "open", run="x")
    assert found["summary"]["sampling"] == "no estimate"
    assert found["summary"]["probability"] is None


def test_budgets_beside_the_runs_are_judged_again_when_they_change(place, kept):
    root = place._hub.recordings.root
    path = root / "case.budget.toml"
    assert ask(place, "budgets") == []
    one = hazard(runs=(kept[0].name,), extra="uncertainty = 'sampling'")
    write_budget(path, one, hazard(name="other"), accepted=1e-9)
    (row,) = ask(place, "budgets")
    assert (row["name"], row["mark"]) == ("case", "no")
    assert row["verdict"].startswith("not met")
    assert "Which factor decides" in row["page"]
    write_budget(path, hazard(name="other"), accepted=1.0)
    assert ask(place, "budgets")[0]["mark"] == "yes"
    path.write_text("[")
    (row,) = ask(place, "budgets")
    assert row["mark"] == "open"
    assert "not valid TOML" in row["verdict"]
    path.unlink()
    assert ask(place, "budgets") == []
