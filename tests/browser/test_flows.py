"""What a person does with the panel, in a real browser; assertions read the page."""

import json
import re
import shutil
from urllib.parse import urlsplit

import pytest

from pemviz.cli.serve import recorders, viewer
from pemviz.config import ExperimentConfig
from pemviz.panel.controller import Controller
from pemviz.panel.recordings_folder import Viewers
from pemviz.sampling.registry import SHIPPED
from tests.browser.conftest import WAIT_MS, Panel
from tests.browser.driving import (
    THINKING_MS,
    beside,
    charted,
    choose,
    enter,
    expect_done,
    is_enabled,
    is_still,
    newest_curve,
    on_the_page,
    rests,
    run,
    selected,
    slide,
    small,
    tab,
    until,
)
from tests.panel.conftest import wait_until

pytest.importorskip("viser")

SIZES = ((1800, 1140), (1000, 700))


def test_start_shows_a_run_and_every_tab_has_content(open_page, shots, first_run):
    page = open_page()
    page.get_by_text(first_run.name).first.wait_for()
    assert "Failure probability" in page.content()
    contents = {
        "Experiment": "The specification is understood.",
        "Trajectories": "the least robust under classical first",
        "Recordings": "reliable?",
        "Learning": "Rollouts that violate",
        "Weights": "How near the cars come",
        "Compare": "Overlap of the elites",
        "Why": "Diagnostics of the sampling",
    }
    for name, words in contents.items():
        tab(page, name)
        page.get_by_text(words).first.wait_for()
        page.wait_for_timeout(400)
        page.screenshot(path=shots / f"tab-{name.lower()}.png")
        if name == "Learning":
            for width, height in SIZES:
                page.set_viewport_size({"width": width, "height": height})
                until(page, lambda: fits(page))
    # drawn, not blank: the scene's pixels differ from one another
    canvas = page.locator("canvas").first
    assert len(canvas.screenshot()) > 20_000


def fits(page):
    """Playback is on the page, and a plot of the analysis is drawn at its size or larger."""
    plot = page.get_by_role("img", name="Estimate of P(violation)").bounding_box()
    buttons = [page.get_by_role("button", name=name, exact=True) for name in ("Play", "2x")]
    return plot["width"] >= 380 and all(on_the_page(page, button) for button in buttons)


@pytest.mark.parametrize(
    ("preset", "progress", "last", "counts"),
    [
        (
            "paper",
            r"Stage \d+: .* rollouts, until the interval is as narrow as asked",
            11,
            re.compile(
                r"\d{3} of 1440 rollouts, drawn to miss more often, violate "
                r"always\[0,99\] \(gap >= 2\.0\)"
            ),
        ),
        (
            "paper-algorithm",
            r"Stage \d+ of 11: .* rollouts",
            10,
            "84 of 100 rollouts (1200 simulated in all), drawn to miss more often, violate "
            "always[0,99] (gap >= 2.0)",
        ),
    ],
)
def test_paper_runs_end_to_end(open_page, shots, panel, preset, progress, last, counts):
    page = open_page()
    choose(page, "Preset", preset)
    panel.gate.shut()  # or it is over before anyone has looked
    run(page)
    page.get_by_text(re.compile(progress)).wait_for()
    assert page.get_by_role("button", name="Run", exact=True).is_disabled()
    tab(page, "Learning")
    panel.gate.open()
    charted(page, "newest proposal").wait_for()
    page.screenshot(path=shots / "paper-running.png")
    expect_done(page)
    page.get_by_text(re.compile(r"Failure probability in one run: [\d.]+e-15")).wait_for()
    page.get_by_text(counts).wait_for()
    charted(page, f"proposal after stage {last}").wait_for()
    page.screenshot(path=shots / f"{preset}-done.png")


def test_metric_alpha_and_sigma_change_the_curves(open_page, shots, panel):
    page = open_page()
    choose(page, "Preset", "paper-algorithm")
    curves = []
    for change in (
        lambda: None,
        lambda: choose(page, "Metric", "agm"),
        lambda: slide(page, "alpha", 0.9),
        lambda: slide(page, "sigma", 0.98),
    ):
        tab(page, "Experiment")
        small(page)
        change()
        before = panel.controller.state.finished_runs
        run(page)
        until(page, lambda n=before: panel.controller.state.finished_runs > n)
        expect_done(page)
        page.get_by_text(panel.controller.state.run.name).first.wait_for()
        curves.append(newest_curve(page))
    assert len(set(curves)) == 4
    config = panel.controller.state.run.config
    assert (config.metric, config.alpha, config.sigma) == ("agm", 0.9, 0.98)
    page.screenshot(path=shots / "changed-settings.png")


def test_stop_keeps_what_was_finished(open_page, shots, panel):
    page = open_page()
    choose(page, "Method", "mixture")
    small(page, stages=500)
    run(page)
    page.get_by_text(re.compile(r"Stage \d+ of 501")).wait_for()
    page.get_by_role("button", name="Stop", exact=True).click()
    expect_done(page)
    page.get_by_text("No estimate: the run stopped").wait_for()
    page.screenshot(path=shots / "stopped.png")
    folder = panel.controller.state.run.folder
    assert json.loads((folder / "result.json").read_text())["status"] == "stopped"
    assert (folder / "rollouts.npz").exists()


