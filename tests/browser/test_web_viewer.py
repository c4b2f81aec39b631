"""The recording in a real browser: it is fetched, and nothing comes from outside."""

import shutil
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pemviz.config import ExperimentConfig
from pemviz.recording import Recorder
from pemviz.recording.open import web_viewer
from pemviz.runs.engine import run_experiment

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium")
PATIENCE_MS = 120_000
SOFTWARE_GRAPHICS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed"),
]


def test_the_viewer_fetches_the_recording_and_nothing_from_outside(tmp_path: Path):
    path = tmp_path / "run.rrd"
    config = ExperimentConfig(method="naive", final_rollouts=20)
    run_experiment(config, observers=[Recorder(path)])
    fetched: list[str] = []
    with (
        web_viewer(path, port=0) as address,
        playwright.sync_playwright() as driver,
    ):
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE_GRAPHICS))
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.on("requestfinished", lambda request: fetched.append(request.url))
        with page.expect_request_finished(
            lambda request: urlsplit(request.url).path == "/run.rrd", timeout=PATIENCE_MS
        ):
            page.goto(address)
        page.wait_for_timeout(5000)
        assert page.locator("canvas").count() == 1
        browser.close()
    assert {urlsplit(url).hostname for url in fetched} == {"127.0.0.1"}
