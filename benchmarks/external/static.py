"""Published static problems: functions of standard normals that fail below 0.

Names RP are of Rozsas and Slobbe's reliability challenge, as openturns/otbenchmark has them; the
others are named in :mod:`benchmarks.external.catalogue`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import log_ndtr, ndtr

from benchmarks.external.motions import LimitFunction, LimitState, Numbers

ROOT_2 = np.sqrt(2.0)


def normals(x: Numbers, means: Sequence[float], sds: Sequence[float]) -> Sequence[Numbers]:
    """Columns of standard normals ``[N, D]`` as normals with means and standard deviations."""
    return list((np.asarray(means) + np.asarray(sds) * x).T)


def log_normals(x: Numbers, means: Sequence[float], sds: Sequence[float]) -> Sequence[Numbers]:
    """The same as log-normals with these means and standard deviations."""
    mean, sd = np.asarray(means), np.asarray(sds)
    spread = np.sqrt(np.log1p((sd / mean) ** 2))
    return list(np.exp(np.log(mean) - 0.5 * spread**2 + spread * x).T)


def exponentials(x: Numbers) -> Numbers:
    """Standard normals as exponentials of mean 1."""
    return -log_ndtr(-x)


def uniforms(x: Numbers, low: float, high: float) -> Numbers:
    """Standard normals as uniform between two ends."""
    return low + (high - low) * ndtr(x)


def _four_branches(x: Numbers, near: float, far: float) -> Numbers:
    difference, total = x[:, 0] - x[:, 1], (x[:, 0] + x[:, 1]) / ROOT_2
    along = near + 0.1 * difference**2 - np.abs(total)
    return np.minimum(along, far / ROOT_2 - np.abs(difference))


def _rp8(x: Numbers) -> Numbers:
    a, b, c, d, e, f = log_normals(x, [120, 120, 120, 120, 50, 40], [12, 12, 12, 12, 10, 8])
    return a + 2 * b + 2 * c + d - 5 * e - 5 * f


def _rp14(x: Numbers) -> Numbers:
    yield_stress = uniforms(x[:, 0], 70.0, 80.0)
    scale = 350.0 * np.sqrt(6.0) / np.pi
    force = 1500.0 - np.euler_gamma * scale - scale * np.log(-log_ndtr(x[:, 2]))  # Gumbel
    width, length = 39.0 + 0.1 * x[:, 1], 400.0 + 0.1 * x[:, 3]
    torque = 250_000.0 + 35_000.0 * x[:, 4]
    stress = np.sqrt((force * length) ** 2 / 16.0 + torque**2)
    return yield_stress - 32.0 / (np.pi * width**3) * stress


def _rp22(x: Numbers) -> Numbers:
    return 2.5 - (x[:, 0] + x[:, 1]) / ROOT_2 + 0.1 * (x[:, 0] - x[:, 1]) ** 2


def _rp24(x: Numbers) -> Numbers:
    a, b = normals(x, [10, 10], [3, 3])
    return 2.5 - 0.2357 * (a - b) + 0.00463 * (a + b - 20.0) ** 4


def _rp25(x: Numbers) -> Numbers:
    a, b = x.T
    return np.maximum(a**2 - 8 * b + 16, -16 * a + b + 32)


def _rp28(x: Numbers) -> Numbers:
    a, b = normals(x, [78_064, 0.0104], [11_710, 0.00156])
    return a * b - 146.14


def _rp31(x: Numbers) -> Numbers:
    return 2.0 - x[:, 1] + 256.0 * x[:, 0] ** 4


def _rp33(x: Numbers) -> Numbers:
    return np.minimum(3.0 * np.sqrt(3.0) - x.sum(axis=1), 3.0 - x[:, 2])


def _rp35(x: Numbers) -> Numbers:
    a, b = x.T
    return np.minimum(2.0 - b + np.exp(-0.1 * a**2) + (0.2 * a) ** 4, 4.5 - a * b)


def _rp38(x: Numbers) -> Numbers:
    means = [350, 50.8, 3.81, 173, 9.38, 33.1, 0.036]
    a, b, c, d, e, f, g = normals(x, means, [0.1 * mean for mean in means])
    above = d**2 - 4 * e * f * g**2 + d * (f + 4 * e + 2 * f * g)
    return 15.59e4 - a * b**3 / (2 * c**3) * above / (d * e * (d + f + 2 * f * g))


def _rp53(x: Numbers) -> Numbers:
    a, b = normals(x, [1.5, 2.5], [1, 1])
    return np.sin(2.5 * a) + 2.0 - (a**2 + 4.0) * (b - 1.0) / 20.0


def _rp54(x: Numbers) -> Numbers:
    return exponentials(x).sum(axis=1) - 8.951


def _rp55(x: Numbers) -> Numbers:
    apart = np.abs(uniforms(x[:, 0], -1.0, 1.0) - uniforms(x[:, 1], -1.0, 1.0))
    return np.minimum(0.2 + 0.6 * apart**4 - apart / ROOT_2, 5.0 / ROOT_2 - 2.2 - apart)


def _rp57(x: Numbers) -> Numbers:
    a, b = x.T
    either = np.maximum(-(a**2) + b**3 + 3.0, 2.0 - a - 8.0 * b)
    return np.minimum(either, (a + 3.0) ** 2 + (b + 3.0) ** 2 - 4.0)


def _rp60(x: Numbers) -> Numbers:
    a, b, c, d, load = log_normals(x, [2200, 2100, 2300, 2000, 1200], [220, 210, 230, 200, 480])
    whole = np.minimum.reduce([b, c, d]) - load / 2.0
    broken = np.maximum(d, np.minimum(b, c)) - load
    return np.minimum(a - load, np.maximum(whole, broken))


def _rp63(x: Numbers) -> Numbers:
    return 0.1 * (x[:, 1:] ** 2).sum(axis=1) - x[:, 0] - 4.5


def _rp75(x: Numbers) -> Numbers:
    return 3.0 - x[:, 0] * x[:, 1]


def _rp77(x: Numbers) -> Numbers:
    a, b, c = normals(x, [10, 0, 4], [0.5, 1, 1])
    return np.where(c <= 5.0, a - b - c, c - b)


def _rp89(x: Numbers) -> Numbers:
    a, b = x.T
    return np.minimum(8.0 - a**2 - b, 6.0 - a / 5.0 - b)


def _rp91(x: Numbers) -> Numbers:
    means, sds = [0.07433, 0.1, 13.0, 4751.0, -684.0], [0.005, 0.01, 60.0, 48.0, 11.0]
    strength, b, c, d, e = normals(x, means, sds)
    buckling = 0.847 + 0.96 * b + 0.986 * c - 0.216 * d + 0.077 * b**2 + 0.11 * c**2
    buckling += 7.0 / 378.0 * d**2 - c * b - 0.106 * b * d - 0.11 * c * d
    mises = 84_000.0 * strength / np.sqrt(c**2 + d**2 - c * d + 3.0 * e**2) - 1.0
    return np.minimum.reduce([buckling, mises, 84_000.0 * strength / np.abs(d) - 1.0])


def _rp110(x: Numbers) -> Numbers:
    a, b = x.T
    one = np.where(a <= 3.5, 0.85 - 0.1 * a, 4.0 - a)
    return np.minimum(one, np.where(b <= 2.0, 2.3 - b, 0.5 - 0.1 * b))


def _rp111(x: Numbers) -> Numbers:
    return 12.5 - np.abs(x[:, 0] * x[:, 1])


def _linear(beta: float, count: int) -> LimitState:
    return LimitState(function=lambda x: beta * np.sqrt(count) - x.sum(axis=1), starts=count)


def _two_planes(x: Numbers) -> Numbers:
    signs = np.where(np.arange(x.shape[1]) % 2 == 0, 1.0, -1.0)
    root = np.sqrt(x.shape[1])
    return np.minimum(4.5 - x.sum(axis=1) / root, 5.0 + x @ signs / root)


def _exponential_sum(x: Numbers) -> Numbers:
    return 170.0 - exponentials(x).sum(axis=1)


def _of(function: LimitFunction, count: int) -> LimitState:
    return LimitState(function=function, starts=count)


STATIC: Mapping[str, LimitState] = {
    "four-branch": _of(lambda x: _four_branches(x, 3.0, 7.0), 2),
    "four-branch, rarer": _of(lambda x: _four_branches(x, 4.5, 9.0), 2),
    "RP8": _of(_rp8, 6),
    "RP14": _of(_rp14, 5),
    "RP22": _of(_rp22, 2),
    "RP24": _of(_rp24, 2),
    "RP25": _of(_rp25, 2),
    "RP28": _of(_rp28, 2),
    "RP31": _of(_rp31, 2),
    "RP33": _of(_rp33, 3),
    "RP35": _of(_rp35, 2),
    "RP38": _of(_rp38, 7),
    "RP53": _of(_rp53, 2),
    "RP54": _of(_rp54, 20),
    "RP55": _of(_rp55, 2),
    "RP57": _of(_rp57, 2),
    "RP60": _of(_rp60, 5),
    "RP63": _of(_rp63, 100),
    "RP75": _of(_rp75, 2),
    "RP77": _of(_rp77, 3),
    "RP89": _of(_rp89, 2),
    "RP91": _of(_rp91, 5),
    "RP107": _linear(5.0, 10),
    "RP110": _of(_rp110, 2),
    "RP111": _of(_rp111, 2),
    "linear, 100": _linear(6.0, 100),
    "two planes, 100": _of(_two_planes, 100),
    "exponential sum, 100": _of(_exponential_sum, 100),
}
"""By name; each takes standard normals alone."""
