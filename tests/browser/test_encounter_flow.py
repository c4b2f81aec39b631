"""A logical scenario in the panel, in a real browser."""

import re

import pytest

from tests.browser.driving import (
    choose,
    expect_done,
    rests,
    run,
    selected,
    small,
    tab,
    until,
)

pytest.importorskip("viser")


def test_a_logical_scenario_runs_through_a_reload_and_its_rollouts_play(open_page, shots, panel):
    page = open_page()
    choose(page, "Preset", "cut-in")
    choose(page, "Method", "mixture")
    small(page)
    panel.gate.shut()
    run(page)
    page.get_by_text(re.compile(r"Stage \d+ of 3")).wait_for()
    page.reload()
    page.get_by_text(re.compile(r"Stage \d+ of 3")).wait_for()
    panel.gate.open()
    expect_done(page)
    page.get_by_text(panel.controller.state.run.name).first.wait_for()
    page.get_by_role("cell", name="avoidable-cut-in", exact=True).first.wait_for()
    tab(page, "Trajectories")
    choose(page, "Among", "all rollouts")
    page.locator("tr[data-rank='2']").click()
    until(page, lambda: selected(page) == 2)
    page.locator("svg text", has_text="car that cuts in").first.wait_for()
    cursor, canvas = page.locator("g[data-cursor]"), page.locator("canvas").first
    page.get_by_role("button", name="Restart", exact=True).click()
    until(page, lambda: int(cursor.get_attribute("data-cursor")) > 3)
    page.get_by_role("button", name="Pause", exact=True).click()
    until(page, lambda: rests(page, cursor))
    behind = canvas.screenshot()
    assert len(behind) > 20_000  # drawn, not blank
    choose(page, "View", "from above")
    until(page, lambda: canvas.screenshot() != behind)
    page.screenshot(path=shots / "family-from-above.png")
    choose(page, "Rule", "no-collision")
    page.get_by_text("in rule no-collision").wait_for()
    until(page, lambda: selected(page) == 1)
    assert panel.controller.state.error is None
