"""The form for a new run in Chromium: what is wrong at its field, a run that is started, reload."""

import re

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import WAIT_MS
from tests.browser.driving import fits, on_the_page
from tests.panel.conftest import wait_until

TINY = "stages=1&rollouts=20&final_rollouts=20&max_rollouts=60&measured_memory=false&plan=false"


def opened(page, panel, begin=""):
    page.goto(f"{panel.pages}/#/new?{begin}")
    page.get_by_role("button", name="Run", exact=True).wait_for()
    expect(page.get_by_label("Differences")).to_be_visible()


def field(page, name):
    return page.get_by_label(name, exact=True)


def says(page, key):
    """The sentence below a field about what is wrong with it."""
    return page.locator(f"[id='field-{key}-wrong']")


def test_nonsense_is_answered_at_its_field_and_a_reload_returns_the_form(page, panel, shots):
    opened(page, panel)
    run = page.get_by_role("button", name="Run", exact=True)
    expect(run).to_be_enabled()
    for name, key, typed, words in (
        ("sigma", "sigma", "3,7", "must be a number, at least 0.95 and below 1"),
        ("Seed", "seed", "-1", "must be a whole number, at least 0"),
        ("Rule", "rule", "always[0,99] (gp >= 2)", "did you mean 'gap'?"),
        ("Rollouts at most", "max_rollouts", "12", "must be at least the 1200"),
    ):
        expect(field(page, name)).not_to_have_attribute("aria-invalid", "true")
        before = field(page, name).input_value()
        field(page, name).fill(typed)
        expect(says(page, key)).to_contain_text(words)
        expect(field(page, name)).to_have_value(typed)
        expect(field(page, name)).to_have_attribute("aria-invalid", "true")
        expect(field(page, name)).to_have_attribute("aria-describedby", re.compile(f"{key}-wrong"))
        expect(run).to_be_disabled()
        assert on_the_page(page, run)
        field(page, name).fill(before)
        expect(says(page, key)).to_be_hidden()
    page.get_by_text("Advanced").click()
    field(page, "Final rollouts").fill("1e9")
    expect(says(page, "final_rollouts")).to_contain_text("must be at most")
    expect(page.locator("[id='field-final_rollouts-note']")).to_contain_text("GB of memory")
    expect(page.locator(".act")).to_contain_text("To fix: Final rollouts")
    expect(page.locator(".told h2").first).to_have_text("Final rollouts")
    page.screenshot(path=shots / "new-run-wrong.png")
    field(page, "Final rollouts").fill("1e6")
    expect(page.locator(".act")).to_contain_text("To mind: Final rollouts")
    page.get_by_role("button", name="was 100", exact=True).click()
    field(page, "Initial gap [m]").fill("12.5")
    field(page, "Precision").fill("10%")
    field(page, "Error model").select_option("rrc")
    expect(page.get_by_label("Differences")).to_contain_text("Precision")
    expect(page).to_have_url(re.compile("initial_gap_m=12.5"))
    expect(page).to_have_url(re.compile("precision=10%25"))
    page.reload()
    expect(field(page, "Initial gap [m]")).to_have_value("12.5")
    expect(field(page, "Precision")).to_have_value("10%")
    expect(field(page, "Error model")).to_have_value("rrc")
    expect(page.locator(".told code")).to_have_text(
        "pemviz record --pem rrc --precision 0.1 --scenario.initial-gap-m 12.5"
    )
    page.get_by_role("link", name="Runs", exact=True).click()
    page.get_by_role("link", name="New run", exact=True).click()
    expect(field(page, "Precision")).to_have_value("10%")
    page.get_by_role("button", name="Back to paper").click()
    expect(field(page, "Precision")).to_have_value("0.2")
    expect(page).to_have_url(re.compile(r"#/new\?advanced=1$"))
    assert fits(page)


def test_a_run_is_started_seen_stopped_and_run_again_with_changes(page, panel, shots):
    opened(page, panel, TINY)
    panel.gate.shut()
    page.get_by_role("button", name="Run", exact=True).click()
    expect(page.get_by_role("button", name="Stop").first).to_be_visible()
    page.wait_for_url("**/#/run/**")
    name = panel.controller.state.run.name
    assert name in page.url
    page.get_by_role("link", name="New run", exact=True).click()
    expect(page.get_by_role("button", name="Run", exact=True)).to_be_disabled()
    expect(page.get_by_text("one at a time")).to_be_visible()
    page.locator(".act").get_by_role("button", name="Stop").click()
    panel.gate.open()
    expect(page.get_by_role("button", name="Run", exact=True)).to_be_enabled()
    page.goto(f"{panel.pages}/#/run/{name}")
    page.get_by_role("link", name="Run again with changes").click()
    expect(field(page, "Rollouts at most")).to_have_value("60")
    expect(page.get_by_text(f"As {name}")).to_be_visible()
    field(page, "Seed").fill("4")
    expect(page.get_by_label("Differences")).to_contain_text("Seed")
    page.screenshot(path=shots / "new-run-again.png")


@pytest.mark.slow
def test_what_has_other_signals_runs_from_the_form(page, panel):
    opened(page, panel)
    field(page, "Scenario").select_option("merge")
    expect(field(page, "Rule")).to_have_value(re.compile("no-collision = "))
    page.get_by_text("Advanced").click()
    for name, value in (("Stages", "1"), ("Rollouts", "4"), ("Final rollouts", "4")):
        field(page, name).fill(value)
    field(page, "Rollouts at most").fill("12")
    expect(page.get_by_text("The same on the command line")).to_be_visible()
    page.get_by_role("button", name="Run", exact=True).click()
    page.wait_for_url("**/#/run/**")
    state = wait_until(panel.controller, timeout_s=600.0)
    assert state.error is None
    expect(page.get_by_label("Answer")).to_be_visible(timeout=WAIT_MS)


def test_the_form_is_usable_at_all_sizes(page, panel, shots):
    for width, height in ((390, 800), (1000, 700), (1920, 1080)):
        page.set_viewport_size({"width": width, "height": height})
        opened(page, panel, "sigma=0&advanced=1")
        assert fits(page), width
        assert on_the_page(page, page.get_by_role("button", name="Run", exact=True))
        page.screenshot(path=shots / f"new-run-{width}.png")
