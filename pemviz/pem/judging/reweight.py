"""One set of rollouts, many perception error models: mu under each by importance weights.

The simulator's answer to a chain of detections does not depend on the model, so rollouts sampled
from any proposal estimate mu under every model: mu_m = 1/N sum over violating rollouts of
p_m(outcomes | states) / q(outcomes | states).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import BoolArray, FloatArray, log_sum_exp, row_sums
from pemviz.errors import PemError
from pemviz.pem.models.pieces import chain_logit_along
from pemviz.pem.models.protocol import Pem, chain_log_likelihood


@dataclass(frozen=True, eq=False)
class MemberEstimates:
    """The failure probability under each of M models, from the same N rollouts."""

    names: tuple[str, ...]
    log_mu: FloatArray
    """Log of mu [nats], shape [M]; -inf if no rollout violated."""
    relative_std_error: FloatArray
    """Standard error over mu, shape [M]; infinite if no rollout violated."""
    effective_failures: FloatArray
    """Kish's effective number of violating rollouts, shape [M]."""
    rules: "Mapping[str, MemberEstimates]" = field(default_factory=dict[str, "MemberEstimates"])
    """The same of each of several rules, where mu is that any is broken."""


@dataclass(frozen=True)
class PemInterval:
    """How far the training data leaves mu open, through the model that learned from it."""

    log10_low: float
    """Lower end, log10 of mu; -inf if no rollout violated."""
    log10_median: float
    log10_high: float
    confidence: float
    """Share of the members inside, interpolated."""
    members: int
    worst_effective_failures: float
    """Smallest effective number of violating rollouts of any member."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class RatioInterval:
    """Ratio of mu under a new model to mu under an old one; its interval covers sampling alone."""

    log10_ratio: float
    log10_low: float
    log10_high: float
    confidence: float
    effective_failures: float
    """Smaller of the two models' effective numbers of violating rollouts."""


def failing_log_weights(
    *, detected: BoolArray, salient: FloatArray, log_q: FloatArray, violated: BoolArray, pem: Pem
) -> FloatArray:
    """Log importance weights of the violating rollouts under one model, shape [violations].

    Rollouts are given as for :func:`reweight`.
    """
    _check_shapes(detected=detected, salient=salient, log_q=log_q, violated=violated)
    log_p = chain_log_likelihood(
        pem, salient[violated], detected[violated], logit_of=chain_logit_along
    )
    of_rollout = log_q[violated]
    return log_p - (of_rollout if of_rollout.ndim == 1 else row_sums(of_rollout))


def reweight(
    *,
    detected: BoolArray,
    salient: FloatArray,
    log_q: FloatArray,
    violated: BoolArray,
    members: Sequence[Pem],
    rollouts: int | None = None,
    broken: Mapping[str, BoolArray] | None = None,
) -> MemberEstimates:
    """Estimate mu under each member from the same rollouts.

    Args:
        detected: outcomes of perception, shape [N, T-1].
        salient: what the models see at each step, shape [N, T-1, 11].
        log_q: log probability of each outcome under the proposal, shape [N, T-1]; or of each
            whole rollout, shape [N], as the balance heuristic gives.
        violated: which rollouts violate the specification, shape [N].
        members: the models.
        rollouts: how many there are in all, if the arrays hold only some of them, at least
            all that violate; N if None.
        broken: which rollouts break each of several rules by name, shape [N] each; those that
            break any violate.

    Raises:
        PemError: the shapes do not fit together, or rollouts is below N.
    """
    rollouts = _in_all(rollouts, given=len(violated))
    log_weights = [
        failing_log_weights(
            detected=detected, salient=salient, log_q=log_q, violated=violated, pem=member
        )
        for member in members
    ]

    def of(some: BoolArray) -> MemberEstimates:
        each = [_summary(one[some[violated]], rollouts=rollouts) for one in log_weights]
        log_mu, relative, effective = np.array(each, dtype=np.float64).reshape(-1, 3).T
        names = tuple(member.name for member in members)
        return MemberEstimates(names, log_mu, relative, effective)

    return replace(of(violated), rules={name: of(some) for name, some in (broken or {}).items()})


