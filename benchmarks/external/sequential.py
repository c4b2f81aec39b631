"""Problems that move: two pendulums and a noisier one, carts, errors and walks.

Where their definitions come from: :mod:`benchmarks.external.catalogue`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from benchmarks.external.held import HeldState
from benchmarks.external.motions import SURE, Flags, Numbers, Values

QUARTER_PI = np.pi / 4.0


@dataclass(frozen=True, kw_only=True)
class Pendulum:
    """An inverted pendulum, 1 kg and 1 m, whose torque is disturbed (Corso et al. 2022).

    Attributes:
        forces: Values of the disturbance; none: it is normal.
        sd: Its standard deviation; with values, they are weighed by the normal density.
    """

    forces: Sequence[float] = ()
    sd: float = 0.3
    starts: int = 2
    noises: int = 1
    misses: bool = False
    steps: int = 19

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The angle from upright [rad], and its rate [rad/s]."""
        return {"angle": (-2.0, 2.0), "rate": (-8.0, 8.0)}

    @property
    def spec(self) -> str:
        """Within a quarter of pi to both sides."""
        return within_quarter(self.steps)

    def begin(self, start: Numbers) -> Values:
        """Uniform within 10 degrees, and 0.1 rad/s."""
        ten_degrees = np.deg2rad(10.0)
        share = 2.0 * ndtr(start) - 1.0
        return {"angle": ten_degrees * share[:, 0], "rate": 0.1 * share[:, 1]}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """0.1 s on."""
        return swung(values, self.control(values) + self.disturbance(noise[:, 0]), dt_s=0.1)

    def control(self, values: Values) -> Numbers:
        """The torque of the controller, which is within +-2."""
        angle, rate = values["angle"], values["rate"]
        wanted = np.sign(angle) * np.sqrt(60.0 * (1.0 - np.cos(angle)))
        return np.clip(-2.0 * rate - (wanted - rate), -2.0, 2.0)

    def disturbance(self, noise: Numbers) -> Numbers:
        """Standard normals as disturbances ``[N]``."""
        if not self.forces:
            return self.sd * noise
        upto = np.cumsum(self.weights)[:-1]
        return np.asarray(self.forces)[np.searchsorted(upto, ndtr(noise), side="right")]

    @property
    def weights(self) -> Numbers:
        """How likely each of the forces is."""
        density = np.exp(-0.5 * (np.asarray(self.forces) / self.sd) ** 2)
        return density / density.sum()

    def logit(self, values: Values) -> Numbers:
        """Detected, to no effect."""
        return np.full(np.shape(values["angle"]), SURE)

    def margin(self, values: Values) -> Numbers:
        """Angle that is left [rad]."""
        return QUARTER_PI - np.abs(values["angle"])


@dataclass(frozen=True, kw_only=True)
class SensedPendulum(Pendulum):
    """A pendulum whose angle and rate are measured with errors (Stanford AA228V, project 2)."""

    noises: int = 2
    steps: int = 40

    def begin(self, start: Numbers) -> Values:
        """Normal around upright and at rest."""
        return {"angle": np.pi / 32.0 * start[:, 0], "rate": 0.5 * start[:, 1]}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """0.05 s on."""
        angle, rate = values["angle"] + 0.1 * noise[:, 0], values["rate"] + 0.1 * noise[:, 1]
        return swung(values, np.clip(-15.0 * angle - 8.0 * rate, -2.0, 2.0), dt_s=0.05)


def swung(values: Values, torque: Numbers, *, dt_s: float) -> Values:
    """A pendulum's angle and rate a time step on."""
    angle, rate = values["angle"], values["rate"]
    rate = rate + (15.0 * np.sin(angle) + 3.0 * torque) * dt_s
    return {"angle": angle + dt_s * rate, "rate": np.clip(rate, -8.0, 8.0)}


def within_quarter(steps: int) -> str:
    """That a pendulum does not fall over."""
    limit = float(QUARTER_PI)
    return f"always[0,{steps}] (angle <= {limit!r} and angle >= {-limit!r})"


