"""The noise of scenario_simulator_v2, version 4, written from its guide: a law a line.

Of many equal entities at once, each at one place for all its frames. The parameters are those of
one configuration, as YAML gives them.
"""

import math

import numpy as np


def phi(parameters, dt_s):
    """Autocorrelation coefficient of a frame on."""
    own = parameters["autocorrelation_coefficient"]
    value = own["amplitude"] * math.exp(-own["decay"] * dt_s) + own["offset"]
    return min(max(value, 0.0), 1.0)


def chosen(configuration, parameters, *, x_m, y_m):
    """The value of the first ellipse around the place; 0 beyond all."""
    distance_m = math.hypot(x_m / parameters["ellipse_normalized_x_radius"], y_m)
    pairs = zip(configuration["ellipse_y_radii"], parameters["values"], strict=True)
    return next((value for radius_m, value in pairs if distance_m < radius_m), 0.0)


def courses(configuration, *, x_m, y_m, dt_s, frames, entities, random):
    """Which frames are reported, and errors along and across the line of sight ``[frames, n]``."""

    def own(parameters):
        return chosen(configuration, parameters, x_m=x_m, y_m=y_m)

    found, position = configuration["true_positive"], configuration["position"]
    rate, keep = own(found["rate"]), phi(found, dt_s)
    reported, errors = np.ones(entities, dtype=bool), {"x": np.zeros(entities)}
    errors["y"] = np.zeros(entities)
    course = []
    for _ in range(frames):
        reported = random.random(entities) < keep * reported + (1.0 - keep) * rate
        for axis, parameters in position.items():
            mean, sd = own(parameters["mean"]), own(parameters["standard_deviation"])
            stays = phi(parameters, dt_s)
            fresh = random.standard_normal(entities) * math.sqrt(1.0 - stays**2) * sd
            errors[axis] = mean + stays * (errors[axis] - mean) + fresh
        course.append((reported, errors["y"], errors["x"]))
    return tuple(np.array(values) for values in zip(*course, strict=True))


OF_TOPIC = (
    *("version", "seed", "override_legacy_configuration", "delay", "range", "occlusionless"),
    "noise.model.version",
)
OF_AN_ERROR = (
    *("mean.ellipse_normalized_x_radius", "mean.values"),
    *("standard_deviation.ellipse_normalized_x_radius", "standard_deviation.values"),
    "autocorrelation_coefficient.amplitude",
    "autocorrelation_coefficient.decay",
    "autocorrelation_coefficient.offset",
)
CONFIGURATION = (
    *(f"noise_application_entities.{name}" for name in ("types", "subtypes", "names")),
    "ellipse_y_radii",
    *(f"{error}.{name}" for error in ("position.x", "position.y", "yaw") for name in OF_AN_ERROR),
    *(f"yaw_flip.{name}" for name in (*OF_AN_ERROR[-3:], "rate", "speed_threshold")),
    *("true_positive.rate.ellipse_normalized_x_radius", "true_positive.rate.values"),
    *(f"true_positive.{name}" for name in OF_AN_ERROR[-3:]),
)
DOCUMENTED = (*OF_TOPIC, *(f"noise.v4.NAME.{name}" for name in CONFIGURATION))
"""Every parameter of the topic that version 4 of the noise reads, as the guide lists them."""
