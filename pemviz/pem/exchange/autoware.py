"""The noise parameters of scenario_simulator_v2 (TIER IV), the simulator beside Autoware.

Read and written is version 4 of the noise of /perception/object_recognition/detection/objects, the
newest of four, as the project's developer guide (Parameters) and its detection_sensor.cpp have it
in release 25.0.20. A configuration of it is for the entities whose type, subtype and name match:

- The first of ``ellipse_y_radii`` above the distance over the ground [m], from the ego's base_link
  to the nearest point of the entity's box, is the bin; beyond the last all values are 0. With
  ``ellipse_normalized_x_radius`` 1, the only one written and read, ellipses are circles.
- ``true_positive``: P(reported | before) = phi b + (1 - phi) rate, with b = 1 if the entity was
  reported before. That is pemviz's P(missed | before) = p + (m - p) rho, with phi = rho and
  rate = 1 - p. (The guide's matrix of it has one sign that its rows do not add up with.)
- ``position.y`` is along the line of sight, above 0 farther away, ``position.x`` across it, above 0
  to the right; both [m], added to the entity's place: e(t) = mean + phi (e(before) - mean) +
  standard_deviation sqrt(1 - phi^2) n, with n standard normal.
- phi = amplitude exp(-decay dt) + offset, dt [s] since the entity's frame before, within 0 and 1.
  Frames of any rate have the correlation exp(-h / tau) if amplitude is 1, offset 0 and decay
  1 / tau; any other form means another correlation at another frame rate.
- ``yaw`` [rad] and ``yaw_flip`` turn the box; pemviz fits no such errors.

The newer simulator begins each entity as reported, with noise 0, does not report it in its first
frame, and takes the scenario's seed. Parameters are typed: a list of whole numbers is refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError, one_line
from pemviz.files.atomic import is_file
from pemviz.files.yaml_text import parse_yaml, yaml_text
from pemviz.pem.exchange.averages import LONGEST_TAU_S, NARROWEST_M, Averages

NOISE_VERSION = 4
TOPIC = "/perception/object_recognition/detection/objects"
INTERFACE_VERSION = 20240605
"""Suffix of the architecture_type that the guide's own sample file is for."""
DETECTION_RANGE_M = 300.0
OF_TOPIC: Mapping[str, Any] = {"delay": 0.0, "range": DETECTION_RANGE_M, "occlusionless": False}
"""As written. Of the whole topic: how late, how far, and whether hidden ones are reported too."""
SMALLEST_P = 1e-12
"""No rate is nearer to 0 or 1: it would be one of these to the twelve decimals that are written."""
DECIMALS, DIGITS = 12, 6
LARGEST_BYTES = 1 << 18
"""A file with all parameters of the simulator has 20 kB."""
LARGEST_ERROR = 1e3
"""No mean or deviation is larger [m, rad]."""

Subtype = Literal["CAR", "TRUCK", "BUS", "TRAILER", "MOTORCYCLE", "BICYCLE", "PEDESTRIAN"]
SUBTYPES: Mapping[str, Subtype] = {
    "Car": "CAR",
    "Van": "CAR",
    "Truck": "TRUCK",
    "Pedestrian": "PEDESTRIAN",
    "Person_sitting": "PEDESTRIAN",
    "Cyclist": "BICYCLE",
}
"""The entities' subtype of each of KITTI's classes; a tram has none."""
HEAD = "Noise of scenario_simulator_v2, version 4, by 'pemviz pem export --format autoware'"
NOTED = ("model", "data", "licence", "averages", "position errors")
"""What lines of comment at the file's beginning say of where its values come from."""


@dataclass(frozen=True, eq=False)
class Axis:
    """Errors of a kind by bin: mean and standard deviation ``[B]``, and memory time [s]."""

    mean: FloatArray
    deviation: FloatArray
    tau_s: float


