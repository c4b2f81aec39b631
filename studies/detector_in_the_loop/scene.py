"""What stays the same for a rollout: light, weather, road, roadside, exposure, cars and traffic.

A scene is drawn from a *domain*, the light and weather that an answer is about. All distributions
are this study's own choice of what is plausible on a road; none is fitted to anything.

**Light.** ``day``: illuminance log-uniform from 0.5 to 1.2 (1: an overcast noon). ``dusk``:
log-uniform from 0.004 to 0.06; headlights and rear lamps are on. ``low sun``: 0.5 to 1.0, the sun
at a bearing normal(0, 30 degrees) and 1 to 14 degrees high; ahead, it veils the image (strength
lognormal(0.25, 0.8), with the windscreen's dirt) and cars turn their shaded side to the camera.

**Weather.** Extinction [1/m]: ``dry`` lognormal(0.0008, 0.5); ``rain`` lognormal(0.006, 0.5) with
spray, drops and wipers; ``fog`` lognormal(0.040, 0.45) within 0.015 to 0.12 (a visibility of 200 to
25 m by Koschmieder's 3 / extinction).

**Camera.** Error of exposure normal(0, 0.35) stops; noise lognormal(1, 0.25) times the nominal;
vibration lognormal(0.35, 0.6) px.

**Place.** In the loop all cars are normal(0, 0.15) m beside where the scenario has them: the ego's
place in its lane, which no scenario of pemviz's knows.

**Cars.** One of the bodies; paint: white 25, grey 22, black 22, silver 12, blue 9, red 7, other
colours 3 %, each with a spread; lamps that flicker with the camera's frames in 40 %.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import Batch, FloatArray
from studies.detector_in_the_loop.bodies import BODIES
from studies.detector_in_the_loop.camera import CENTRE_X_PX, FOCAL_PX, HORIZON_PX
from studies.detector_in_the_loop.hashing import Seeds

SCENE_COLUMNS = (
    *("light", "weather", "illuminance", "extinction_per_m", "backlight"),
    *("sun_u_px", "sun_v_px", "glare", "sky_r", "sky_g", "sky_b"),
    *("road", "verge_r", "verge_g", "verge_b", "mark", "texture", "shade"),
    *("skyline_px", "skyline_tone", "roadside", "exposure", "noise", "headlights"),
    *(
        "vibration_px",
        "drops",
        "wiper_period_s",
        "wiper_phase",
        "traffic_m",
        "traffic_mps",
        "offset_m",
    ),
)
"""Names of a scene's numbers."""
AT = {name: place for place, name in enumerate(SCENE_COLUMNS)}
CAR_COLUMNS = ("body", "red", "green", "blue", "lamps", "flicker_hz")
"""Of each car; colours are reflectances, ``lamps`` whether its rear lamps are on."""
LIGHTS = ("day", "dusk", "low sun")
WEATHERS = ("dry", "rain", "fog")
OFFSET_M = 0.15
"""Standard deviation of a car's place in its lane, seen from the ego's."""
TRAFFIC = 1
"""Cars in a scene beside those of the scenario: the last one."""

PAINTS = (
    (0.25, (0.75, 0.75, 0.73)),
    (0.22, (0.16, 0.16, 0.17)),
    (0.22, (0.025, 0.025, 0.027)),
    (0.12, (0.42, 0.43, 0.44)),
    (0.09, (0.03, 0.06, 0.20)),
    (0.07, (0.32, 0.02, 0.02)),
    (0.03, (0.25, 0.22, 0.05)),
)
"""Shares and linear reflectances."""


@dataclass(frozen=True)
class Domain:
    """Where and when the ego drives.

    Attributes:
        name: In files and tables.
        lights: Shares of :data:`LIGHTS`.
        weathers: Shares of :data:`WEATHERS`.
    """

    name: str
    lights: tuple[float, float, float]
    weathers: tuple[float, float, float]


