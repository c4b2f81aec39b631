"""The palette of Okabe and Ito (2008), which people with any kind of colour vision tell apart.

As ``#rrggbb``; roles that colours have in several views stand below them.
"""

Rgba = tuple[int, int, int, int]

BLUE = "#0072B2"
SKY = "#56B4E9"
VERMILLION = "#D55E00"
ORANGE = "#E69F00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
GREY = "#7b8794"
BLACK = "#1f2933"
WHITE = "#ebebeb"

DETECTED = BLUE
MISSED = VERMILLION
HOLDS = SKY
VIOLATED = VERMILLION
EGO = BLUE
LEAD = ORANGE
CARS = (EGO, LEAD, PURPLE, GREEN, SKY)
"""Of a scene with several cars, the ego first."""
SOURCES = {
    "sampling": BLUE,
    "lost": BLACK,
    "reference": GREEN,
    "refits": ORANGE,
    "model-classes": VERMILLION,
    "memory": GREY,
    "data": PURPLE,
}
"""Of the sources of uncertainty."""
METRICS = {"classical": BLUE, "agm": ORANGE, "smooth-cumulative": GREEN}

# on white, as in the panel, and on either theme of rerun's viewer
PEM, PEM_IN_RECORDING = BLACK, GREY
PROPOSAL, PROPOSAL_IN_RECORDING = VERMILLION, ORANGE


def car_color(car: int) -> str:
    """The ego's is its own; the others' in their order."""
    return CARS[0] if car == 0 else CARS[1:][(car - 1) % (len(CARS) - 1)]


def rgb(color: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def rgba(color: str, *, opacity: int = 255) -> Rgba:
    """``#rrggbb`` and an opacity, as four numbers from 0 to 255."""
    return (*rgb(color), opacity)
