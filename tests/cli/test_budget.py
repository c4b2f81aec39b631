"""``pemviz budget``: exit codes, one JSON object, what to do next, and damaged budgets."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from scipy import stats

from pemviz.cli.main import main
from tests.budgets import ENCOUNTERS, HARM, STATED, WEIGHED, hazard, make_run, write_budget

KNOWN = 'median = 0.05\nlow = 0.05\nhigh = 0.05\nsource = "by definition"'
CURVE = 'intercept = -5.0\nslope = 0.1\nsource = "made up"'
FIVE = 'median = 5.0\nlow = 5.0\nhigh = 5.0\nsource = "s"'


@pytest.fixture
def budget(tmp_path):
    return tmp_path / "budget.toml"


def test_exit_codes_say_whether_it_is_met(budget, capsys):
    write_budget(budget, hazard(), accepted=1e-5)
    assert main(["budget", str(budget)]) == 0
    told = capsys.readouterr().out
    assert "met: harm at most" in told
    assert "may still grow" in told
    write_budget(budget, hazard(), accepted=1e-8)
    assert main(["budget", str(budget)]) == 1
    told = capsys.readouterr().out
    assert "not met: harm at most" in told
    assert "knowing more does not close that" in told


def test_json_is_one_object_with_every_factor_and_its_interval(budget, capsys):
    write_budget(budget, hazard(), hazard(name="other"), accepted=1e-5)
    assert main(["budget", str(budget), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    one = found["hazards"][0]
    assert found["outcome"] == "met"
    assert one["encounters_per_hour"]["value"] == 12.0
    assert one["encounters_per_hour"]["high"] == pytest.approx(stats.chi2.ppf(0.975, 482) / 40)
    assert found["harm_per_hour"]["value"] == pytest.approx(2 * 12.0 * 1e-6 * 0.05)
    assert {one["factor"] for one in found["decided_by"]} == {"encounters", "violation", "harm"}


def test_a_run_of_which_nobody_knows_how_open_it_is_ends_with_4(budget, tmp_path, capsys):
    make_run(tmp_path / "run", WEIGHED)
    write_budget(budget, hazard(runs=("run",)), accepted=1.0)
    assert main(["budget", str(budget), "--json"]) == 4
    found = json.loads(capsys.readouterr().out)
    assert found["harm_per_hour"] is None
    assert "not looked at" in found["next"][0]


def test_driving_as_long_as_is_said_meets_the_budget(budget, capsys):
    """3 events in 20 h leave too much open; after the hours that are said they do not."""
    alone = hazard(encounters='events = 3\nhours = 20.0\nsource = "driven"', harm=KNOWN)
    accepted = 0.15 * 1e-6 * 0.05 * 2.5
    write_budget(budget, alone, accepted=accepted)
    assert main(["budget", str(budget)]) == 1
    told = capsys.readouterr().out
    all_hours = int(
        re.search(r"drive [\d,]+ hours more \(([\d,]+) in all\)", told)[1].replace(",", "")
    )
    assert all_hours > 20
    events = round(3 * all_hours / 20)
    longer = hazard(
        encounters=f'events = {events}\nhours = {all_hours}.0\nsource = "driven"', harm=KNOWN
    )
    write_budget(budget, longer, accepted=accepted)
    assert main(["budget", str(budget)]) == 0


def test_more_rollouts_are_said_where_the_sampling_decides(budget, tmp_path, capsys):
    run = make_run(tmp_path / "run", WEIGHED)
    one = hazard(runs=(run.name,), extra="uncertainty = 'sampling'", encounters=FIVE, harm=KNOWN)
    write_budget(budget, one, accepted=1e9)
    main(["budget", str(budget), "--json"])
    found = json.loads(capsys.readouterr().out)["harm_per_hour"]
    write_budget(budget, one, accepted=0.3 * found["value"] + 0.7 * found["high"])
    assert main(["budget", str(budget)]) == 1
    told = capsys.readouterr().out
    assert "rollouts in place of" in told
    assert "--precision" in told


def test_the_chart_is_a_picture_with_every_hazard(budget, tmp_path):
    write_budget(budget, hazard(), hazard(name="other"))
    out = tmp_path / "budget.svg"
    assert main(["budget", str(budget), "--chart", str(out)]) == 0
    words = "".join(ET.parse(out).getroot().itertext())  # noqa: S314  our own
    assert all(name in words for name in ("braking", "other", "all hazards"))


def test_verbose_names_sources(budget, capsys):
    write_budget(budget, hazard())
    main(["budget", str(budget), "--verbose"])
    told = " ".join(capsys.readouterr().out.split())
    assert "the safety board" in told
    assert "accidents" in told
    assert "Garwood" in told


def test_the_example_says_what_its_page_says(capsys):
    root = Path(__file__).resolve().parents[2]
    assert main(["budget", str(root / "examples" / "risk_budget.toml")]) == 0
    verdict = capsys.readouterr().out.splitlines()[1]
    page = root / "docs" / "how-to" / "risk-budget.md"
    assert verdict in page.read_text(encoding="utf-8")


def with_(change, old, **named):
    """A budget of one hazard in which something stands in place of something else."""
    text = hazard(**named)
    assert old in text
    return text.replace(old, change, 1)


HEAD = 'accepted_harm_per_hour = 1e-5\nsource = "board"\n'
DAMAGED = {
    "no TOML": ("hazards = [", "not valid TOML"),
    "empty": ("", "accepted_harm_per_hour: is missing"),
    "unknown field": (HEAD + "speed = 3\n" + hazard(), "speed: no such field"),
    "nothing accepted": (HEAD.replace("1e-5", "0.0") + hazard(), "must be a number, at least"),
    "no number": (HEAD.replace("1e-5", "nan") + hazard(), "accepted_harm_per_hour = nan"),
    "a text": (HEAD.replace("1e-5", "'few'") + hazard(), "accepted_harm_per_hour = 'few'"),
    "no hazard": (HEAD + "hazards = []", "hazards: must be 1 to 100, are 0"),
    "no source": (HEAD + with_("", '\nsource = "driven"'), "encounters.source: is missing"),
    "empty source": (HEAD + with_('" "', '"driven"'), "must say something"),
    "two of a name": (HEAD + hazard() + "\n" + hazard(), "is the name of another hazard"),
    "neither run nor violation": (HEAD + hazard().replace(STATED, ""), "has neither"),
    "run and violation": (HEAD + hazard(extra="runs = ['a']"), "has both"),
    "a rule without a run": (HEAD + hazard(extra="rule = 'r'"), "only of runs"),
    "events without hours": (HEAD + with_("", "hours = 20.0\n"), "must have events, hours or"),
    "both ways": (HEAD + with_(ENCOUNTERS + "\nmedian = 3.0", ENCOUNTERS), "has events, hours, m"),
    "negative events": (HEAD + with_("events = -1", "events = 240"), "events = -1"),
    "half an event": (HEAD + with_("events = 0.5", "events = 240"), "must be a whole number"),
    "no hours": (HEAD + with_("hours = 0.0", "hours = 20.0"), "hours = 0.0"),
    "ends in disorder": (HEAD + with_("low = 0.2", "low = 0.02"), "low <= median <= high"),
    "above 1": (HEAD + with_("high = 1.5", "high = 0.1"), "high = 1.5"),
    "more events than trials": (
        HEAD + hazard(harm='events = 3\ntrials = 2\nsource = "s"'), "must be at most trials",
    ),
    "a curve without speeds": (HEAD + hazard(harm=CURVE), "impact_speed: is missing"),
    "half a curve": (HEAD + hazard(harm='slope = 0.1\nsource = "s"'), "intercept, slope"),
    "a unit of its own": (
        HEAD + hazard(harm=f'{CURVE}\nspeed_unit = "kn"'), "must be one of m/s, km/h, mph",
    ),
    "a correlation above 1": (HEAD + hazard(harm=f"{CURVE}\ncorrelation = 1.1"), "at most 1"),
    "stray of a curve": (HEAD + hazard(harm=f"{HARM}\nimpact_speed = 9.0"), "only of a curve"),
    "a run twice": (HEAD + hazard(runs=("a", "a")), "names a run twice"),
    "no such run": (HEAD + hazard(runs=("nowhere",)), "there is no such folder"),
    "uncertainty": (HEAD + hazard(extra="uncertainty = 'none'"), "must be one of all, sampling"),
    "too large": ("# " + "x" * 1_000_001, "must be a risk budget of at most"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_budget_is_one_line_and_nothing_is_written(kind, budget, tmp_path, capsys):
    text, words = DAMAGED[kind]
    budget.write_text(text, encoding="utf-8")
    out = tmp_path / "page.html"
    for command in (
        ["budget", str(budget), "--chart", str(tmp_path / "c.svg")],
        ["report", "--budget", str(budget), "--out", str(out), "--gsn", str(tmp_path / "g.yaml")],
    ):
        assert main(command) == 2
        told = capsys.readouterr()
        assert told.err.count("\n") == 1
        assert words in told.err
        assert told.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["budget.toml"]


@pytest.mark.parametrize("path", ["nowhere.toml", ".", "x" * 300])
def test_a_budget_that_is_not_there_is_one_line(path, capsys):
    assert main(["budget", path]) == 2
    assert capsys.readouterr().err.count("\n") == 1