DOMAINS = {
    "fair": Domain("fair", (0.70, 0.10, 0.20), (1.0, 0.0, 0.0)),
    "rain": Domain("rain", (0.60, 0.40, 0.0), (0.0, 1.0, 0.0)),
    "fog": Domain("fog", (0.75, 0.25, 0.0), (0.0, 0.0, 1.0)),
    "all": Domain("all", (0.60, 0.25, 0.15), (0.70, 0.18, 0.12)),
}


@dataclass(frozen=True)
class Scenes(Batch):
    """N scenes.

    Attributes:
        values: By :data:`SCENE_COLUMNS`, ``[N, S]``.
        cars: By :data:`CAR_COLUMNS`, ``[N, K + 1, C]``; the last one is traffic.
        seeds: Of the roadside, the road's texture, drops and lamps, ``[N]``.
        frame_seeds: Of what is new in each frame: noise, blur, flicker, ``[N]``.
    """

    values: FloatArray
    cars: FloatArray
    seeds: Seeds
    frame_seeds: Seeds

    @property
    def count(self) -> int:
        """Number of scenes N."""
        return len(self.values)

    def column(self, name: str) -> FloatArray:
        """One of :data:`SCENE_COLUMNS`, ``[N]``."""
        return self.values[:, AT[name]]


def draw_scenes(domain: Domain, *, count: int, cars: int, seeds: np.random.SeedSequence) -> Scenes:
    """Scenes for ``cars`` cars of a scenario and one of the traffic."""
    random = np.random.default_rng(seeds)
    values = np.zeros((count, len(SCENE_COLUMNS)))
    light = random.choice(len(LIGHTS), count, p=domain.lights)
    weather = random.choice(len(WEATHERS), count, p=domain.weathers)
    # low sun and rain or fog do not go together: such a scene is one of the day
    light = np.where((LIGHTS.index("low sun") == light) & (weather > 0), 0, light)
    values[:, AT["light"]], values[:, AT["weather"]] = light, weather
    _draw_light(values, random)
    _draw_weather(values, random)
    _draw_road(values, random)
    _draw_camera(values, random)
    drawn = _draw_cars(count, cars + TRAFFIC, values[:, AT["headlights"]], random)
    own_seeds = random.integers(0, 2**64, (2, count), dtype=np.uint64)
    values[:, AT["offset_m"]] = OFFSET_M * random.standard_normal(count)
    return Scenes(values=values, cars=drawn, seeds=own_seeds[0], frame_seeds=own_seeds[1])


def _draw_light(values: FloatArray, random: np.random.Generator) -> None:
    count, light = len(values), values[:, AT["light"]]
    day, dusk, low = (light == number for number in range(3))
    spread = random.random(count)
    illuminance = np.where(day, 0.5 * 2.4**spread, 0.5 * 2.0**spread)
    values[:, AT["illuminance"]] = np.where(dusk, 0.004 * 15.0**spread, illuminance)
    bearing = np.deg2rad(random.normal(0.0, 30.0, count)).clip(-1.3, 1.3)
    height = np.deg2rad(random.uniform(1.0, 14.0, count))
    values[:, AT["sun_u_px"]] = CENTRE_X_PX + FOCAL_PX * np.tan(bearing)
    values[:, AT["sun_v_px"]] = HORIZON_PX - FOCAL_PX * np.tan(height)
    strength = 0.25 * np.exp(0.8 * random.standard_normal(count))
    values[:, AT["glare"]] = np.where(low, strength * np.cos(bearing) ** 2, 0.0)
    values[:, AT["backlight"]] = np.where(low, 0.35 + 0.3 * np.sin(np.abs(bearing)), 1.0)
    blue = random.random(count)[:, None]
    sky = blue * np.array([0.40, 0.58, 0.85]) + (1.0 - blue) * np.array([0.72, 0.74, 0.76])
    warm = np.array([0.95, 0.72, 0.50])
    values[:, AT["sky_r"] : AT["sky_b"] + 1] = np.where(low[:, None], 0.5 * (sky + warm), sky)
    values[:, AT["shade"]] = np.where(day, random.random(count) ** 2, np.where(low, 0.6, 0.0))


