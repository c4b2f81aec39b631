"""How long a person waits for the panel, measured in a real browser.

    python tools/panel_timings.py [--repeats 3]

Needs Chromium (``apt-get install chromium``) and playwright. The server is a process of its
own, ``pemviz serve`` as users start it, with a recordings folder of its own. Prints one line a
figure, the median over the repeats.
"""

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
VIEWPORT = {"width": 1280, "height": 800}
WAIT_MS = 120_000
SETTLE_MS = 1500
# Playwright's own click waits for two frames, which software rendering makes long: times are taken
# in the page, from the click's arrival to the words on the page.
STOPWATCH = """() => {
  const watch = window.pemvizStopwatch = {};
  const status = () => document.querySelector('[role=status]')?.textContent ?? '';
  document.addEventListener('click', (event) => {
    watch.began = event.timeStamp;
    let away = status() !== 'Ready.';
    const observer = new MutationObserver(() => {
      if (status() !== 'Ready.') { away = true; return; }
      if (!away) return;
      observer.disconnect();
      watch.ended = performance.now();
    });
    observer.observe(document.body, {subtree: true, childList: true, characterData: true});
  }, {capture: true, once: true});
}"""


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--browser", default="/usr/bin/chromium", help="Chromium's program")
    arguments = parser.parse_args()
    figures: dict[str, list[float]] = {}
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        for repeat in range(arguments.repeats):
            for name, value_s in measure(browser, Path(folder) / str(repeat)):
                figures.setdefault(name, []).append(value_s)
        browser.close()
    for name, values in figures.items():
        print(f"{name}: {statistics.median(values):.2f} s (median of {len(values)})")
    return 0


def measure(browser: Browser, recordings: Path) -> Iterator[tuple[str, float]]:
    """The figures of one server, by name [s]."""
    began = time.perf_counter()
    with server(recordings) as address:
        yield "server started to address printed", time.perf_counter() - began
        page = browser.new_context(viewport=VIEWPORT).new_page()
        page.set_default_timeout(WAIT_MS)
        began = time.perf_counter()
        open_panel(page, address)
        yield "page opened to usable, run shown", time.perf_counter() - began
        yield from run_paper(page, recordings)
        yield from rank_again(page)
        yield from stop(page)
        page.context.close()


@contextmanager
def server(recordings: Path) -> Iterator[str]:
    """``pemviz serve`` in a process of its own; yields the panel's address."""
    words = [sys.executable, "-m", "pemviz", "serve", "--no-browser", "--port", "0"]
    with subprocess.Popen(  # noqa: S603  our own program
        [*words, "--recordings", str(recordings)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            for line in process.stdout or ():
                found = re.search(r"http://\S+", line)
                if found:
                    yield found.group()
                    break
        finally:
            process.terminate()
            process.wait(timeout=30)


def open_panel(page: Page, address: str) -> None:
    """Go there, and wait until the controls and a run are shown."""
    page.goto(f"{address}/scene/form")
    page.get_by_role("button", name="Run", exact=True).wait_for()
    page.locator("g[data-cursor]").wait_for()


def run_paper(page: Page, recordings: Path) -> Iterator[tuple[str, float]]:
    """Preset ``paper`` from pressing Run to the estimate on the page, then headless."""
    yield "Run pressed to final estimate on the page", until_ready(page, "Run")
    newest = max(recordings.glob("*-adaptive"))
    engine_s = json.loads((newest / "result.json").read_text())["timings_s"]["total"]
    yield "the same run's own time in the panel", engine_s
    words = [sys.executable, "-m", "pemviz", "record", "--json", "--out", str(recordings)]
    began = time.perf_counter()
    answer = subprocess.run(words, check=True, capture_output=True, text=True)  # noqa: S603
    yield "pemviz record, whole process", time.perf_counter() - began
    yield "pemviz record, the run's own time", json.loads(answer.stdout)["timings_s"]["total"]


def rank_again(page: Page) -> Iterator[tuple[str, float]]:
    """10,000 rollouts ranked by another metric, from the choice to the table on the page."""
    choose(page, "Method", "naive")
    enter(page, "Final rollouts", 10_000)
    until_ready(page, "Run")
    tab(page, "Trajectories")
    page.get_by_text("under classical").wait_for()
    page.wait_for_timeout(SETTLE_MS)
    for metric in ("agm", "smooth-cumulative", "classical"):
        page.get_by_role("combobox", name="Ranked by", exact=True).click()
        option = page.get_by_role("option", name=metric, exact=True)
        option.wait_for()
        yield (
            f"10,000 rollouts ranked by {metric}, choice to table",
            timed(page, option.click, page.get_by_text(f"under {metric}").wait_for),
        )
        page.wait_for_timeout(SETTLE_MS)


def stop(page: Page) -> Iterator[tuple[str, float]]:
    """A long run stopped in mid-fit, from pressing Stop to Ready on the page."""
    tab(page, "Experiment")
    choose(page, "Method", "adaptive")
    press(page, "Run")
    page.get_by_text(re.compile(r"Stage [2-9] of \d+")).wait_for()
    yield "Stop pressed to ready", until_ready(page, "Stop")


def timed(page: Page, act: Callable[[], object], wait: Callable[[], object]) -> float:
    """Seconds from before ``act`` until ``wait`` returns."""
    page.wait_for_timeout(0)
    began = time.perf_counter()
    act()
    wait()
    return time.perf_counter() - began


def until_ready(page: Page, button: str) -> float:
    """Press a button; seconds from the click in the page until the page says Ready."""
    page.evaluate(STOPWATCH)
    press(page, button)
    page.wait_for_function("window.pemvizStopwatch.ended !== undefined", polling=100)
    watch = page.evaluate("window.pemvizStopwatch")
    return (watch["ended"] - watch["began"]) / 1000.0


def tab(page: Page, name: str) -> None:
    """Show a tab."""
    page.get_by_text(name, exact=True).first.click()


def press(page: Page, name: str) -> None:
    """Press a button."""
    page.get_by_role("button", name=name, exact=True).click()


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of a dropdown."""
    page.get_by_role("combobox", name=label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def enter(page: Page, label: str, value: int) -> None:
    """Type a number."""
    box = page.get_by_role("textbox", name=label, exact=True)
    box.fill(str(value))
    box.press("Enter")
    page.wait_for_timeout(200)


if __name__ == "__main__":
    sys.exit(main())
