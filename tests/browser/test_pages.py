"""The pages of our own in Chromium: the table of runs, and a run with its scene and timeline."""

import re

from playwright.sync_api import expect

from tests.browser.conftest import WAIT_MS
from tests.browser.driving import fits


def shown_step(page):
    return int(page.locator(".values").get_attribute("data-step"))


def test_runs_are_sorted_filtered_opened_deleted_and_brought_back(page, panel, shots):
    name = next(path.name for path in panel.root.iterdir())
    page.goto(f"{panel.pages}/#/runs")
    rows = page.locator(".runs tbody tr")
    expect(rows).to_have_count(2)  # it and the shipped sample
    page.get_by_role("button", name="rollouts").click()
    expect(page.locator("th[aria-sort=descending]")).to_have_text("rollouts \u25be")
    counts = [
        int(text.replace(",", "")) for text in page.locator("td:nth-child(9)").all_inner_texts()
    ]
    assert counts == sorted(counts, reverse=True)
    page.get_by_label("Search the runs").fill(name)
    expect(rows).to_have_count(1)
    page.reload()
    expect(page.get_by_label("Search the runs")).to_have_value(name)
    page.screenshot(path=shots / "pages-runs.png")
    page.get_by_label(f"Tick {name}").check()
    page.get_by_role("button", name="Delete 1").click()
    expect(rows).to_have_count(0)
    page.get_by_role("button", name="Undo: bring back 1").click()
    expect(rows).to_have_count(1)
    rows.first.click()
    expect(page.get_by_label("Answer")).to_contain_text(name)
    assert f"#/run/{name}" in page.url
    assert fits(page)


def test_a_rollout_is_walked_through_and_a_reload_returns(page, panel, shots):
    page.goto(f"{panel.pages}/#/run/sample")
    values = page.locator(".values")
    values.wait_for()
    page.locator(".ranking tbody tr").nth(2).click()
    expect(page.locator(".ranking tr[aria-selected=true] td").first).to_have_text("3")
    expect(page).to_have_url(re.compile("rank=3"))
    expect(values).to_have_attribute("data-rank", "3")
    page.keyboard.press("m")
    page.keyboard.press("Shift+M")
    page.keyboard.press("c")
    expect(values).to_contain_text("after contact")
    contact = shown_step(page)
    page.keyboard.press("Shift+ArrowLeft")
    expect(values).to_have_attribute("data-step", str(contact - 10))
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    expect(values).to_have_attribute("data-step", str(contact - 8))
    page.get_by_role("button", name="miss", exact=False).first.click()
    expect(values).to_contain_text("MISSED")
    at = shown_step(page)
    expect(page).to_have_url(re.compile(f"step={at}(&|$)"))
    page.get_by_role("link", name="Uncertainty").click()
    expect(page.locator("aside")).to_contain_text("How far the answer is open")
    page.reload()
    expect(page.locator("aside")).to_contain_text("How far the answer is open")
    expect(values).to_have_attribute("data-step", str(at))
    assert "rank=3" in page.url
    page.keyboard.press(" ")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    page.keyboard.press(" ")
    page.frame_locator(".scene").locator("canvas").first.wait_for()
    page.locator(".scene").click()  # which takes the focus
    page.keyboard.press("c")
    expect(values).to_have_attribute("data-step", str(contact))
    page.screenshot(path=shots / "pages-run.png")
    assert fits(page)


def test_a_click_on_a_chain_of_misses_shows_its_likeliest_rollout(page, panel):
    page.goto(f"{panel.pages}/#/run/sample?page=why")
    page.locator("[data-target=chain] tr[data-number='2']").click()
    expect(page.locator(".ranking tr[aria-selected=true]")).to_be_visible()
    expect(page).to_have_url(re.compile("among=all"))


def test_it_is_dark_where_asked_and_readable_on_a_phone(page, panel, shots):
    page.set_viewport_size({"width": 390, "height": 800})
    for place in ("runs", "run/sample", "new"):
        page.goto(f"{panel.pages}/#/{place}")
        page.locator("main").first.wait_for()
        page.wait_for_timeout(500)
        assert fits(page), place
    page.goto(f"{panel.pages}/#/run/sample")
    page.locator(".values").wait_for()
    page.keyboard.press("d")
    expect(page.locator("html")).to_have_attribute("data-theme", "dark")
    page.screenshot(path=shots / "pages-phone-dark.png")


def test_a_run_that_was_started_is_told_of_and_shown(page, panel):
    page.goto(f"{panel.pages}/#/runs")
    page.locator(".runs").wait_for()
    panel.gate.shut()
    assert panel.controller.start(panel.controller.state.run.config)
    stop = page.get_by_role("button", name="Stop")
    expect(page.locator(".runs")).to_contain_text("running")
    for width in (1280, 390):  # on a phone what is told has a line of its own
        page.set_viewport_size({"width": width, "height": 800})
        expect(stop).to_be_in_viewport(ratio=1.0)
        told = page.get_by_role("status")
        assert told.evaluate("at => at.scrollWidth <= at.clientWidth")
    panel.gate.open()
    expect(page.get_by_role("button", name="Stop")).to_be_hidden(timeout=WAIT_MS)
