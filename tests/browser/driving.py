"""What a person does with the panel's page, and what can be read off it."""

import pytest

from tests.browser.conftest import WAIT_MS

# viser's page sends one change in 50 ms and forgets all but the last: no person is so quick
THROTTLE_MS = 200
THINKING_MS = 2000
"""Between what a person chooses and what they then write."""


def tab(page, name):
    page.get_by_text(name, exact=True).first.click()


def choose(page, label, option):
    page.get_by_role("combobox", name=label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def enter(page, label, value):
    box = page.get_by_role("textbox", name=label, exact=True)
    box.fill(str(value))
    box.press("Enter")
    page.wait_for_timeout(THROTTLE_MS)


def beside(page, label):
    """The box beside a text: sliders and texts have no label of their own."""
    row = page.locator("div.mantine-Flex-root", has=page.get_by_text(label, exact=True)).last
    return row.get_by_role("textbox")


def slide(page, label, value):
    beside(page, label).fill(str(value))
    beside(page, label).press("Enter")
    page.wait_for_timeout(THROTTLE_MS)


def small(page, *, stages=2):
    enter(page, "Stages", stages)
    enter(page, "Rollouts", 40)
    enter(page, "Final rollouts", 40)


def is_enabled(page, label):
    """Whether a number's box takes input; a slider that is not used is not there."""
    if label in ("alpha", "sigma"):
        return page.get_by_text(label, exact=True).count() == 1
    return page.get_by_role("textbox", name=label, exact=True).is_enabled()


def run(page):
    page.get_by_role("button", name="Run", exact=True).click()


def expect_done(page):
    page.get_by_text("Ready.").wait_for(timeout=4 * WAIT_MS)


def warned(page):
    """What the panel warns of; viser's own notifications are alerts too."""
    return page.locator("div[role=alert]", has_text="\N{WARNING SIGN}")


def selected(page):
    row = page.locator("table[aria-label=Ranking] tr[aria-selected=true]")
    return int(row.get_attribute("data-rank"))


def rests(page, cursor):
    """Whether the cursor stands still for a second, before the end of the rollout."""
    step = int(cursor.get_attribute("data-cursor"))
    page.wait_for_timeout(1000)
    return int(cursor.get_attribute("data-cursor")) == step < 99


def is_still(page):
    """Whether the page looks the same for three seconds."""
    before = page.screenshot()
    page.wait_for_timeout(3000)
    return page.screenshot() == before


def until(page, condition, *, timeout_ms=WAIT_MS):
    for _ in range(timeout_ms // 50):
        if condition():
            return
        page.wait_for_timeout(50)
    pytest.fail("the page did not get there")


def charted(page, words):
    """A line's name beside a chart."""
    return page.locator(".uplot .u-label", has_text=words).first


def newest_curve(page):
    """What the chart of the tab Learning draws of the newest proposal."""
    tab(page, "Learning")
    page.locator(".uplot canvas").first.wait_for()
    charts = "Object.values(window.__viserTestpoints.uplots)"
    return str(page.evaluate(f"{charts}.map(shown => Array.from(shown.chart.data[1]))"))


def on_the_page(page, locator):
    """Whether all of an element is within what the browser shows."""
    box, size = locator.bounding_box(), page.viewport_size
    return (
        box is not None and box["x"] >= 0 and box["x"] + box["width"] <= size["width"]
        and box["y"] >= 0 and box["y"] + box["height"] <= size["height"]
    )  # fmt: skip


def fits(page):
    """Whether nothing of the page lies beside the window."""
    return page.evaluate("document.documentElement.scrollWidth <= innerWidth")
