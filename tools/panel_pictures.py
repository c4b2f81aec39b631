"""Pictures of every tab of the panel, and of each logical scenario, for the README.

    python tools/panel_pictures.py --out FOLDER [--recordings recordings]

Needs Chromium (``apt-get install chromium``), playwright and Pillow. The pictures show the newest
run of ``auto`` in the recordings folder, beside the newest ones of the paper's method and of
``zero-variance``, whose curve over memory times another one shows, and those of the logical
scenarios in folders of their own; a run that is not there is made first.
"""

import argparse
import io
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import PIL.Image
from panel_timings import (
    ARGUMENTS,
    SETTLE_MS,
    WAIT_MS,
    choose,
    open_panel,
    press,
    server,
    tab,
)
from playwright.sync_api import FloatRect, Page, sync_playwright

from pemviz.config.encounters import LOGICAL_SCENARIOS

VIEWPORT = {"width": 1400, "height": 920}
PIXELS_A_POINT = 1
NOWHERE = (700, 130)
COLORS = 256
SHOWN_STEP = 50
STEPS_BEFORE = 10
"""How long before contact a logical scenario's first picture is taken."""
SCENE = {"x": 424, "y": 44, "width": 976, "height": 876}
ROAD = {"x": 424, "y": 180, "width": 976, "height": 250}
"""Parts of the page: the scene with the rollout's plots, and the road seen from above."""


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
    with sync_playwright() as playwright, server(arguments.recordings) as address:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        context = browser.new_context(viewport=VIEWPORT, device_scale_factor=PIXELS_A_POINT)
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        open_panel(page, address)
        close_notices(page)
        take_pictures(page, arguments.out, shown=shown, others=(other, curve))
        load(page, curve)
        show(page, "img", "If misses come in bursts")
        keep(page, arguments.out / "panel-memory.png")
        browser.close()
    for logical_scenario in LOGICAL_SCENARIOS:
        picture_scenario(logical_scenario, arguments.recordings / logical_scenario, arguments)
    return 0


def picture_scenario(
    logical_scenario: str, recordings: Path, arguments: argparse.Namespace
) -> None:
    """The likeliest contact: before it from behind, and from above as it happens."""
    run = newest(recordings, "mixture", "--preset", logical_scenario)
    with sync_playwright() as playwright, server(recordings) as address:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        page = browser.new_page(viewport=VIEWPORT)
        page.set_default_timeout(WAIT_MS)
        open_panel(page, address)
        close_notices(page)
        load(page, run)
        tab(page, "Trajectories")
        choose(page, "Rule", "no-collision")
        choose(page, "First", "largest contribution")
        page.get_by_text("the largest contribution first").wait_for()
        page.get_by_text("after contact").wait_for()
        page.wait_for_timeout(4 * SETTLE_MS)
        contact = int(page.locator("g[data-cursor]").get_attribute("data-cursor") or 0)
        play_to(page, contact - STEPS_BEFORE)
        before = shot(page, SCENE)
        play_to(page, contact)
        choose(page, "View", "from above")
        road = shot(page, ROAD)
        browser.close()
    both = PIL.Image.new("RGB", (before.width, before.height + road.height))
    both.paste(before, (0, 0))
    both.paste(road, (0, before.height))
    save(both, arguments.out / f"encounter-{logical_scenario}.png")


def newest(recordings: Path, method: str, *options: str) -> str:
    """The name of the newest run by a method, made if there is none."""
    if not any(recordings.glob(f"*-{method}")):
        words = [sys.executable, "-m", "pemviz", "record", "--method", method, *options]
        subprocess.run(  # noqa: S603  our own program
            [*words, "--json", "--out", str(recordings)], check=True, capture_output=True
        )
    return max(recordings.glob(f"*-{method}")).name


def close_notices(page: Page) -> None:
    """Close what viser says about the browser, which would cover the scene."""
    notices = page.locator(".mantine-Notification-closeButton")
    page.wait_for_timeout(SETTLE_MS)
    while notices.count():
        notices.evaluate_all("all => all.forEach(one => one.click())")  # some close by themselves
        page.wait_for_timeout(SETTLE_MS)


def take_pictures(page: Page, folder: Path, *, shown: str, others: Sequence[str]) -> None:
    """Show a run, and picture every tab."""
    load(page, shown)
    page.get_by_role("button", name="Back to the latest run").wait_for()
    keep(page, folder / "panel-recordings.png")
    tab(page, "Experiment")
    keep(page, folder / "panel-experiment.png")
    tab(page, "Trajectories")
    play_to(page, SHOWN_STEP)
    keep(page, folder / "panel-trajectories.png")
    tab(page, "Learning")
    keep(page, folder / "panel-learning.png")
    tab(page, "Weights")
    keep(page, folder / "panel-weights.png")
    tab(page, "Compare")
    for other in others:
        choose(page, "Compare with", other)
        page.get_by_role("cell", name=other).wait_for()
    keep(page, folder / "panel-compare.png")
    tab(page, "Why")
    keep(page, folder / "panel-why.png")
    show(page, "table", "Likeliest chains of misses")
    keep(page, folder / "panel-chains.png")


def load(page: Page, run: str) -> None:
    """Show a run of the recordings folder."""
    tab(page, "Recordings")
    choose(page, "Run", run)
    press(page, "Load")
    page.locator("b", has_text=run).first.wait_for()


def show(page: Page, role: Literal["img", "table"], name: str) -> None:
    """Scroll the tab until a plot or a table is on the page."""
    page.get_by_role(role, name=name).evaluate("e => e.scrollIntoView({block: 'center'})")


def play_to(page: Page, step: int) -> None:
    """Put the playback where the cars come close."""
    row = page.locator("div.mantine-Flex-root", has=page.get_by_text("Step", exact=True)).last
    row.get_by_role("textbox").fill(str(step))
    row.get_by_role("textbox").press("Enter")
    page.locator(f"g[data-cursor='{step}']").wait_for()


def keep(page: Page, path: Path) -> None:
    """Keep a picture of the page in few colours, which a README loads quickly."""
    save(shot(page), path)


def shot(page: Page, clip: FloatRect | None = None) -> PIL.Image.Image:
    """A picture of the page or a part of it, once it has settled."""
    page.mouse.move(*NOWHERE)  # or what the pointer is over tells what it is
    page.wait_for_timeout(SETTLE_MS)
    return PIL.Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")


def save(picture: PIL.Image.Image, path: Path) -> None:
    """Write a picture in few colours."""
    few = picture.quantize(
        COLORS,
        method=PIL.Image.Quantize.FASTOCTREE,  # keeps the colours of small marks apart
        dither=PIL.Image.Dither.NONE,
    )
    few.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
