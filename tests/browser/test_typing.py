"""What is typed into the panel's fields is checked while it is typed."""

import pytest

from tests.browser.driving import beside, choose, enter, run, tab, until, warned

pytest.importorskip("viser")


def test_a_bad_formula_is_told_where_it_is_typed_and_is_not_run(open_page, shots, panel):
    page = open_page()
    boxes = page.locator("textarea:not([aria-hidden])")
    box, rules = boxes.first, boxes.last
    box.fill("always[0,99] (gap >= ")
    warned(page).first.wait_for()
    first = warned(page).first.inner_text()
    box.fill("always[0,99] (distance >= 2.0)")
    warned(page).get_by_text("distance").wait_for()
    assert warned(page).first.inner_text() != first
    button = page.get_by_role("button", name="Run", exact=True)
    assert button.is_disabled()
    page.screenshot(path=shots / "bad-formula.png")
    box.fill("always[0,99] (gap >= 1.0)")
    page.get_by_text("The specification is understood.").wait_for()
    beside(page, "Target").fill("-1")
    warned(page).get_by_text("target = '-1': must be above 0").wait_for()
    assert button.is_disabled()
    beside(page, "Target").fill("1e-9")
    beside(page, "Fail above").fill("1e-30")
    page.get_by_text("Fail above 1.0 × 10⁻³⁰:").wait_for()
    choose(page, "Method", "naive")
    rules.fill("near = always[0,99] (gap >= 2.0)\nfar")
    warned(page).get_by_text("rule = 'far': must be NAME=FORMULA").wait_for()
    assert button.is_disabled()
    assert box.is_disabled()
    rules.fill("near = always[0,99] (gap >= 2.0)\nfar = always[0,99] (distance >= 1)")
    warned(page).get_by_text("rule far: ").wait_for()
    rules.fill("near = always[0,99] (gap >= 2.0)\nfar = always[0,99] (gap >= 4.0)")
    page.get_by_text("The rules are understood.").wait_for()
    page.screenshot(path=shots / "rules.png")
    page.get_by_text("Tracker and position errors").click()
    choose(page, "Tracker", "M/N")
    enter(page, "Hits M", 4)
    warned(page).get_by_text("4 hits of 3 outcomes: must be no more").wait_for()
    enter(page, "Hits M", 1)
    choose(page, "Position errors", "a file")
    warned(page).get_by_text("no model of position errors ''").wait_for()
    choose(page, "Position errors", "pointpillars")
    page.get_by_text("by a tracker (1/3,coast=0.5), below 10 m, measured with errors").wait_for()
    page.screenshot(path=shots / "perception.png")
    run(page)
    until(page, lambda: panel.controller.state.finished_runs > 0)
    shown = panel.controller.state.run
    assert shown.config.target == 1e-9
    assert shown.config.scenario.tracker == "1/3,coast=0.5"
    assert shown.config.position_errors == "pointpillars"
    page.locator("table[aria-label='Each rule by itself'] td", has_text="far").wait_for()
    tab(page, "Trajectories")
    choose(page, "Rule", "near")
    page.get_by_text("in rule near", exact=False).first.wait_for()
    page.screenshot(path=shots / "ranking-of-a-rule.png")