@dataclass(frozen=True, eq=False)
class Configuration:
    """One configuration of version 4.

    Attributes:
        name: Its name in the file.
        subtypes: Of the entities that it is for, perhaps with wildcards.
        radii_m: Where each bin ends ``[B]`` [m].
        rate: P(reported) ``[B]``.
        tau_s: Memory time of misses [s].
        along: Errors along the line of sight [m].
        across: Across it [m].
        other: Whose entities else, and what pemviz has no words for, in words.
    """

    name: str
    subtypes: tuple[str, ...]
    radii_m: FloatArray
    rate: FloatArray
    tau_s: float
    along: Axis
    across: Axis
    other: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class NoiseFile:
    """What a file says: its configurations, where its values come from, what else it changes."""

    configurations: tuple[Configuration, ...]
    notes: Mapping[str, str] = field(default_factory=dict[str, str])
    other: tuple[str, ...] = ()

    def named(self, name: str | None) -> Configuration:
        """A configuration by its name; the only one where none is given.

        Raises:
            PemError: There is none of that name, or several to choose from.
        """
        names = [one.name for one in self.configurations]
        if name is None and len(names) == 1:
            return self.configurations[0]
        if name not in names:
            given = "" if name is None else f"config is {name!r}: "
            raise PemError(f"{given}choose one of the file's configurations: {', '.join(names)}")
        return self.configurations[names.index(name)]


def configuration_of(averages: Averages, *, subtype: Subtype) -> Configuration:
    """The configuration that has a model's averages, to the digits that are written."""
    axes = {axis.name: axis for axis in averages.axes}
    none = np.zeros(len(averages.miss))

    def axis(name: str) -> Axis:
        if name not in axes:
            return Axis(none, none, 0.0)
        own = axes[name]
        mean, deviation = _rounded(own.mean), _rounded(own.deviation)
        return Axis(mean, deviation, own.tau_s if mean.any() or deviation.any() else 0.0)

    rate = (1.0 - _rounded(averages.miss)).clip(SMALLEST_P, 1.0 - SMALLEST_P).round(DECIMALS)
    return Configuration(
        name=subtype.lower(),
        subtypes=(subtype,),
        radii_m=np.array([high for _, high in averages.bins]),
        rate=rate,
        tau_s=averages.memory.tau_s,
        along=axis("range"),
        across=axis("cross_range"),
    )


def noise_yaml(file: NoiseFile) -> str:
    """The file's text: every parameter of version 4 that the guide lists."""
    objects: dict[str, Any] = {
        "version": INTERFACE_VERSION,
        "seed": 0,
        "override_legacy_configuration": True,
        **OF_TOPIC,
        "noise": {
            "model": {"version": NOISE_VERSION},
            "v4": {one.name: _parameters(one) for one in file.configurations},
        },
    }
    lines = [f"# {name}: {one_line(text)}" for name, text in file.notes.items()]
    body = yaml_text({"/**": {"ros__parameters": {TOPIC: objects}}}, innermost_in_line=True)
    return "\n".join([f"# {HEAD}", *lines, body])


def _parameters(one: Configuration) -> dict[str, Any]:
    def by_bin(values: FloatArray) -> dict[str, Any]:
        return {"ellipse_normalized_x_radius": 1.0, "values": values.tolist()}

    def error(axis: Axis) -> dict[str, Any]:
        return {
            "autocorrelation_coefficient": _autocorrelation(axis.tau_s),
            "mean": by_bin(axis.mean),
            "standard_deviation": by_bin(axis.deviation),
        }

    none = np.zeros(len(one.radii_m))
    return {
        "noise_application_entities": {
            "types": ["*"],
            "subtypes": list(one.subtypes),
            "names": ["*"],
        },
        "ellipse_y_radii": one.radii_m.tolist(),
        "position": {"x": error(one.across), "y": error(one.along)},
        "yaw": error(Axis(none, none, 0.0)),
        "yaw_flip": {
            "autocorrelation_coefficient": _autocorrelation(0.0),
            "speed_threshold": 0.1,
            "rate": 0.0,
        },
        "true_positive": {
            "autocorrelation_coefficient": _autocorrelation(one.tau_s),
            "rate": by_bin(one.rate),
        },
    }


def _autocorrelation(tau_s: float) -> dict[str, float]:
    if tau_s == 0.0:
        return {"amplitude": 0.0, "decay": 0.0, "offset": 0.0}
    return {"amplitude": 1.0, "decay": float(_rounded(np.array([1.0 / tau_s]))[0]), "offset": 0.0}


def _rounded(values: FloatArray) -> FloatArray:
    """Values ``[n]`` to DIGITS digits, and no finer than DECIMALS."""
    short = [float(f"{value:.{DIGITS}g}") for value in values.tolist()]
    return np.round(short, DECIMALS) + 0.0  # nor is any of them -0


