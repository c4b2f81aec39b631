"""Colours that people with any kind of colour vision tell apart (Okabe and Ito, 2008)."""

BLUE = "#0072B2"
VERMILLION = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
SKY = "#56B4E9"
PURPLE = "#AA4499"
BLACK = "#1f2933"
GREY = "#7b8794"

DETECTED = BLUE
MISSED = VERMILLION
PEM = BLACK
PROPOSAL = VERMILLION
EGO = BLUE
LEAD = ORANGE
METRICS = {"classical": BLUE, "agm": ORANGE, "smooth-cumulative": GREEN}


def rgb(color: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