@dataclass(frozen=True, kw_only=True)
class LargestError:
    """Fails where an error that may go either way is at one step larger than a limit.

    Attributes:
        limit: In standard deviations.
    """

    limit: float = 5.0
    starts: int = 0
    noises: int = 1
    misses: bool = False
    steps: int = 20

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The largest so far."""
        return {"largest": (0.0, 8.0)}

    @property
    def spec(self) -> str:
        """It is never above the limit."""
        return f"always[0,{self.steps}] (largest <= {self.limit!r})"

    def begin(self, start: Numbers) -> Values:
        """No error yet."""
        return {"largest": np.zeros(len(start))}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """With the error of a step."""
        return {"largest": np.maximum(values["largest"], np.abs(noise[:, 0]))}

    def logit(self, values: Values) -> Numbers:
        """Detected, to no effect."""
        return np.full(np.shape(values["largest"]), SURE)

    def margin(self, values: Values) -> Numbers:
        """What is left to the limit."""
        return self.limit - values["largest"]


@dataclass(frozen=True, kw_only=True)
class SumOfErrors:
    """Fails where the sum of all steps' errors is at the end beyond a limit on either side.

    Attributes:
        limit: In standard deviations of the sum.
    """

    limit: float = 4.5
    starts: int = 0
    noises: int = 1
    misses: bool = False
    steps: int = 20

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The sum, in its standard deviations at the end."""
        return {"total": (-8.0, 8.0)}

    @property
    def spec(self) -> str:
        """It is within the limits at the end."""
        end = self.steps
        return f"always[{end},{end}] (total <= {self.limit!r} and total >= {-self.limit!r})"

    def begin(self, start: Numbers) -> Values:
        """No error yet."""
        return {"total": np.zeros(len(start)), "at_end": np.zeros(len(start), dtype=np.bool_)}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """With the error of a step."""
        total = values["total"] + noise[:, 0] / np.sqrt(self.steps)
        return {"total": total, "at_end": np.full(len(total), step == self.steps - 1)}

    def logit(self, values: Values) -> Numbers:
        """Detected, to no effect."""
        return np.full(np.shape(values["total"]), SURE)

    def margin(self, values: Values) -> Numbers:
        """What is left to the limits; before the end nothing fails."""
        left = self.limit - np.abs(values["total"])
        return np.where(values["at_end"], left, np.inf)


CART_RANGES = {"x": (-3.0, 3.0), "xd": (-3.0, 3.0), "th": (-0.3, 0.3), "thd": (-3.0, 3.0)}
CART_START = (-0.0409, -0.0249, 0.0301, 0.0082)
RAIL, LEAN = 2.4, 0.2095


@dataclass(frozen=True, kw_only=True)
class HeldCartPole(HeldState):
    """CartPole-v1 of gymnasium's, 0.02 s a step, whose controller goes by what was detected."""

    base: float = 4.0
    slope: float = 3.0
    steps: int = 200
    ranges = CART_RANGES
    first = CART_START
    gains = (0.35, 0.6, 8.0, 1.6)

    def later(self, values: Values, wanted: Numbers) -> Values:
        """By Euler's method, pushed with 10 N either way."""
        return pushed(values, np.where(wanted > 0.0, 10.0, -10.0))

    def room(self, state: Values) -> Numbers:
        """To the ends of the rail, and to the lean that ends an episode."""
        return np.minimum(1.0 - np.abs(state["x"]) / RAIL, 1.0 - np.abs(state["th"]) / LEAN)


@dataclass(frozen=True, kw_only=True)
class StartedCartPole(HeldCartPole):
    """The same cart from a start of its own in each rollout, of whose state little is shown.

    As a user wrote it: the detector sees the lean, and the proposals where the cart is, how the
    pole leans, and how fast it turns. What is held, and how fast the cart is, nobody sees.
    """

    slope: float = 8.0
    steps: int = 100
    starts: int = 4
    limit: float = 0.209
    gains = (0.2, 0.6, 6.0, 1.2)

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """Three of its state's four numbers."""
        return {name: CART_RANGES[name] for name in ("x", "th", "thd")}

    @property
    def spec(self) -> str:
        """The lean is within its limits."""
        return f"always[0,{self.steps}] (th <= {self.limit!r} and th >= {-self.limit!r})"

    def begin(self, start: Numbers) -> Values:
        """All four uniform within 0.05; that state is held."""
        each = 0.1 * ndtr(start) - 0.05
        state = dict(zip(self.ranges, each.T, strict=True))
        return self._with_errors(state, {f"held_{name}": value for name, value in state.items()})

    def logit(self, values: Values) -> Numbers:
        """The more the pole leans, the less is detected."""
        return self.base - self.slope * np.abs(values["th"])

    def margin(self, values: Values) -> Numbers:
        """What is left to the limit."""
        return self.limit - np.abs(values["th"])


