"""What a person does with the panel over a session, in a real browser; assertions read the page."""

import re
import shutil
import socket
from dataclasses import replace
from urllib.parse import urlsplit

import PIL.Image
import pytest
from playwright.sync_api import expect

from pemviz.cli.serve import recorders, viewer
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset
from pemviz.panel.controller import Controller
from pemviz.panel.recordings_folder import Viewers
from tests.browser.conftest import WAIT_MS, Panel
from tests.browser.driving import fits, is_drawn, is_still, on_the_page, until
from tests.panel.conftest import SMALL, wait_until

pytest.importorskip("viser")

SIZES = ((1000, 700), (1280, 720), (1440, 900), (1920, 1080))
PAGES = {
    "Uncertainty": "How far the answer is open",
    "Learning": "Rollouts that violate",
    "Weights": "How near the cars come",
    "Why": "Misses that cause violations",
    "Metrics": "Overlap of the elites",
    "Measure next": "Extrapolated",
    "Record": "result.json",
    "Rollouts": "what carries the answer",
}


def all_shown(page):
    """Whether the answer, the scene and its controls are on the page."""
    play = page.get_by_role("button", name="Play")
    parts = (page.locator(".answer"), page.locator(".scene"), play)
    return fits(page) and all(on_the_page(page, part) for part in parts)


def test_every_page_of_a_run_has_content_at_every_size(open_page, shots, first_run):
    page = open_page(f"run/{first_run.name}")
    for name, words in PAGES.items():
        page.get_by_role("link", name=name, exact=True).click()
        expect(page.locator("aside")).to_contain_text(words)
        page.screenshot(path=shots / f"page-{name.lower()}.png")
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        until(page, lambda: all_shown(page))
        page.screenshot(path=shots / f"run-{width}.png")
    canvas = page.frame_locator(".scene").locator("canvas").first
    until(page, lambda: is_drawn(canvas))


def test_points_of_the_weights_show_their_rollouts(open_page, panel, first_run):
    page = open_page(f"run/{first_run.name}?page=weights")
    point = page.locator("[data-target=point] g[data-number]").last  # over all others
    index = int(point.get_attribute("data-number"))
    point.locator("circle").last.click()
    expect(page.locator(".ranking tr[aria-selected=true]")).to_be_visible()
    page.get_by_role("link", name="Weights", exact=True).click()
    expect(page.locator("g.shown")).to_have_attribute("data-number", str(index))


def test_a_metric_ranks_anew(open_page, first_run):
    page = open_page(f"run/{first_run.name}")
    page.get_by_label("among", exact=True).select_option("all")
    page.get_by_label("first", exact=True).select_option("least robust")
    expect(page.locator("aside")).to_contain_text("of 200")
    page.locator(".ranking tbody tr").nth(3).click()
    page.keyboard.press("ArrowDown")
    expect(page.locator(".values")).to_have_attribute("data-rank", "5")
    page.get_by_label("metric", exact=True).select_option("smooth-cumulative")
    expect(page.locator(".values")).to_have_attribute("data-rank", "1")


def test_a_logical_scenario_is_watched_and_its_rules_are_told_apart(open_page, shots, panel):
    preset = load_preset("cut-in")
    small = replace(preset, method="mixture", stages=2, rollouts=60, final_rollouts=60, plan=False)
    assert panel.controller.start(small)
    name = wait_until(panel.controller).run.name
    page = open_page(f"run/{name}")
    page.get_by_label("rule", exact=True).select_option("no-collision")
    page.get_by_label("among", exact=True).select_option("all")
    page.locator(".ranking tbody tr").nth(1).click()
    expect(page.locator(".values")).to_have_attribute("data-rank", "2")
    expect(page.locator(".charts")).to_contain_text("car that cuts in")
    canvas = page.frame_locator(".scene").locator("canvas").first
    until(page, lambda: is_drawn(canvas))
    behind = canvas.screenshot()
    page.keyboard.press("v")
    until(page, lambda: canvas.screenshot() != behind)
    page.screenshot(path=shots / "cut-in-from-above.png")
    page.get_by_role("button", name="Play").click()
    until(page, lambda: int(page.locator(".values").get_attribute("data-step")) > 3)
    assert panel.controller.state.error is None