def test_pick_the_worst_rollout_and_play_it(open_page, shots, panel):
    page = open_page()
    tab(page, "Why")
    explanation = panel.controller.state.run.result.explanation
    chain = page.locator("table[aria-label='Likeliest chains of misses'] tr[role=button]").first
    chain.click()
    rollout = f"stage {explanation.stage}, rollout {explanation.chains[0].likeliest}"
    page.locator(f"svg[aria-label*='{rollout}']").wait_for()
    tab(page, "Weights")
    point = page.locator("g[data-target] g[data-number]").last  # over all others
    index = int(point.get_attribute("data-number"))
    point.locator("circle").last.click()
    page.locator(f"g[data-shown='{index}']").wait_for()
    number = int(panel.controller.state.run.rollouts["rollout"][index])
    page.locator(f"svg[aria-label*=', rollout {number}']").wait_for()
    page.screenshot(path=shots / "weights.png")
    tab(page, "Trajectories")
    choose(page, "First", "largest contribution")
    page.get_by_text("the largest contribution first").wait_for()
    choose(page, "First", "least robust")
    choose(page, "Among", "all rollouts")
    page.get_by_text("of 200 rollouts, the least robust").wait_for()
    page.locator("tr[data-rank='4']").click()
    until(page, lambda: selected(page) == 4)
    page.keyboard.press("ArrowDown")
    until(page, lambda: selected(page) == 5)
    choose(page, "Ranked by", "smooth-cumulative")
    page.get_by_text("under smooth-cumulative").wait_for()
    until(page, lambda: selected(page) == 1)
    cursor = page.locator("g[data-cursor]")
    page.get_by_role("button", name="Restart", exact=True).click()
    until(page, lambda: int(cursor.get_attribute("data-cursor")) > 10)
    page.get_by_role("button", name="Pause", exact=True).click()
    until(page, lambda: rests(page, cursor))
    page.screenshot(path=shots / "paused.png")
    for _ in range(3):  # a late frame of the playback may overwrite the slider
        slide(page, "Step", 80)
        page.wait_for_timeout(2_000)
        if cursor.get_attribute("data-cursor") == "80":
            break
    until(page, lambda: cursor.get_attribute("data-cursor") == "80")
    assert re.search(r"m at 4\.00 s|contact at [0-4]\.\d\d s", cursor.text_content())


def test_splitting_is_set_up_run_and_explained(open_page, shots, panel):
    page = open_page()
    labels = {
        "alpha": "alpha", "sigma": "sigma", "stages": "Stages", "rollouts": "Rollouts",
        "final_rollouts": "Final rollouts",
    }  # fmt: skip
    for method in SHIPPED:
        used = method.settings & labels.keys()
        choose(page, "Method", method.name)
        own_alpha = page.get_by_role("checkbox", name="Method's own alpha")
        if "alpha" in used and method.alpha is None:
            own_alpha.uncheck()
        else:
            own_alpha.wait_for(state="hidden")
        until(
            page, lambda u=used: {n for n, label in labels.items() if is_enabled(page, label)} == u
        )
    choose(page, "Method", "splitting")
    enter(page, "Stages", 2)
    enter(page, "Rollouts", 40)
    page.screenshot(path=shots / "splitting-set-up.png")
    run(page)
    until(page, lambda: panel.controller.state.finished_runs > 0)
    expect_done(page)
    page.get_by_text(panel.controller.state.run.name).first.wait_for()
    tab(page, "Learning")
    page.get_by_text("cut and continued").wait_for()
    assert page.get_by_role("img", name="Effective sample size of the violations").count() == 0
    page.screenshot(path=shots / "splitting-learning.png")
    tab(page, "Why")
    page.get_by_text("Splitting's rollouts carry no weights").wait_for()
    page.screenshot(path=shots / "splitting-why.png")


def test_open_in_rerun_shows_the_recording_in_a_new_tab(chromium, tmp_path, shots):
    root = tmp_path / "recordings"
    recording = Controller(root, observers=recorders)
    recording.start(ExperimentConfig(method="naive", final_rollouts=20))
    name = wait_until(recording).run.name
    recording.close()
    viewers = Viewers(viewer)
    made = Panel(root, open_recording=viewers.open)
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(WAIT_MS)
    fetched = []
    context.on("requestfinished", lambda request: fetched.append(urlsplit(request.url)))
    try:
        page = context.new_page()
        page.goto(made.address)
        page.locator("g[data-cursor]").wait_for()
        tab(page, "Recordings")
        choose(page, "Run", name)
        page.get_by_role("button", name="Open in rerun", exact=True).click()
        with context.expect_page() as opened:
            page.get_by_role("link", name=f"Open {name} in rerun's viewer").click()
        page.close()
        shown = opened.value
        until(shown, lambda: any(url.path == "/run.rrd" for url in fetched))
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


