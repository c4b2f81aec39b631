"""How the page is divided: the column of controls, the scene, and two windows over the scene.

The window of the analysis is laid over the scene and is a bar of its tabs' names while the scene
is to be seen; a click on a name opens it. The window of the rollout stays below it, so that a
rollout that is picked in the analysis shows at once.
"""

import viser

from pemviz.panel.views.page import MARGIN_PX, NARROWEST_PX, ROLLOUT_PX, SHORT_PX


class Window:
    """A window over the scene, as wide as the scene is."""

    def __init__(self, client: viser.ClientHandle, *, at_top: bool) -> None:
        """Place it.

        Args:
            client: The browser.
            at_top: Whether it reaches from the top down, and not up from the bottom.
        """
        self.panel = client.gui.add_panel()
        self._client = client
        self._at_top = at_top
        self._size_px = (0, 0)

    def fit(self) -> None:
        """Lay it over the scene anew if the scene's size has changed."""
        camera = self._client.camera
        size_px = (int(camera.image_width), int(camera.image_height))
        if size_px == self._size_px:
            return
        self._size_px = size_px
        self.panel.float(
            x=MARGIN_PX,
            y=MARGIN_PX if self._at_top else -MARGIN_PX,
            width=max(size_px[0] - 2 * MARGIN_PX, NARROWEST_PX),
            height=size_px[1] if self._at_top else ROLLOUT_PX,
        )

    @property
    def is_short(self) -> bool:
        """Whether the page is too low for the analysis and the rollout's plots together."""
        return int(self._client.camera.image_height) < SHORT_PX
