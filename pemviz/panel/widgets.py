"""Small helpers around viser's controls."""

import viser

TABS_WIDTH_PX = 500


def set_html(handle: viser.GuiHtmlHandle, content: str) -> None:
    """Replace what an HTML element shows, if it differs."""
    if handle.content != content:
        handle.content = content


def element_id(handle: viser.GuiInputHandle[int]) -> str:
    """The id of the input's element in the page."""
    return handle._impl.uuid  # pyright: ignore[reportPrivateUsage]
