"""Colours that stay apart for a colour-blind person (Okabe and Ito's palette), as RGBA."""

Rgba = tuple[int, int, int, int]

BLUE: Rgba = (0, 114, 178, 255)
SKY: Rgba = (86, 180, 233, 255)
VERMILLION: Rgba = (213, 94, 0, 255)
ORANGE: Rgba = (230, 159, 0, 255)
GREEN: Rgba = (0, 158, 115, 255)
PURPLE: Rgba = (204, 121, 167, 255)
GREY: Rgba = (150, 150, 150, 255)
DARK_GREY: Rgba = (70, 70, 70, 255)
WHITE: Rgba = (235, 235, 235, 255)

HOLDS = SKY
VIOLATED = VERMILLION
DETECTED = BLUE
MISSED = VERMILLION
PEM = GREY
PROPOSAL = ORANGE
# rerun adds up the colours of bars that overlap: where both are, the sum is orange
PEM_BARS: Rgba = (60, 60, 70, 255)
PROPOSAL_BARS: Rgba = (190, 115, 0, 255)


def faded(color: Rgba, alpha: int) -> Rgba:
    """The colour at another opacity (0 to 255)."""
    return (color[0], color[1], color[2], alpha)
