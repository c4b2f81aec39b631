"""Colours that can be read on rerun's dark theme and on its light one.

A view is as dark or light as the viewer's theme, and the viewer takes the theme of its system; a
recording has one colour for both. So everything that is drawn has a luminance in the middle, where
it differs from either background. Contrast is that of WCAG 2.2 (relative luminances, 1.4.3).
"""

from pemviz.colors import Rgba, rgba

BACKGROUNDS = ("#ffffff", "#efefef", "#0d0d0d", "#1d1d1d")
"""Of views, and of the boxes under words in them: light, then dark (rerun 0.41, as rendered)."""
LOWEST, HIGHEST = 0.143, 0.2445
"""Relative luminances between which a colour differs by 3.1 to 1 or more from every background."""
WORDS: Rgba = (120, 120, 120, 255)
"""For words and lines without a meaning of their own: differs most from what differs least."""
ROAD: Rgba = (128, 128, 128, 50)
"""In 3D, where what is transparent lets the theme's background through."""


def luminance(color: Rgba) -> float:
    """Relative luminance, from 0 (black) to 1 (white), of an opaque colour."""
    red, green, blue = map(_linear, color[:3])
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def shade(color: str, *, opacity: int = 255) -> Rgba:
    """``#rrggbb``, darker or lighter as far as either theme needs it; its hue stays."""
    found = luminance(rgba(color))
    if found < LOWEST:
        share = (LOWEST - found) / (1.0 - found)
        parts = [part + share * (1.0 - part) for part in map(_linear, rgba(color)[:3])]
    else:
        parts = [part * min(1.0, HIGHEST / found) for part in map(_linear, rgba(color)[:3])]
    red, green, blue = (round(255 * _encoded(part)) for part in parts)
    return red, green, blue, opacity


def _linear(value: int) -> float:
    part = value / 255
    return part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4


def _encoded(part: float) -> float:
    return 12.92 * part if part <= 0.0031308 else 1.055 * part ** (1 / 2.4) - 0.055
