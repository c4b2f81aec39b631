"""Pictures of the gallery: the panel on a violation of each scenario.

    python tools/gallery_pictures.py --out docs/pictures braking=FOLDER/RUN?step=40&rank=1 ...

A word names a picture, and the run's folder with what the panel's address says of it. Needs
Chromium (``apt-get install chromium``), playwright and Pillow.
"""

import argparse
import sys
from pathlib import Path

import PIL.Image
from panel_pictures import SCENE_MS, keep
from panel_timings import ARGUMENTS, WAIT_MS, server
from playwright.sync_api import sync_playwright

VIEWPORT = {"width": 1280, "height": 720}
TOP_PX, RIGHT_PX = 110, 818
"""Of the picture; it ends below the first chart."""


def main() -> int:
    """Take a picture a word."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("pictures", nargs="+", help="NAME=FOLDER/RUN?step=STEP")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--browser", default="/usr/bin/chromium", help="Chromium's program")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        for word in arguments.pictures:
            name, address = word.split("=", 1)
            folder, _, query = address.partition("?")
            with server(Path(folder).parent) as panel:
                page = browser.new_page(viewport=VIEWPORT, color_scheme="light")
                page.set_default_timeout(WAIT_MS)
                page.goto(f"{panel}/#/run/{Path(folder).name}?{query}")
                page.locator("main").wait_for()
                page.get_by_text("Looking").wait_for(state="hidden")
                page.get_by_role("button", name="Play").wait_for()
                page.wait_for_timeout(2 * SCENE_MS)
                picture = arguments.out / f"{name}.png"
                keep(page, picture)
                chart = page.locator(".charts .chart").first.bounding_box()
                assert chart is not None  # noqa: S101  it was waited for
                edges = (0, TOP_PX, RIGHT_PX, round(chart["y"] + chart["height"]))
                PIL.Image.open(picture).crop(edges).save(picture, optimize=True)
                page.close()
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