def test_two_windows_and_a_reload_in_mid_run(open_page, shots, panel, first_run):
    first, second = open_page(f"run/{first_run.name}"), open_page(f"run/{first_run.name}?among=all")
    second.locator(".ranking tbody tr").nth(2).click()
    expect(second.locator(".values")).to_have_attribute("data-rank", "3")
    expect(first.locator(".values")).to_have_attribute("data-rank", "1")
    panel.gate.shut()
    assert panel.controller.start(replace(SMALL, method="mixture", stages=2))
    expect(second.get_by_role("status")).to_contain_text("of 3")
    first.context.close()
    second.reload()
    expect(second.get_by_role("status")).to_contain_text("of 3")
    expect(second.locator(".values")).to_have_attribute("data-rank", "3")
    second.screenshot(path=shots / "reloaded-in-mid-run.png")
    panel.gate.open()
    expect(second.get_by_role("button", name="Stop")).to_be_hidden(timeout=WAIT_MS)
    assert panel.controller.state.run.result.status == "done"
    assert panel.controller.state.error is None


def test_stop_keeps_what_was_finished(open_page, panel):
    page = open_page("runs")
    assert panel.controller.start(replace(SMALL, method="mixture", stages=500))
    expect(page.get_by_role("status")).to_contain_text(re.compile(r"Stage [2-9]\d* of 501"))
    page.get_by_role("button", name="Stop").click()
    state = wait_until(panel.controller)
    assert state.run.result.status == "stopped"
    expect(page.locator(".runs tbody tr", has_text=state.run.name)).to_contain_text("stopped")
    page.goto(f"{panel.pages}/#/run/{state.run.name}")
    expect(page.locator("main")).to_contain_text(state.run.name)
    assert (state.run.folder / "rollouts.npz").exists()


def test_runs_are_compared_noted_and_downloaded(open_page, shots, panel, first_run, tmp_path):
    for number in (1, 2):  # by another program, while the panel runs
        shutil.copytree(first_run, panel.root / f"2020010{number}-000000-another")
    page = open_page("runs")
    for number in (1, 2):
        page.get_by_label(f"Tick 2020010{number}-000000-another").check()
    page.get_by_label(f"Tick {first_run.name}").check()
    page.get_by_role("button", name="Compare").click()
    compared = page.get_by_label("Compared runs")
    expect(compared).to_contain_text("Settings that differ: none")
    expect(compared.locator("table[aria-label='Estimates of the runs'] tr")).to_have_count(4)
    page.screenshot(path=shots / "compared.png")
    page.once("dialog", lambda dialog: dialog.accept("older drawing <b>"))
    row = page.locator(".runs tbody tr", has_text="20200101-000000-another")
    row.get_by_role("button", name="note").click()
    expect(row).to_contain_text("older drawing <b>")
    note = panel.root / "20200101-000000-another" / "notes.txt"
    assert note.read_text() == "older drawing <b>"
    page.goto(f"{panel.pages}/#/run/{first_run.name}?page=record")
    for click, name, begins in (
        (page.locator("aside").get_by_role("link", name="result.json"), "a.json", "{"),
        (page.locator("aside").get_by_role("link", name="ranking.csv"), "a.csv", "rank,repetition"),
        (page.locator(".charts").get_by_role("button", name="CSV").first, "b.csv", "series,time"),
        (page.get_by_role("button", name="3D page"), "b.html", ""),
    ):
        with page.expect_download() as download:
            click.click()
        path = tmp_path / name
        download.value.save_as(path)
        assert path.read_text().startswith(begins)
    assert (tmp_path / "a.json").read_bytes() == (first_run / "result.json").read_bytes()
    assert "__VISER_EMBED_DATA__" in (tmp_path / "b.html").read_text()
    with page.expect_download() as picture:
        page.locator(".charts").get_by_role("button", name="PNG").first.click()
    assert picture.value.suggested_filename.startswith(f"{first_run.name}-rank1-Gap")
    picture.value.save_as(tmp_path / "b.png")
    with PIL.Image.open(tmp_path / "b.png") as drawn:
        assert drawn.width > 800
        assert len(drawn.getcolors(drawn.width * drawn.height)) > 20