def read_noise(path: Path, *, rate_hz: float | None = None) -> NoiseFile:
    """Read the noise of version 4 from a parameter file; other topics and versions are left alone.

    Args:
        path: The file.
        rate_hz: Frames a second for which correlations are taken that other than by exp(-h / tau)
            depend on the rate; ``None``: such a file is refused.

    Raises:
        PemError: The file is none of version 4, damaged, or says what pemviz cannot.
    """
    text = _text(path)
    try:
        return _noise(_parsed(text), notes=_notes(text), rate_hz=rate_hz)
    except PemError as error:
        raise PemError(f"{path}: {error}") from None


def _text(path: Path) -> str:
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES + 1)
        if len(content) > LARGEST_BYTES:
            raise PemError(f"{path}: over {LARGEST_BYTES >> 10} kB, no file of parameters")
        return content.decode("utf-8-sig")
    except OSError as error:
        raise PemError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise PemError(f"{path}: not UTF-8 text") from None


def _notes(text: str) -> dict[str, str]:
    """What the comments at the beginning say, where pemviz wrote them."""
    notes: dict[str, str] = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        name, _, words = line.removeprefix("#").strip().partition(": ")
        if name in NOTED:
            notes[name] = words
    return notes


def _parsed(text: str) -> Any:
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise PemError(str(error)) from None


@dataclass(frozen=True)
class _Part:
    """A table of a file, and where it stands."""

    values: Mapping[str, Any]
    where: str

    def at(self, name: str) -> str:
        return f"{self.where}.{name}" if self.where else name

    def value(self, name: str) -> Any:
        if name not in self.values:
            raise PemError(f"{self.at(name)} is missing")
        return self.values[name]

    def part(self, name: str, *, known: Sequence[str] = ()) -> "_Part":
        """A table in it, without names other than those known, where they are."""
        value = self.value(name)
        if not isinstance(value, dict):
            raise PemError(f"{self.at(name)} is {value!r}, must be a table")
        inner = cast(dict[Any, Any], value)
        unknown = [key for key in inner if not isinstance(key, str) or (known and key not in known)]
        if unknown:
            allowed = f", allowed: {', '.join(known)}" if known else ""
            raise PemError(f"{self.at(name)}: unknown {unknown[0]!r}{allowed}")
        return _Part(inner, self.at(name))

    def number(self, name: str, *, low: float, high: float) -> float:
        return _number(self.value(name), where=self.at(name), low=low, high=high)

    def numbers(self, name: str, *, low: float, high: float, count: int | None) -> FloatArray:
        values = self._list(name)
        if count is not None and len(values) != count:
            raise PemError(
                f"{self.at(name)} has {len(values)} values, need {count}, one for each of "
                "ellipse_y_radii"
            )
        where = self.at(name)
        numbers = [_number(one, where=where, low=low, high=high) for one in values]
        return np.array(numbers, dtype=np.float64)

    def texts(self, name: str) -> tuple[str, ...]:
        values = self._list(name)
        if not all(isinstance(one, str) for one in values):
            raise PemError(f"{self.at(name)} must be a list of words")
        return tuple(values)

    def _list(self, name: str) -> list[Any]:
        values = self.value(name)
        if not isinstance(values, list) or not values:
            raise PemError(f"{self.at(name)} is {values!r}, must be a list with values")
        return cast(list[Any], values)


