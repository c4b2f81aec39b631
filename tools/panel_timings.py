"""How long a person waits for the panel: from a click to what is seen to change, in a real browser.

    python tools/panel_timings.py [--repeats 20] [--large 1000000]

Needs Chromium (``apt-get install chromium``) and playwright. The server is a process of its own,
``pemviz serve`` as users start it, with a recordings folder of its own, into which a run of 1,200
rollouts and, with ``--large``, one of so many are recorded first. Times are taken in the page, from
the click to the change, with software rendering. Prints a line a figure: median and largest.
"""

import argparse
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
VIEWPORT = {"width": 1280, "height": 720}
WAIT_MS = 120_000
SETTLE_MS = 300
OPENED = ["--preset", "paper-algorithm", "--no-frames"]
LARGE = ["--method", "monte-carlo", "--no-frames", "--keep", "all", "--final-rollouts"]

# Playwright's own click waits for two frames, which software rendering makes long.
CHANGE_MS = """async ([act, seen]) => {
  const look = new Function(`return ${seen}`), before = look(), began = performance.now();
  new Function(act)();
  while (look() === before) {
    if (performance.now() - began > 60000) return NaN;
    await new Promise((wake) => setTimeout(wake, 2));
  }
  return performance.now() - began;
}"""
ROW = "document.querySelectorAll('.ranking tbody tr')[{}].click()"
STEP = "document.querySelector('[aria-label=\"A step back\"]').click()"
PAGE = "document.querySelectorAll('aside > nav a')[{}].click()"
PLAY = "document.querySelector('.controls .main').click()"
START = "document.querySelector('main button.main').click()"
CHART = "document.querySelector('.chart svg').innerHTML"
VALUES = "document.querySelector('.values').textContent"
BESIDE = "document.querySelector('aside').innerHTML"
PLACE = "document.querySelector('main')?.className + document.querySelectorAll('tbody tr').length"
RAN = "document.querySelector('header [role=status]').textContent"
ROLLOUT = "document.querySelector('.values')?.dataset.rank"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--large", type=int, default=0, help="rollouts of a second run to open")
    parser.add_argument("--browser", default="/usr/bin/chromium", help="Chromium's program")
    arguments = parser.parse_args()
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        runs = {"1,200 rollouts": recorded(Path(folder), OPENED)}
        if arguments.large:
            name = recorded(Path(folder), [*LARGE, str(arguments.large)])
            runs[f"{arguments.large:,} rollouts"] = name
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        with server(Path(folder)) as address:
            page = browser.new_context(viewport=VIEWPORT).new_page()
            page.set_default_timeout(WAIT_MS)
            figures: dict[str, list[float]] = {}
            for name, took_ms in measure(page, address, runs, repeats=arguments.repeats):
                figures.setdefault(name, []).append(took_ms)
        browser.close()
    for name, values in figures.items():
        median = statistics.median(values)
        print(f"{name}: {median:.0f} ms, at most {max(values):.0f} (median of {len(values)})")
    return 0


def recorded(folder: Path, options: list[str]) -> str:
    """The name of a run that is recorded into the folder."""
    words = [sys.executable, "-m", "pemviz", "record", *options, "--json", "--out", str(folder)]
    subprocess.run(words, check=True, capture_output=True)  # noqa: S603  our own program
    return max(path.name for path in folder.iterdir() if path.is_dir())


def measure(
    page: Page, address: str, runs: dict[str, str], *, repeats: int
) -> Iterator[tuple[str, float]]:
    """Every figure [ms], by name."""

    def took(act: str, seen: str) -> float:
        found = float(page.evaluate(CHANGE_MS, [act, seen]))
        page.wait_for_timeout(SETTLE_MS)
        return found

    def go(place: str) -> str:
        return f"location.hash = '#/{place}'"

    page.goto(f"{address}/#/runs")
    page.locator(".runs").wait_for()
    for words, name in runs.items():  # the first time: read from disk
        page.wait_for_timeout(SETTLE_MS)
        yield f"open a run of {words}, first time", took(go(f"run/{name}"), ROLLOUT)
        page.evaluate(go("runs"))
        page.locator(".runs").wait_for()
    for words, name in runs.items():
        for _ in range(repeats):
            yield f"open a run of {words}, again", took(go(f"run/{name}"), ROLLOUT)
            yield "navigation", took(go("runs"), PLACE)
    page.evaluate(go(f"run/{runs['1,200 rollouts']}?among=all"))
    page.locator(".values").wait_for()
    for turn in range(repeats):
        yield "row", took(ROW.format(1 + turn % 5), CHART)
        yield "step", took(STEP, VALUES)
        yield "page", took(PAGE.format(1 + turn % 5), BESIDE)
        page.evaluate(PAGE.format(0))
        page.evaluate(STEP)
        page.wait_for_timeout(SETTLE_MS)
        yield "play", took(PLAY, VALUES)
        page.evaluate(PLAY)
        page.wait_for_timeout(SETTLE_MS)
    yield from first_signs(page, address, repeats=repeats)


def first_signs(page: Page, address: str, *, repeats: int) -> Iterator[tuple[str, float]]:
    """From Run of the form for a new run to the first word of it."""
    for _ in range(repeats):
        page.goto(f"{address}/#/new")
        page.locator("main button.main:enabled").wait_for()
        page.wait_for_timeout(SETTLE_MS)
        yield "first sign of a run", float(page.evaluate(CHANGE_MS, [START, RAN]))
        page.get_by_role("banner").get_by_role("button", name="Stop").wait_for(state="hidden")


@contextmanager
def server(recordings: Path) -> Iterator[str]:
    """``pemviz serve`` in a process of its own; yields the panel's address."""
    began = time.perf_counter()
    words = [sys.executable, "-m", "pemviz", "serve", "--no-browser", "--port", "0"]
    with subprocess.Popen(  # noqa: S603  our own program
        [*words, "--recordings", str(recordings)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            for line in process.stdout or ():
                found = re.search(r"http://\S+", line)
                if found:
                    print(f"server started to address printed: {time.perf_counter() - began:.2f} s")
                    yield found.group()
                    break
        finally:
            process.terminate()
            process.wait(timeout=30)


if __name__ == "__main__":
    sys.exit(main())