def pushed(values: Values, force: Numbers) -> Values:
    """A cart of 1 kg with a pole of 0.1 kg and 2 x 0.5 m, 0.02 s on (Barto et al. 1983)."""
    angle, rate = values["th"], values["thd"]
    sine, cosine = np.sin(angle), np.cos(angle)
    push = (force + 0.05 * rate**2 * sine) / 1.1
    turn = (9.8 * sine - cosine * push) / (0.5 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1))
    speed_up = push - 0.05 * turn * cosine / 1.1
    return {
        "x": values["x"] + 0.02 * values["xd"],
        "xd": values["xd"] + 0.02 * speed_up,
        "th": angle + 0.02 * rate,
        "thd": rate + 0.02 * turn,
    }


@dataclass(frozen=True, kw_only=True)
class WetFloor:
    """A robot nears a person who stands, and brakes for good once it sees; some floors are wet.

    There it slides, and half of the misses are enough. Exploration proposals meet a wet floor with
    more misses than it needs, or not at all.

    Attributes:
        wet_above: Standard deviations of a random number above which the floor is wet.
    """

    wet_above: float = 3.0902
    starts: int = 3
    noises: int = 0
    misses: bool = True
    steps: int = 40

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """All of its state but whether it brakes."""
        return {"gap": (-50.0, 50.0), "speed": (0.0, 5.0), "grip": (0.0, 3.0)}

    @property
    def spec(self) -> str:
        """It stops before the person."""
        return f"always[0,{self.steps}] (gap >= 0)"

    def begin(self, start: Numbers) -> Values:
        """2 +- 0.15 m/s at 10 m, within a tenth; brakes reach 1.5 m/s^2, on a wet floor 0.35."""
        wet = start[:, 2] > self.wet_above
        return {
            "gap": 10.0 * np.exp(0.1 * start[:, 1]),
            "speed": 2.0 + 0.15 * start[:, 0],
            "grip": np.where(wet, 0.35, 1.5 + 1e-4 * start[:, 2]),
            "brakes": np.zeros(len(start), dtype=np.bool_),
        }

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """0.25 s on."""
        brakes = values["brakes"] | detected
        slower = 0.25 * np.where(brakes, values["grip"], 0.0)
        speed = np.maximum(values["speed"] - slower, 0.0)
        gap = values["gap"] - 0.25 * speed
        return {"gap": gap, "speed": speed, "grip": values["grip"], "brakes": brakes}

    def logit(self, values: Values) -> Numbers:
        """The nearer, the likelier it sees."""
        return 1.2 - 0.2 * values["gap"]

    def margin(self, values: Values) -> Numbers:
        """What is left of the gap."""
        return values["gap"]


@dataclass(frozen=True, kw_only=True)
class WalkBesidePattern:
    """A walk that misses lead to 0, beside a pattern of misses that nothing shows before the end.

    Attributes:
        pattern: If all of these steps are missed, the gap is 0 at the last state.
        first: Where the walk starts; detections lead it up again, at most two above that.
        at_zero: Log-odds of a detection at a gap of 0.
        slope: Their change with the gap.
    """

    pattern: tuple[int, ...]
    first: int
    at_zero: float = 3.0
    slope: float = -0.2
    starts: int = 0
    noises: int = 0
    misses: bool = True
    steps: int = 18

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The gap alone."""
        return {"gap": (-30.0, self.first + 2.0)}

    @property
    def spec(self) -> str:
        """It never arrives at 0."""
        return f"always[0,{self.steps}] (gap >= 0.5)"

    def begin(self, start: Numbers) -> Values:
        """At the start, with nothing detected of the pattern."""
        count = len(start)
        return {"gap": np.full(count, float(self.first)), "unseen": np.ones(count, dtype=np.bool_)}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """One nearer where missed, one away where detected."""
        gap = np.minimum(values["gap"] + np.where(detected, 1.0, -1.0), self.first + 2.0)
        unseen = values["unseen"]
        if step in self.pattern:
            unseen = unseen & ~detected
        if step == self.steps - 1:
            gap = np.where(unseen, 0.0, gap)
        return {"gap": gap, "unseen": unseen}

    def logit(self, values: Values) -> Numbers:
        """Linear in the gap."""
        return self.at_zero + self.slope * values["gap"]

    def margin(self, values: Values) -> Numbers:
        """The gap, less what rounding may do to it."""
        return values["gap"] - 0.5
