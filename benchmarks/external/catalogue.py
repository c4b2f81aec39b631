"""The problems, where they are published, and how likely each fails; without pemviz."""

import importlib.util
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from benchmarks.external.motions import Motion
from benchmarks.external.mujoco_pole import HeldPole
from benchmarks.external.sequential import (
    HeldCartPole,
    LargestError,
    Pendulum,
    SensedPendulum,
    StartedCartPole,
    SumOfErrors,
    WalkBesidePattern,
    WetFloor,
)
from benchmarks.external.static import STATIC


@dataclass(frozen=True, kw_only=True)
class Published:
    """A failure probability that is known.

    Attributes:
        name: In tables.
        source: Where it is published.
        truth: How likely it fails.
        relative_error: Standard error of the truth as a share of it; 0 where it is exact.
        how: How it was found.
        needs: Modules that its simulator is of; those of :data:`REQUIREMENTS` install them.
    """

    name: str
    source: str
    truth: float
    relative_error: float = 0.0
    how: str
    needs: tuple[str, ...] = ()

    @property
    def missing(self) -> Sequence[str]:
        """Modules that it needs and that are not installed."""
        return [name for name in self.needs if importlib.util.find_spec(name) is None]


@dataclass(frozen=True, kw_only=True)
class Problem(Published):
    """One whose definition is given to others' programs too.

    Attributes:
        motion: What moves, and when it fails.
        twin: Whether pemviz is told that the simulator is fast, so that it may run through states.
    """

    motion: Motion
    twin: bool = False

    @property
    def spec(self) -> str:
        """That it does not fail, in signal temporal logic over the values shown."""
        return self.motion.spec

    @property
    def latents(self) -> int:
        """Standard normals at the start and at each step."""
        return self.motion.starts + self.motion.noises


REQUIREMENTS = "benchmarks/external/requirements.txt"
OTBENCHMARK = "openturns/otbenchmark"
PLANE = "quadrature over angles and columns"
TRUTHS: Mapping[str, tuple[str, float, float, str]] = {
    "four-branch": (OTBENCHMARK, 2.222795e-3, 0.0, PLANE),
    "four-branch, rarer": ("likewise, 4.5 for 3 and 9 for 7", 1.0771553e-5, 0.0, PLANE),
    "RP8": (OTBENCHMARK, 7.897944e-4, 0.0, "convolution"),
    "RP14": (OTBENCHMARK, 7.728521e-4, 0.0, "quadrature over four variables"),
    "RP22": (OTBENCHMARK, 4.207305e-3, 0.0, PLANE),
    "RP24": (OTBENCHMARK, 2.859998e-3, 0.0, PLANE),
    "RP25": (OTBENCHMARK, 4.148566e-5, 0.0, PLANE),
    "RP28": (OTBENCHMARK, 1.4532947e-7, 0.0, PLANE),
    "RP31": (OTBENCHMARK, 3.22681e-3, 0.0, PLANE),
    "RP33": (OTBENCHMARK, 2.5755978e-3, 0.0, "normal distribution of two variables"),
    "RP35": (OTBENCHMARK, 3.478946e-3, 0.0, PLANE),
    "RP38": (OTBENCHMARK, 8.043119e-3, 0.0018, "importance sampling, numpy alone"),
    "RP53": (OTBENCHMARK, 3.13205e-2, 0.0, PLANE),
    "RP54": (OTBENCHMARK, 9.9060307e-4, 0.0, "gamma distribution"),
    "RP55": (OTBENCHMARK, 0.5600144282863704, 0.0, "formula"),
    "RP57": (OTBENCHMARK, 2.82373e-2, 0.0, PLANE),
    "RP60": (OTBENCHMARK, 4.48396998e-2, 0.0, "quadrature over the load"),
    "RP63": (OTBENCHMARK, 3.769436118e-4, 0.0, "integral over chi-square"),
    "RP75": (OTBENCHMARK, 9.819298721546889e-3, 0.0, "integral of K0"),
    "RP77": (OTBENCHMARK, 2.690843985e-7, 0.0, "quadrature over x3"),
    "RP89": (OTBENCHMARK, 5.471280529e-3, 0.0, PLANE),
    "RP91": (OTBENCHMARK, 6.985839e-4, 0.002, "importance sampling, numpy alone"),
    "RP107": (OTBENCHMARK, 2.866515718791939e-7, 0.0, "formula"),
    "RP110": (OTBENCHMARK, 3.19578e-5, 0.0, PLANE),
    "RP111": (OTBENCHMARK, 8.035085964959766e-7, 0.0, "integral of K0"),
    "linear, 100": ("a plane 6 away", 9.865876450376946e-10, 0.0, "formula"),
    "two planes, 100": ("planes 4.5 and 5 away", 3.6843234e-6, 0.0, "formula"),
    "exponential sum, 100": (
        "170 - sum of unit exponentials",
        2.43007726e-9,
        0.0,
        "gamma distribution",
    ),
}
"""Of static problems: source, probability, its relative error, how it was found."""

