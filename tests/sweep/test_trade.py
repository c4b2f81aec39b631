from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig
from pemviz.recording import paths
from pemviz.reports.document import Caution
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.plan import RULE, PlannedRun, make_plan, parse_variation
from pemviz.sweep.trade import ON_FRONT, trade_of, trade_section
from pemviz.sweep.trade_picture import trade_png
from tests.recording.read_back import texts
from tests.reports.runs import estimate, warned

RULES = ("contact", "gap")
TWO_RULES = ExperimentConfig(method="naive").with_rules(
    {"contact": "always[0,99] (gap >= 0.0)", "gap": "always[0,99] (gap >= 2.0)"}
)


def states_of(intervals):
    """Runs of settings with these intervals: of both rules, by alpha."""
    return [
        RunState(
            PlannedRun("run", TWO_RULES, (("alpha", (1 + place) / 100), (RULE, rule)), "digest"),
            "done",
            one_estimate(*interval),
        )
        for place, pair in enumerate(intervals)
        for rule, interval in zip(RULES, pair, strict=True)
    ]


def one_estimate(low, high):
    return estimate(
        method="mixture", probability=(low * high) ** 0.5, ci_low=low, ci_high=high, diagnostics=()
    )


def test_a_run_is_of_one_rule_alone():
    plan = make_plan(TWO_RULES, [parse_variation("rule=gap")])
    (run,) = plan.runs
    assert [rule.name for rule in run.config.rules] == ["gap"]
    assert run.config.spec == "(always[0,99] (gap >= 2.0))"
    assert run.setting == ((RULE, "gap"),)


def test_settings_stand_where_estimates_and_intervals_say():
    trade = trade_of(
        states_of(
            [
                ((1e-6, 2e-6), (1e-2, 2e-2)),
                ((4e-6, 8e-6), (1e-3, 2e-3)),
                ((3.9e-6, 7.9e-6), (3e-3, 4e-3)),  # a little less than the second, surely more
                ((4.1e-6, 8.1e-6), (1.5e-2, 3e-2)),
                ((9e-6, 2e-5), (3e-3, 4e-3)),  # the second has fewer of both
            ]
        ),
        RULES,
    )
    assert [(one.name, one.standing, one.by) for one in trade.points] == [
        ("0.01", "front", ""),
        ("0.02", "front", ""),
        ("0.03", "small gain", "0.02"),
        ("0.04", "perhaps dominated", "0.02"),
        ("0.05", "dominated", "0.02"),
    ]
    assert trade_png(trade).startswith(b"\x89PNG")
    first = trade_section(trade).full[0].text
    assert first == "Not dominated: 0.01; 0.03; 0.02."


ENDS = st.tuples(st.integers(1, 12), st.integers(1, 5)).map(lambda two: (two[0], sum(two)))


@given(st.lists(st.tuples(ENDS, ENDS), min_size=1, max_size=8))
def test_the_front_is_that_of_the_estimates_and_dominated_what_intervals_set_apart(intervals):
    scaled = [tuple((1e-3 * low, 1e-3 * high) for low, high in pair) for pair in intervals]
    places = [tuple((low * high) ** 0.5 for low, high in pair) for pair in scaled]
    trade = trade_of(states_of(scaled), RULES)
    for mine, place, point in zip(scaled, places, trade.points, strict=True):
        behind = any(a <= place[0] and b <= place[1] and (a, b) != place for a, b in places)
        beaten = any(all(a[1] < b[0] for a, b in zip(o, mine, strict=True)) for o in scaled)
        assert (point.standing in ON_FRONT) == (not behind)
        assert (point.standing == "dominated") == beaten
    assert any(point.standing in ON_FRONT for point in trade.points)


@pytest.mark.parametrize("fault", ["failed", "no interval", "doubtful"])
def test_what_is_not_known_is_compared_with_nothing(fault):
    best, *others = states_of([((1e-9, 2e-9), (1e-9, 2e-9)), ((1e-3, 2e-3), (1e-3, 2e-3))])
    doubtful = warned("the tail is too heavy", kind="heavy-tail", value=0.9)
    spoilt = {
        "failed": replace(best, status="failed", estimate=None),
        "no interval": replace(
            best, estimate=estimate(method="mixture", probability=0.0, ci_low=None, ci_high=None)
        ),
        "doubtful": replace(best, estimate=replace(best.estimate, diagnostics=(doubtful,))),
    }[fault]
    trade = trade_of([spoilt, *others], RULES)
    assert [point.standing for point in trade.points] == ["not known", "front"]
    cautions = [one.text for one in trade_section(trade).full if isinstance(one, Caution)]
    assert len(cautions) == 1
    assert cautions[0].startswith("1 of 2 settings are not known")


@pytest.mark.usefixtures("in_this_process")
def test_a_sweep_of_trackers_tells_what_is_not_dominated(tmp_path, capsys):
    config = tmp_path / "near.toml"
    config.write_text(
        "method = 'monte-carlo'\nfinal_rollouts = 300\nmeasured_memory = false\nplan = false\n"
        "[scenario]\ninitial_gap_m = 4.0\n"
        "[rules]\ncontact = 'always[0,99] (gap >= 0.0)'\nslow = 'always[0,99] (ego_speed >= 0.5)'\n"
    )
    out = tmp_path / "out"
    words = ["--vary", "tracker=hits=1:2,window=2,coast=0:1", "--vary", "scenario.initial-gap-m=4"]
    words += ["--trade", "contact,slow"]
    assert main(["sweep", str(config), *words, "--out", str(out)]) == 0
    summary = (out / "summary.md").read_text()
    assert "8 runs: 8 done" in summary
    assert "Trade between contact and slow" in summary
    assert all(f"| {name} |" in summary for name in ("1/2,coast=0", "2/2,coast=1"))
    assert (out / "trade.png").read_bytes().startswith(b"\x89PNG")
    words, picture = summary.rsplit("\n![", 1)
    assert picture.endswith("(trade.png)\n")
    assert words in capsys.readouterr().out
    assert texts(out / "sweep.rrd")[paths.SWEEP_SUMMARY] == words  # without a picture to look for


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (["--trade", "contact"], ["trade = 'contact'", "RULE,RULE"]),
        (["--trade", "contact,contact"], ["RULE,RULE"]),
        (["--trade", "contact,moon"], ["rule 'moon'", "it has contact, gap"]),
        (["--trade", "contact,gap", "--seeds", "2"], ["one seed"]),
        (["--trade", "contact,gap", "--vary", "rule=gap"], ["varies rule itself"]),
        (["--vary", "tracker=hits=1:3"], ["window is missing"]),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, words, fragments):
    config = tmp_path / "two.toml"
    rules = "".join(f"{rule.name} = '{rule.formula}'\n" for rule in TWO_RULES.rules)
    config.write_text(f"method = 'naive'\n[rules]\n{rules}")
    assert main(["sweep", str(config), *words, "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in shown.err
