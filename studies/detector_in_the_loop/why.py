"""Why a prediction is off: how often, and how together, the frames that decide are missed.

A setting of the braking scenario is lost when the car is missed in every frame of a window. Along
the course that the ego takes while it misses, the same in every rollout, all frames of the window
are looked at: N scenes give outcomes ``[N, W]``. From these come, frame by frame, how often it is
missed, and how likely all are missed; beside that stands what the error model says of both, and
what normal latents give that have the outcomes' own P(missed) and pairwise correlations: the best
that any law of a normal visibility could.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import root_scalar
from scipy.special import logit, ndtri
from scipy.stats import multivariate_normal

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem.models.memory import VisibilityNodes, log_sums, persistence, remembered_outcomes
from pemviz.pem.models.protocol import Pem
from pemviz.pem.models.varying_frailty import VaryingFrailty, VaryingNodes
from studies.detector_in_the_loop.drives import DT_S
from studies.detector_in_the_loop.loop import Loop, with_traffic
from studies.detector_in_the_loop.scene import Scenes
from studies.detector_in_the_loop.worlds import BrakingWorld

LOOSEST, TIGHTEST = -0.99, 0.999
"""Correlations of normal latents."""


@dataclass(frozen=True)
class Window:
    """Outcomes of the frames that decide.

    Attributes:
        gap_m: At each frame ``[W]``.
        missed: Whether each was missed ``[N, W]``.
    """

    gap_m: FloatArray
    missed: BoolArray

    @property
    def shares(self) -> FloatArray:
        """How often each frame is missed ``[W]``."""
        return self.missed.mean(axis=0)

    @property
    def all_missed(self) -> float:
        """How often all of them are."""
        return float(self.missed.all(axis=1).mean())


def decisive_window(loop: Loop, scenes: Scenes) -> Window:
    """The frames from the first that matters to the last that can still save the ego."""
    world = loop.world
    assert isinstance(world, BrakingWorld)  # noqa: S101  only there is the course one
    set_mps, one = world.simulator.config.initial_speed_mps, world.begin(np.zeros((1, 0)))
    travelled_m, gaps, missed = 0.0, list[float](), list[BoolArray]()
    count, blind = scenes.count, np.zeros((1, 1), dtype=np.bool_)
    for step in range(world.simulator.states - 1):
        if loop.matters(one)[0]:
            if not loop.undecided(one)[0]:
                break
            poses = with_traffic(
                scenes,
                world.poses(one).repeat(count, axis=0),
                np.full(count, travelled_m),
                set_mps=np.full(count, set_mps),
                step=step,
            )
            hits = loop.look(scenes, poses, np.full(count, travelled_m), step=step)
            missed.append(~hits[:, 0])
            gaps.append(float(one.signals["gap"][0]))
        travelled_m += float(world.ego_mps(one.signals)[0]) * DT_S
        one = world.step(one, blind)
    return Window(np.array(gaps), np.stack(missed, axis=1))


def model_shares(loop: Loop, window: Window, pem: Pem) -> FloatArray:
    """P(missed) of the model at the window's frames ``[W]``."""
    salient = loop.world.simulator.salient({"gap": window.gap_m})
    return 1.0 / (1.0 + np.exp(pem.logit(salient)))


def log_likelihood(
    missed: BoolArray, shares: FloatArray, *, tau_s: float, frailty: float
) -> FloatArray:
    """Log probability of outcomes ``[N, W]`` with a memory, u integrated out, ``[N]`` [nats].

    Args:
        missed: Outcomes.
        shares: P(missed) of each frame ``[W]``, within (0, 1).
        tau_s: Memory time [s].
        frailty: 0 for none.
    """
    own = -logit(shares)  # of 'detected'
    nodes = VisibilityNodes(frailty) if frailty > 0.0 else None
    last, total = np.zeros(len(missed)), None
    rho = float(persistence(DT_S, tau_s))
    for frame in range(missed.shape[1]):
        if nodes is None:
            pair = (
                np.log(shares[frame : frame + 1, None]),
                np.log1p(-shares[frame : frame + 1, None]),
            )
        else:
            pair = nodes.log_outcomes(own[frame : frame + 1])
        every = tuple(np.repeat(each, len(missed), axis=0) for each in pair)
        miss, hit = remembered_outcomes((every[0], every[1]), last=last, rho=rho)
        step = np.where(missed[:, frame, None], miss, hit)
        total = step if total is None else total + step
        last = np.where(missed[:, frame], -1.0, 1.0)
    assert total is not None  # noqa: S101  a window has frames
    weight = np.zeros(1) if nodes is None else nodes.log_weight
    return log_sums(total + weight)


