"""What can be read off a page, and waiting for it."""

import io

import PIL.Image
import pytest

from tests.browser.conftest import WAIT_MS


def until(page, condition, *, timeout_ms=WAIT_MS):
    for _ in range(timeout_ms // 50):
        if condition():
            return
        page.wait_for_timeout(50)
    pytest.fail("the page did not get there")


def on_the_page(page, locator):
    """Whether all of an element is within what the browser shows."""
    box, size = locator.bounding_box(), page.viewport_size
    return (
        box is not None and box["x"] >= 0 and box["x"] + box["width"] <= size["width"]
        and box["y"] >= 0 and box["y"] + box["height"] <= size["height"]
    )  # fmt: skip


def is_still(page):
    """Whether the page looks the same for three seconds."""
    before = page.screenshot()
    page.wait_for_timeout(3000)
    return page.screenshot() == before


def is_drawn(locator):
    """Whether a picture is more than one colour with little on it."""
    picture = PIL.Image.open(io.BytesIO(locator.screenshot())).convert("RGB")
    counts = [count for count, _ in picture.getcolors(picture.width * picture.height)]
    return max(counts) < 0.9 * sum(counts)


def fits(page):
    """Whether nothing of the page lies beside the window."""
    return page.evaluate("document.documentElement.scrollWidth <= innerWidth")
