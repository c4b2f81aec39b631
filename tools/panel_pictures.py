"""Pictures of the panel's places, in light and dark, for the README.

    python tools/panel_pictures.py --out FOLDER [--recordings recordings]

Needs Chromium (``apt-get install chromium``), playwright and Pillow. The pictures show the newest
run of ``auto`` in the recordings folder, beside the newest ones of the paper's method and of
``zero-variance``, whose curve over memory times another one shows; a run that is not there is made
first.
"""

import argparse
import io
import subprocess
import sys
from pathlib import Path

import PIL.Image
from panel_timings import ARGUMENTS, SETTLE_MS, WAIT_MS, server
from playwright.sync_api import Page, sync_playwright

VIEWPORT = {"width": 1400, "height": 860}
COLORS = 256
SCENE_MS = 15_000
"""Software rendering needs so long until the first rollout stands in the scene."""
MEMORY = "img[aria-label='If misses come in bursts'], svg[aria-label*='bursts']"


def main() -> int:
    """Make the runs that are not there yet, and take the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recordings", type=Path, default=Path("recordings"))
    parser.add_argument("--browser", default="/usr/bin/chromium", help="Chromium's program")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    shown = newest(arguments.recordings, "auto", "--reference")
    other = newest(arguments.recordings, "adaptive")
    curve = newest(arguments.recordings, "zero-variance", "--memory-curve")
    run = f"run/{shown}?step=62"
    pictures = (
        ("panel-run", run, "light", ""),
        ("panel-dark", f"{run}&page=uncertainty", "dark", ""),
        ("panel-learning", f"{run}&page=learning", "light", ""),
        ("panel-weights", f"{run}&page=weights", "light", ""),
        ("panel-why", f"{run}&page=why", "light", ""),
        ("panel-memory", f"run/{curve}?page=uncertainty", "light", MEMORY),
        ("panel-runs", f"runs?compare={shown}+{other}+{curve}", "light", ""),
        ("panel-new", f"new?from={shown}", "light", ""),
    )
    with sync_playwright() as playwright, server(arguments.recordings) as address:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        for name, place, theme, at in pictures:
            page = browser.new_page(viewport=VIEWPORT, color_scheme=theme)
            page.set_default_timeout(WAIT_MS)
            page.goto(f"{address}/#/{place}")
            page.locator("main").wait_for()
            page.wait_for_timeout(SCENE_MS)
            if at:
                page.locator(at).first.evaluate("e => e.scrollIntoView({block: 'center'})")
            keep(page, arguments.out / f"{name}.png")
            page.close()
        browser.close()
    return 0


def newest(recordings: Path, method: str, *options: str) -> str:
    """The name of the newest run by a method, made if there is none."""
    if not any(recordings.glob(f"*-{method}")):
        words = [sys.executable, "-m", "pemviz", "record", "--method", method, *options]
        subprocess.run(  # noqa: S603  our own program
            [*words, "--json", "--out", str(recordings)], check=True, capture_output=True
        )
    return max(recordings.glob(f"*-{method}")).name


def keep(page: Page, path: Path) -> None:
    """Keep a picture of the page, once it has settled, in few colours, which load quickly."""
    page.screenshot()  # the scene fades in by frames that are drawn, and none is without a display
    page.wait_for_timeout(SETTLE_MS)
    picture = PIL.Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    few = picture.quantize(
        COLORS,
        method=PIL.Image.Quantize.FASTOCTREE,  # keeps the colours of small marks apart
        dither=PIL.Image.Dither.NONE,
    )
    few.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
