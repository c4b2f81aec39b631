"""What is drawn can be read on rerun's dark theme and on its light one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz import colors
from pemviz.colors import rgba
from pemviz.recording import paths
from pemviz.recording.shades import BACKGROUNDS, ROAD, WORDS, luminance, shade
from tests.recording.read_back import chunks

LEAST = 3.0
"""Of graphics and large words, by WCAG 2.2 (1.4.11 and 1.4.3)."""
CARRIER = {"Boxes3D", "LineStrips2D", "LineStrips3D", "Points2D", "Points3D", "SeriesLines"}


def contrast(one, other) -> float:
    """How much two opaque colours differ: 1 (not at all) to 21 (black and white)."""
    low, high = sorted(map(luminance, (one, other)))
    return (high + 0.05) / (low + 0.05)


def least_contrast(color) -> float:
    return min(contrast(color, rgba(background)) for background in BACKGROUNDS)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [("#000000", "#ffffff", 21.0), ("#777777", "#ffffff", 4.48), ("#0000ff", "#ffffff", 8.59)],
)
def test_contrast_is_that_of_wcag(one, other, expected):
    """Published examples."""
    assert contrast(rgba(one), rgba(other)) == pytest.approx(expected, abs=0.005)
    assert contrast(rgba(other), rgba(one)) == contrast(rgba(one), rgba(other))


@given(parts=st.tuples(*[st.integers(0, 255)] * 3))
def test_every_shade_can_be_read_on_both_themes(parts):
    color = "#" + "".join(f"{part:02x}" for part in parts)
    assert least_contrast(shade(color)) >= LEAST
    assert shade(color, opacity=70)[3] == 70


def test_words_differ_most_from_the_background_that_they_differ_least_from():
    every = [least_contrast((grey, grey, grey, 255)) for grey in range(256)]
    assert least_contrast(WORDS) == max(every) > 3.7


def test_colours_that_tell_things_apart_still_do():
    """The palette's, of which some lose most of their lightness."""
    palette = [shade(color)[:3] for color in (
        colors.BLUE, colors.SKY, colors.VERMILLION, colors.ORANGE, colors.GREEN, colors.PURPLE,
        colors.GREY,
    )]  # fmt: skip
    apart = [np.abs(np.subtract(one, other)).sum() for place, one in enumerate(palette)
             for other in palette[:place]]  # fmt: skip
    assert min(apart) > 60
    assert shade(colors.MISSED) == rgba(colors.MISSED)


def test_a_road_in_3d_leaves_words_over_it_readable():
    """It lets the background through, and so do the boxes under words, by about a half."""
    for background, box in (("#ffffff", "#efefef"), ("#0d0d0d", "#1d1d1d")):
        share = ROAD[3] / 255
        through = [share * road + (1 - share) * back
                   for road, back in zip(ROAD[:3], rgba(background)[:3], strict=True)]  # fmt: skip
        under = [0.5 * (one + other) for one, other in zip(through, rgba(box)[:3], strict=True)]
        red, green, blue = map(round, under)
        assert contrast(WORDS, (red, green, blue, 255)) >= LEAST


def test_all_that_is_drawn_can_be_read_on_both_themes(learned):
    """Colours as they stand in the file; what is faint on purpose is transparent.

    Lines from above stand on asphalt, whatever the theme.
    """
    found, seen = set(), set()
    from_above = paths.plan(1).rpartition("/")[0]
    for chunk in chunks(learned.path):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            carrier, _, component = name.partition(":")
            on_asphalt = chunk.entity_path.startswith(from_above) and carrier == "LineStrips2D"
            if component == "colors" and not on_asphalt:
                seen.add(carrier)
                rows = batch[name].to_pylist()
                found |= {(chunk.entity_path, number) for row in rows for number in row or ()}
    assert seen == CARRIER
    unreadable = {
        (path, f"{number:08x}")
        for path, number in found
        if number & 255 == 255
        and least_contrast((number >> 24, number >> 16 & 255, number >> 8 & 255, 255)) < LEAST
    }
    assert unreadable == set()