def test_a_page_elsewhere_cannot_frame_the_panel(chromium, panel, tmp_path, shots):
    outside = tmp_path / "outside.html"
    outside.write_text(f'<iframe id="framed" src="{panel.address}" width="900" height="500">')
    context = chromium.new_context()
    page = context.new_page()
    refusals = []
    page.on("console", lambda message: refusals.append(message.text))
    page.goto(outside.as_uri())
    until(page, lambda: any("frame-ancestors" in text for text in refusals))
    page.screenshot(path=shots / "framed-by-another-page.png")
    assert page.frame_locator("#framed").get_by_role("button", name="Run").count() == 0
    context.close()


def test_two_browsers_and_a_reload_in_mid_run(open_page, shots, panel):
    first, second = open_page(), open_page()
    for page in (first, second):
        tab(page, "Trajectories")
        choose(page, "Among", "all rollouts")
        page.locator("tr[data-rank='3']").wait_for()
    second.locator("tr[data-rank='3']").click()
    until(second, lambda: selected(second) == 3)
    assert selected(first) == 1
    tab(first, "Experiment")
    choose(first, "Method", "mixture")
    small(first)
    panel.gate.shut()
    run(first)
    second.get_by_text(re.compile(r"Stage \d+ of 3")).wait_for()
    second.screenshot(path=shots / "second-browser-sees-progress.png")
    first.context.close()
    second.reload()
    second.get_by_text(re.compile(r"Stage \d+ of 3")).wait_for()
    second.screenshot(path=shots / "reloaded-in-mid-run.png")
    panel.gate.open()
    expect_done(second)
    second.get_by_text(panel.controller.state.run.name).first.wait_for()
    assert panel.controller.state.run.result.status == "done"
    assert panel.controller.state.error is None


def test_recordings_load_compare_and_download(open_page, shots, panel, first_run, tmp_path):
    page = open_page()
    choose(page, "Method", "naive")
    run(page)
    expect_done(page)
    page.get_by_text(panel.controller.state.run.name).first.wait_for()
    tab(page, "Compare")
    choose(page, "Compare with", first_run.name)
    page.get_by_text("Settings that differ").wait_for()
    other = tmp_path / "recordings" / "20200101-000000-another"
    shutil.copytree(first_run, other)  # by another program, while the panel runs
    choose(page, "Compare with", other.name)
    page.locator("table[aria-label='Estimates of the runs'] tr").nth(3).wait_for()
    page.screenshot(path=shots / "compare-three-runs.png")
    tab(page, "Recordings")
    choose(page, "Run", other.name)
    page.wait_for_timeout(THINKING_MS)  # the chosen run's own notes replace what stands there
    beside(page, "Notes").fill("older drawing <b>")
    page.get_by_role("button", name="Save notes").click()
    page.locator("table[aria-label=Recordings] i", has_text="older drawing <b>").wait_for()
    assert (other / "notes.txt").read_text() == "older drawing <b>"
    page.get_by_role("button", name="Use this run's settings").click()
    page.get_by_text("Settings taken over").wait_for()
    page.get_by_role("button", name="Delete", exact=True).click()
    page.get_by_role("button", name="Keep it").click()
    assert other.is_dir()
    page.get_by_role("button", name="Delete", exact=True).click()
    page.get_by_role("button", name="Delete it for good").click()
    until(page, lambda: not other.exists())
    page.locator("table[aria-label=Recordings]", has_text=other.name).wait_for(state="detached")
    choose(page, "Run", first_run.name)
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("button", name="Back to the latest run").wait_for()
    page.get_by_text("adaptive, classical", exact=True).wait_for()
    for button, suffix in (("result.json", ".json"), ("CSV", ".csv"), ("3D scene (HTML)", ".html")):
        with page.expect_download() as download:
            page.get_by_role("button", name=button, exact=True).click()
        path = tmp_path / f"download{suffix}"
        download.value.save_as(path)
        assert path.stat().st_size > 1000
    assert (tmp_path / "download.json").read_bytes() == (first_run / "result.json").read_bytes()
    assert (tmp_path / "download.csv").read_text().startswith("rank,repetition,stage")
    tab(page, "Experiment")
    assert page.get_by_role("textbox", name="Seed", exact=True).input_value() == "5"
    tab(page, "Recordings")
    assert "__VISER_EMBED_DATA__" in (tmp_path / "download.html").read_text()
    page.get_by_role("button", name="run.rrd", exact=True).click()
    page.get_by_text("has no run.rrd").wait_for()
    page.screenshot(path=shots / "recordings.png")


def test_a_servers_error_is_shown_and_the_server_lives_on(chromium, tmp_path, shots):
    root = tmp_path / "recordings"
    root.write_text("a file where a folder should be")
    made = Panel(root)
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    try:
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(made.address)
        page.locator("g[data-cursor]").wait_for()  # the quick look: never an empty page
        run(page)
        page.get_by_role("alert").get_by_text("no run folder can be made there").wait_for()
        page.screenshot(path=shots / "server-error.png")
        root.unlink()
        choose(page, "Method", "naive")
        run(page)
        expect_done(page)
        page.get_by_text(made.controller.state.run.name).first.wait_for()
    finally:
        context.close()
        made.close()
