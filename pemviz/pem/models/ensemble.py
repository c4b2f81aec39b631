"""Several models that the same data could have produced, kept and used as one."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray, log_sum_exp
from pemviz.chunks import map_rows
from pemviz.errors import PemError
from pemviz.pem.models.cards import Carded, PemCard
from pemviz.pem.models.network import NetworkPem, sound_rows
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.protocol import tensors_digest
from pemviz.pem.models.trees import TreesPem

SingleModel = NetworkPem | TreesPem

LARGEST_LOGIT = 700.0
"""Beyond it exp(-logit) comes to the smallest number there is."""


@dataclass(frozen=True, eq=False)
class EnsemblePem(Carded):
    """Two members or more, of one kind; as a model it answers with their mean probability.

    Raises:
        PemError: there is one, or they are of different kinds.
    """

    kind: ClassVar[str] = "ensemble"

    card: PemCard
    members: tuple[SingleModel, ...]

    def __post_init__(self) -> None:
        if len(self.members) < 2:
            raise PemError(f"{self.card.name}: an ensemble needs at least two members")
        first = self.members[0]
        same = (member.options() == first.options() for member in self.members)
        if not all(same) or len({member.kind for member in self.members}) > 1:
            raise PemError(f"{self.card.name}: an ensemble's members must be of one kind")

    @property
    def own(self) -> OwnFeatures | None:
        """What its members see in place of a road user's salient variables."""
        return self.members[0].own

    @property
    def digest(self) -> str:
        """SHA-256 over the members' tensors."""
        about = f"ensemble of {self.members[0].kind}"
        return tensors_digest(
            about if self.own is None else f"{about}:{self.own.to_json()}", self.tensors()
        )

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        return {
            f"members.{index:03d}.{name}": array
            for index, member in enumerate(self.members)
            for name, array in member.tensors().items()
        }

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors: the members' kind and their options."""
        first = self.members[0]
        return {"member_kind": first.kind, **first.options()}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of the members' mean P(detected), shape [...], of salient variables [..., D]."""
        rows, shape = sound_rows(salient, self.own)
        logits = np.stack([member.logit(rows) for member in self.members], axis=1)
        return map_rows(mean_probability_logit, logits).reshape(shape)


def mean_probability_logit(logits: FloatArray) -> FloatArray:
    """Logit [n] of the mean over members of the probabilities with logits [n, members]."""
    size = np.abs(logits)
    small = np.exp(-size)
    large = 1.0 / (1.0 + small)
    small *= large
    likely = logits > 0.0
    # einsum adds a row up by itself, and sooner than a sum over short rows
    detected = np.einsum("nm->n", np.where(likely, large, small))
    missed = np.einsum("nm->n", np.where(likely, small, large))
    with np.errstate(divide="ignore"):
        found = np.log(detected) - np.log(missed)
    if size.max(initial=0.0) <= LARGEST_LOGIT:
        return found
    # where probabilities may be too small for a number
    log_detected = np.asarray(log_sum_exp(-np.logaddexp(0.0, -logits), axis=1))
    log_missed = np.asarray(log_sum_exp(-np.logaddexp(0.0, logits), axis=1))
    return np.where(size.max(axis=1) > LARGEST_LOGIT, log_detected - log_missed, found)