def lagged(shares: FloatArray, *, tau_s: float) -> FloatArray:
    """P(missed) of each frame ``[W]`` where outcomes before are copied, from the model's own.

    m_k = (1 - rho) p_k + rho m_(k-1): the chain's marginals follow p with a delay of about tau.
    """
    rho, found = float(persistence(DT_S, tau_s)), shares.copy()
    for frame in range(1, shares.size):
        found[frame] = (1.0 - rho) * shares[frame] + rho * found[frame - 1]
    return found


def all_missed_if_normal(window: Window) -> float:
    """How likely all frames are missed if a normal latent of each falls below a quantile.

    The latents' correlation of frames a lag apart is that by which as many pairs are missed as were
    (a tetrachoric correlation, pooled over the pairs of a lag; Pearson 1900).
    """
    count, frames = window.missed.shape
    quantile = ndtri(window.shares.clip(0.5 / count, 1.0 - 0.5 / count))
    by_lag = [1.0, *(_tetrachoric(window.missed, quantile, lag=lag) for lag in range(1, frames))]
    values, vectors = np.linalg.eigh(toeplitz(by_lag))
    matrix = (vectors * values.clip(1e-9)) @ vectors.T
    spread = np.sqrt(np.diag(matrix))
    normals = multivariate_normal(
        cov=matrix / np.outer(spread, spread),  # pyright: ignore[reportArgumentType]  scipy's stub
        seed=0,
        maxpts=20_000 * frames,
        abseps=1e-6,
        releps=1e-2,
    )
    return float(normals.cdf(quantile))


def _tetrachoric(missed: BoolArray, quantile: FloatArray, *, lag: int) -> float:
    pairs = np.stack([quantile[:-lag], quantile[lag:]], axis=1)
    both = float((missed[:, :-lag] & missed[:, lag:]).mean(axis=0).sum())

    def excess(correlation: float) -> float:
        two = np.array([[1.0, correlation], [correlation, 1.0]])
        normals = multivariate_normal(cov=two)  # pyright: ignore[reportArgumentType]  scipy's stub
        return float(np.sum(normals.cdf(pairs))) - both

    if excess(LOOSEST) >= 0.0:
        return LOOSEST
    if excess(TIGHTEST) <= 0.0:
        return TIGHTEST
    return root_scalar(excess, bracket=(LOOSEST, TIGHTEST), xtol=1e-4).root


@dataclass(frozen=True)
class Explained:
    """A prediction taken apart.

    Attributes:
        gap_m: At the frames that decide ``[W]``.
        loop: How often each is missed in the loop ``[W]``.
        model: P(missed) of the error model there ``[W]``.
        lagged: What becomes of that with the memory time of both: P(missed) is late ``[W]``.
        all_missed: How often all are, in the loop.
        scenes: That were looked at.
        normal: How likely all are missed with normal latents of the outcomes' own correlations.
        by_variant: How likely all are missed with the variant's law of misses: with the loop's
            shares, and with the model's.
    """

    gap_m: tuple[float, ...]
    loop: tuple[float, ...]
    model: tuple[float, ...]
    lagged: tuple[float, ...]
    all_missed: float
    scenes: int
    normal: float
    by_variant: dict[str, tuple[float, float]]


def explained(
    loop: Loop,
    scenes: Scenes,
    pem: Pem,
    laws: Mapping[str, tuple[float, float] | VaryingFrailty],
) -> Explained:
    """Take apart what a model with several laws of misses predicts of a window.

    Each is a memory (tau [s], frailty), as that of ``both`` has to be, or a visibility.
    """
    window = decisive_window(loop, scenes)
    count = len(window.missed)
    own_shares = window.shares.clip(0.5 / count, 1.0 - 0.5 / count)
    model = model_shares(loop, window, pem)
    both = laws["both"]
    assert not isinstance(both, VaryingFrailty)  # noqa: S101  the docstring asks for it
    return Explained(
        gap_m=tuple(window.gap_m.tolist()),
        loop=tuple(window.shares.tolist()),
        model=tuple(model.tolist()),
        lagged=tuple(lagged(model, tau_s=both[0]).tolist()),
        all_missed=window.all_missed,
        scenes=count,
        normal=all_missed_if_normal(window),
        by_variant={
            name: (all_missed(own_shares, law), all_missed(model, law))
            for name, law in laws.items()
        },
    )


def all_missed(shares: FloatArray, law: tuple[float, float] | VaryingFrailty) -> float:
    """How likely frames with these P(missed) ``[W]`` are missed throughout."""
    missed = np.ones((1, shares.size), dtype=np.bool_)
    if isinstance(law, VaryingFrailty):
        return float(
            np.exp(VaryingNodes(law, DT_S).log_likelihood(-logit(shares)[None], ~missed)[0])
        )
    tau_s, frailty = law
    return float(np.exp(log_likelihood(missed, shares, tau_s=tau_s, frailty=frailty)[0]))