CORSO = "Corso et al. 2022, arXiv 2211.12470"
TWO_SIDED = "issue 34: an error that may go either way"
CARTPOLE = "gymnasium's CartPole-v1, held values"
DISTURBANCES = (-1.0, -0.25, 0.0, 0.25, 1.0)
ODD_STEPS = (1, 3, 5, 7, 9, 11, 13)
WALKS = (
    ("0.42", 6, 3.211162618244415e-06),
    ("0.05", 7, 5.465226155800273e-06),
    ("0.005", 8, 1.3656077031629127e-05),
)
"""How much of the probability the walk shows, where it starts, and the probability."""
STARTED_CARTS = (
    (1.7, 0.005952, 0.0037, "12,000,000 plain rollouts"),
    (3.0, 2.043e-5, 0.015, "228,000,000 plain rollouts"),
)
CARTS = (
    (2.5, 0.7967425, 0.0008, "400,000 plain rollouts"),
    (4.0, 0.0165535, 0.00545, "2,000,000 plain rollouts"),
    (
        5.0,
        2.921834e-4,
        0.0099,
        "1,000,000 rollouts with a window of misses, weighed; 3,000,000 "
        "plain rollouts say 2.86e-4 +- 3.4 %",
    ),
    (
        6.0,
        3.144134e-6,
        0.0112,
        "2,000,000 rollouts with a window of misses, weighed; particles "
        "resampled at each step, 90 runs of 20,000, say 3.19e-6 +- 4 %",
    ),
)
"""Log-odds of a detection, the probability, its relative error, and how it was found."""

SEQUENTIAL: Sequence[Problem] = (
    Problem(
        name="pendulum",
        source=CORSO,
        motion=Pendulum(),
        truth=1.975e-5,
        relative_error=0.001,
        how="backwards over a grid of states; 150,000,000 plain rollouts say 1.938e-5 +- 1.9 %",
    ),
    Problem(
        name="pendulum, discrete",
        source=CORSO,
        motion=Pendulum(forces=DISTURBANCES, sd=0.4),
        truth=2.914e-5,
        relative_error=0.0185,
        how="100,000,000 plain rollouts",
    ),
    Problem(
        name="pendulum, noisy sensor",
        source="Stanford AA228V, project 2, medium",
        motion=SensedPendulum(),
        truth=8.1625e-3,
        relative_error=0.0039,
        how="8,000,000 plain rollouts",
    ),
    Problem(
        name="largest error, two-sided",
        source=TWO_SIDED,
        motion=LargestError(),
        truth=1.1465999e-5,
        how="formula",
    ),
    Problem(
        name="sum of errors, two-sided",
        source=TWO_SIDED,
        motion=SumOfErrors(),
        truth=6.795346249460121e-6,
        how="formula",
    ),
    *(
        Problem(
            name=f"{kind}, base {base:g}",
            source=CARTPOLE,
            motion=cart(base=base),
            truth=truth,
            relative_error=error,
            how=how,
        )
        for kind, cart, known in (
            ("CartPole", HeldCartPole, CARTS),
            ("CartPole, started anywhere", StartedCartPole, STARTED_CARTS),
        )
        for base, truth, error, how in known
    ),
    Problem(
        name="InvertedPendulum-v5",
        source="gymnasium[mujoco], held values",
        motion=HeldPole(),
        truth=0.023696,
        relative_error=0.0128,
        how="250,000 plain rollouts of MuJoCo's",
        needs=("mujoco",),
    ),
    Problem(
        name="robot, one wet floor in 1,000",
        source="a user's: what is rare at the start makes few misses enough",
        motion=WetFloor(),
        truth=2.256e-5,
        relative_error=0.0022,
        how="products of misses, averaged over 1,000,000 starts of each floor",
    ),
    *(
        Problem(
            name=f"walk beside a pattern, {share} of it{', with a twin' if twin else ''}",
            source="issue 34: a way of failing that nothing shows",
            motion=WalkBesidePattern(pattern=ODD_STEPS, first=first),
            truth=truth,
            how="recursion",
            twin=twin,
        )
        for share, first, truth in WALKS
        for twin in (False, True)
    ),
)


def problems() -> Sequence[Problem]:
    """All of them, static ones first."""
    static = [
        Problem(
            name=name,
            source=source,
            motion=STATIC[name],
            truth=truth,
            relative_error=error,
            how=how,
        )
        for name, (source, truth, error, how) in TRUTHS.items()
    ]
    return (*static, *SEQUENTIAL)


def named(name: str, every: Sequence[str]) -> AbstractSet[str]:
    """Of ``every`` problem's name those that are ``name``; where none is, those that begin so."""
    return {name} if name in every else {one for one in every if one.startswith(name)}