def _draw_weather(values: FloatArray, random: np.random.Generator) -> None:
    count, weather = len(values), values[:, AT["weather"]]
    rain, fog = weather == 1, weather == 2
    median = np.array([0.0008, 0.006, 0.040])[weather.astype(np.int64)]
    spread = np.where(fog, 0.45, 0.5) * random.standard_normal(count)
    extinction = median * np.exp(spread)
    values[:, AT["extinction_per_m"]] = np.where(fog, extinction.clip(0.015, 0.12), extinction)
    values[:, AT["drops"]] = np.where(rain, random.uniform(4.0, 16.0, count), 0.0)
    values[:, AT["wiper_period_s"]] = np.where(rain, random.uniform(0.9, 1.8, count), 0.0)
    values[:, AT["wiper_phase"]] = random.random(count)
    grey = np.array([0.62, 0.64, 0.66])
    sky = values[:, AT["sky_r"] : AT["sky_b"] + 1]
    values[:, AT["sky_r"] : AT["sky_b"] + 1] = np.where((weather > 0)[:, None], grey, sky)
    values[:, AT["shade"]] *= weather == 0
    dark = values[:, AT["light"]] == 1
    values[:, AT["headlights"]] = dark | ((weather > 0) & (random.random(count) < 0.8))


def _draw_road(values: FloatArray, random: np.random.Generator) -> None:
    count = len(values)
    wet = values[:, AT["weather"]] == 1
    values[:, AT["road"]] = random.uniform(0.08, 0.26, count) * np.where(wet, 0.6, 1.0)
    kind = random.choice(3, count, p=(0.55, 0.25, 0.20))
    verges = np.array([[0.10, 0.16, 0.05], [0.24, 0.20, 0.13], [0.55, 0.56, 0.58]])
    tone = np.exp(0.25 * random.standard_normal(count))[:, None]
    values[:, AT["verge_r"] : AT["verge_b"] + 1] = (verges[kind] * tone).clip(0.02, 0.8)
    values[:, AT["mark"]] = random.uniform(0.35, 0.8, count)
    values[:, AT["texture"]] = random.uniform(0.03, 0.22, count)
    values[:, AT["skyline_px"]] = random.gamma(2.0, 2.2, count).clip(0.5, 16.0)
    values[:, AT["skyline_tone"]] = random.uniform(0.04, 0.35, count)
    values[:, AT["roadside"]] = random.uniform(0.0, 1.0, count)


def _draw_camera(values: FloatArray, random: np.random.Generator) -> None:
    count = len(values)
    values[:, AT["exposure"]] = 2.0 ** (0.35 * random.standard_normal(count))
    values[:, AT["noise"]] = np.exp(0.25 * random.standard_normal(count))
    values[:, AT["vibration_px"]] = 0.35 * np.exp(0.6 * random.standard_normal(count))
    present = random.random(count) < 0.6
    values[:, AT["traffic_m"]] = np.where(present, random.uniform(-15.0, 90.0, count), -1e3)
    values[:, AT["traffic_mps"]] = random.normal(2.0, 4.0, count)


def _draw_cars(count: int, cars: int, dark: FloatArray, random: np.random.Generator) -> FloatArray:
    found = np.empty((count, cars, len(CAR_COLUMNS)))
    found[..., 0] = random.integers(0, len(BODIES), (count, cars))
    shares = [share for share, _ in PAINTS]
    paint = random.choice(len(PAINTS), (count, cars), p=shares)
    tone = np.exp(0.25 * random.standard_normal((count, cars, 1)))
    tint = np.exp(0.10 * random.standard_normal((count, cars, 3)))
    colours = np.array([colour for _, colour in PAINTS])
    found[..., 1:4] = (colours[paint] * tone * tint).clip(0.015, 0.85)
    on = np.where(dark[:, None] > 0.0, 1.0, 0.15)
    found[..., 4] = random.random((count, cars)) < on
    flickers = random.random((count, cars)) < 0.4
    found[..., 5] = np.where(flickers, random.uniform(0.3, 4.7, (count, cars)), 0.0)
    return found