def _number(value: object, *, where: str, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PemError(f"{where} is {value!r}, must be a number")
    if not low <= value <= high:  # nor is what is no number
        raise PemError(f"{where} is {float(value):g}, allowed: {low:g} to {high:g}")
    return float(value)


def _noise(document: Any, *, notes: Mapping[str, str], rate_hz: float | None) -> NoiseFile:
    whole = _Part(document if isinstance(document, dict) else {}, "")
    if "/**" not in whole.values:
        raise PemError("no file of ROS 2 parameters: '/**' is missing")
    topic = whole.part("/**").part("ros__parameters").part(TOPIC)
    noise = _Part(topic.part("noise").values, "noise")
    version = noise.part("model").value("version")
    if version != NOISE_VERSION:
        raise PemError(f"noise.model.version is {version!r}, this reads version {NOISE_VERSION}")
    named = noise.part("v4")
    if not named.values:
        raise PemError("noise.v4 has no configuration")
    return NoiseFile(
        tuple(_configuration(named, name, rate_hz=rate_hz) for name in named.values),
        notes,
        tuple(
            f"{name} {topic.values[name]!r} of the topic"
            for name, written in OF_TOPIC.items()
            if topic.values.get(name, written) != written
        ),
    )


PARTS = (
    *("noise_application_entities", "ellipse_y_radii", "position", "yaw", "yaw_flip"),
    "true_positive",
)
ERROR_PARTS = ("autocorrelation_coefficient", "mean", "standard_deviation")


def _configuration(named: _Part, name: str, *, rate_hz: float | None) -> Configuration:
    one = named.part(name, known=PARTS)
    entities = one.part("noise_application_entities", known=("types", "subtypes", "names"))
    radii_m = one.numbers("ellipse_y_radii", low=0.0, high=1e6, count=None)
    if (np.diff(radii_m, prepend=0.0) < NARROWEST_M).any():
        raise PemError(
            f"{one.at('ellipse_y_radii')} must increase from 0 on, by {NARROWEST_M:g} m at least: "
            "ranges overlap"
        )
    count, position = len(radii_m), one.part("position", known=("x", "y"))
    found = one.part("true_positive", known=("autocorrelation_coefficient", "rate"))
    rate = _by_bin(found, "rate", low=0.0, high=1.0, count=count)
    if not ((rate > 0.0) & (rate < 1.0)).all():
        raise PemError(
            f"{found.at('rate.values')} must lie strictly between 0 and 1: write 0.999999 where "
            "hardly anything is missed"
        )
    yaw = _errors(one, "yaw", count=count, rate_hz=rate_hz)
    flip = one.part("yaw_flip", known=("autocorrelation_coefficient", "speed_threshold", "rate"))
    turned = {
        "yaw": float(np.abs(np.append(yaw.mean, yaw.deviation)).max()),
        "yaw_flip.rate": flip.number("rate", low=0.0, high=1.0),
    }
    others = {field: entities.texts(field) for field in ("types", "names")}
    return Configuration(
        name=name,
        subtypes=entities.texts("subtypes"),
        radii_m=radii_m,
        rate=rate,
        tau_s=_memory_time(found, rate_hz=rate_hz),
        along=_errors(position, "y", count=count, rate_hz=rate_hz),
        across=_errors(position, "x", count=count, rate_hz=rate_hz),
        other=(
            *(f"{key} up to {size:g}" for key, size in turned.items() if size),
            *(f"only {key} {', '.join(only)}" for key, only in others.items() if only != ("*",)),
        ),
    )


def _errors(within: _Part, name: str, *, count: int, rate_hz: float | None) -> Axis:
    part = within.part(name, known=ERROR_PARTS)
    largest = LARGEST_ERROR
    return Axis(
        mean=_by_bin(part, "mean", low=-largest, high=largest, count=count),
        deviation=_by_bin(part, "standard_deviation", low=0.0, high=largest, count=count),
        tau_s=_memory_time(part, rate_hz=rate_hz),
    )


def _by_bin(within: _Part, name: str, *, low: float, high: float, count: int) -> FloatArray:
    part = within.part(name, known=("ellipse_normalized_x_radius", "values"))
    ratio = part.number("ellipse_normalized_x_radius", low=-1e6, high=1e6)
    if ratio != 1.0:
        where = part.at("ellipse_normalized_x_radius")
        raise PemError(f"{where} is {ratio:g}: pemviz's tables are by range, which is 1")
    return part.numbers("values", low=low, high=high, count=count)


def _memory_time(within: _Part, *, rate_hz: float | None) -> float:
    """Memory time tau [s] of an autocorrelation coefficient."""
    known = ("amplitude", "decay", "offset")
    part = within.part("autocorrelation_coefficient", known=known)
    amplitude, offset = (part.number(name, low=0.0, high=1.0) for name in ("amplitude", "offset"))
    decay = part.number("decay", low=0.0, high=1e9)
    if amplitude == 0.0 and offset == 0.0:
        return 0.0
    if (amplitude, offset) != (1.0, 0.0) or decay == 0.0:
        if rate_hz is None:
            raise PemError(
                f"{part.where}: amplitude {amplitude:g}, decay {decay:g}, offset {offset:g} give "
                "another correlation at another frame rate: give the simulator's rate (--rate-hz)"
            )
        phi = min(amplitude * float(np.exp(-decay / rate_hz)) + offset, 1.0)
        if phi == 0.0:
            return 0.0
        decay = -rate_hz * float(np.log(phi))
    if decay * LONGEST_TAU_S < 1.0:
        raise PemError(f"{part.where}: a memory time above {LONGEST_TAU_S:g} s, or none that ends")
    return 1.0 / decay