@pytest.mark.parametrize("name", ["Learning", "Weights", "Why", "Uncertainty", "Metrics"])
def test_each_chart_beside_the_scene_is_saved_as_it_is_drawn(open_page, first_run, tmp_path, name):
    page = open_page(f"run/{first_run.name}?page={name.lower()}")
    figures = page.locator("aside figure")
    expect(figures.first).to_be_visible()
    assert figures.count() == page.locator("aside svg").count()
    for place in range(figures.count()):
        figure = figures.nth(place)
        for kind in ("CSV", "PNG"):
            with page.expect_download() as download:
                figure.get_by_role("button", name=kind).click()
            path = tmp_path / download.value.suggested_filename
            assert path.name.startswith(f"{first_run.name}-")
            download.value.save_as(path)
            if kind == "CSV":
                assert (
                    path.read_text().splitlines() == figure.get_attribute("data-csv").splitlines()
                )
            else:
                assert path.read_bytes()[:4] == b"\x89PNG"


def test_the_recording_opens_in_rerun_in_a_new_tab(chromium, tmp_path, shots):
    root = tmp_path / "recordings"
    recording = Controller(root, observers=recorders)
    recording.start(ExperimentConfig(method="naive", final_rollouts=20))
    wait_until(recording)
    recording.close()
    viewers = Viewers(viewer)
    made = Panel(root, open_recording=viewers.open)
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(WAIT_MS)
    fetched = []
    context.on("requestfinished", lambda request: fetched.append(urlsplit(request.url)))
    try:
        page = context.new_page()
        page.goto(f"{made.pages}/#/runs")
        with context.expect_page() as opening:
            page.get_by_role("button", name="rerun").click()
        shown = opening.value
        until(shown, lambda: any(url.path == "/run.rrd" for url in fetched))
        page.close()
        shown.locator("canvas").wait_for()
        # drawn, not blank, and nothing is added any more
        until(shown, lambda: len(shown.screenshot()) > 40_000 and is_still(shown))
        shown.screenshot(path=shots / "rerun-in-a-new-tab.png")
        outside = [url for url in fetched if url.scheme != "data" and url.hostname != "127.0.0.1"]
        assert [url for url in outside if url.scheme != "blob"] == []
    finally:
        context.close()
        made.close()
        viewers.close()


def test_a_page_elsewhere_cannot_frame_the_panel(chromium, panel, tmp_path):
    outside = tmp_path / "outside.html"
    outside.write_text(f'<iframe id="framed" src="{panel.pages}" width="900" height="500">')
    context = chromium.new_context()
    page = context.new_page()
    refusals = []
    page.on("console", lambda message: refusals.append(message.text))
    page.goto(outside.as_uri())
    until(page, lambda: any("frame-ancestors" in text for text in refusals))
    assert page.frame_locator("#framed").get_by_role("link", name="Runs").count() == 0
    context.close()


def test_a_damaged_run_is_told_of_and_the_others_stay(open_page, panel, first_run):
    shutil.copytree(first_run, panel.root / "20200101-000000-bad")
    (panel.root / "20200101-000000-bad" / "result.json").write_text("[1, 2")
    page = open_page("runs")
    expect(page.locator(".wrong")).to_contain_text("20200101-000000-bad")
    expect(page.locator(".runs tbody tr")).to_have_count(2)  # the first run, the shipped sample
    page.goto(f"{panel.pages}/#/run/20200101-000000-bad")
    expect(page.get_by_role("alert")).to_contain_text("result.json")


def test_a_server_that_comes_back_loses_nothing(open_page, panel, first_run):
    page = open_page(f"run/{first_run.name}?among=all&rank=3")
    expect(page.locator(".values")).to_have_attribute("data-rank", "3")
    port = panel.app.port
    panel.close()
    expect(page.get_by_role("status")).to_contain_text("not reached")
    until(page, lambda: is_free(port))
    again = Panel(panel.root, port=port)
    try:
        expect(page.get_by_role("status")).not_to_contain_text("not reached", timeout=WAIT_MS)
        page.keyboard.press("ArrowDown")
        expect(page.locator(".values")).to_have_attribute("data-rank", "4")
        page.get_by_role("link", name="Why", exact=True).click()
        expect(page.locator("aside")).to_contain_text("Misses that cause violations")
    finally:
        page.context.close()
        again.close()


def is_free(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0