def pem_interval(
    estimates: MemberEstimates, *, few_effective: float, confidence: float = 0.95
) -> PemInterval:
    """The central interval of mu over the members, with what limits it.

    Args:
        estimates: of at least two members.
        few_effective: effective violating rollouts below which a member's mu is not to be
            trusted.
        confidence: share of members between the ends.

    Raises:
        PemError: fewer than two members.
    """
    members = len(estimates.log_mu)
    if members < 2:
        raise PemError(f"an interval over models needs at least 2 members, got {members}")
    log10_mu = estimates.log_mu / np.log(10.0)
    tail = (1.0 - confidence) / 2.0
    if np.isfinite(log10_mu).all():
        low, median, high = np.quantile(log10_mu, [tail, 0.5, 1.0 - tail])
    else:
        low, median, high = -np.inf, -np.inf, float(log10_mu.max())
    worst = float(estimates.effective_failures.min())
    return PemInterval(
        log10_low=float(low),
        log10_median=float(median),
        log10_high=float(high),
        confidence=confidence,
        members=members,
        worst_effective_failures=worst,
        warnings=tuple(_interval_warnings(estimates, few_effective, confidence)),
    )


def compare_pems(
    *,
    detected: BoolArray,
    salient: FloatArray,
    log_q: FloatArray,
    violated: BoolArray,
    old: Pem,
    new: Pem,
    rollouts: int | None = None,
    confidence: float = 0.95,
) -> RatioInterval:
    """Ratio of mu under ``new`` to mu under ``old``, from the same rollouts.

    The interval comes from the delta method on the logarithm of the ratio of two means; because
    both means share their rollouts, what they have in common cancels.

    Rollouts are given as for :func:`reweight`.

    Raises:
        PemError: no rollout violates, or shapes that do not fit.
    """
    if not violated.any():
        raise PemError("no rollout violates the specification: the ratio of two models is unknown")
    rollouts = _in_all(rollouts, given=len(violated))
    log_weights = [
        failing_log_weights(
            detected=detected, salient=salient, log_q=log_q, violated=violated, pem=pem
        )
        for pem in (old, new)
    ]
    (log_old, _, ess_old), (log_new, _, ess_new) = (
        _summary(log_weight, rollouts=rollouts) for log_weight in log_weights
    )
    influence = np.exp(log_weights[1] - log_new) - np.exp(log_weights[0] - log_old)
    # Rollouts that do not violate have influence 0 and the mean over all N is 0 too.
    std_error = np.sqrt(np.sum(influence**2) / (rollouts * max(rollouts - 1, 1)))
    half = float(ndtri(0.5 + confidence / 2.0)) * std_error
    scale = np.log(10.0)
    return RatioInterval(
        log10_ratio=(log_new - log_old) / scale,
        log10_low=(log_new - log_old - half) / scale,
        log10_high=(log_new - log_old + half) / scale,
        confidence=confidence,
        effective_failures=min(ess_old, ess_new),
    )


def _in_all(rollouts: int | None, *, given: int) -> int:
    if rollouts is None:
        return given
    if rollouts < given:
        raise PemError(f"rollouts is {rollouts}, but {given} are given")
    return rollouts


def _summary(log_weight: FloatArray, *, rollouts: int) -> tuple[float, float, float]:
    """Log mu, relative standard error, effective failures of violating weights [violations]."""
    if len(log_weight) == 0:
        return -np.inf, np.inf, 0.0
    log_sum = float(log_sum_exp(log_weight))
    if not np.isfinite(log_sum):
        return -np.inf, np.inf, 0.0
    log_squares = float(log_sum_exp(2.0 * log_weight))
    effective = float(np.exp(2.0 * log_sum - log_squares))
    variance = max(rollouts / effective - 1.0, 0.0) / max(rollouts - 1, 1)
    return log_sum - float(np.log(rollouts)), float(np.sqrt(variance)), effective


def _interval_warnings(
    estimates: MemberEstimates, few_effective: float, confidence: float
) -> list[str]:
    warnings: list[str] = []
    members = len(estimates.log_mu)
    if not np.isfinite(estimates.log_mu).all():
        warnings.append("no rollout violates under some refits: the range has no lower end")
    weak = int((estimates.effective_failures < few_effective).sum())
    if weak:
        warnings.append(
            f"with {weak} of {members} refits fewer than {few_effective:g} effective rollouts "
            "carry the estimate: sample more before trusting the range over refits"
        )
    if members < 2.0 / (1.0 - confidence):
        warnings.append(
            f"{members} refits are few for a range of {confidence:.0%}: its ends lie between the "
            "most extreme models"
        )
    return warnings


def _check_shapes(
    *, detected: BoolArray, salient: FloatArray, log_q: FloatArray, violated: BoolArray
) -> None:
    steps = detected.shape
    fits = (
        detected.ndim == 2
        and violated.shape == steps[:1]
        and log_q.shape in (steps, steps[:1])
        and salient.shape[:-1] == steps
    )
    if not fits:
        raise PemError(
            f"rollouts do not fit together: detected {list(detected.shape)}, "
            f"salient {list(salient.shape)}, log_q {list(log_q.shape)}, "
            f"violated {list(violated.shape)}"
        )
