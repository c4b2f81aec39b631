"""Training a perception error model by the name of its kind."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from pemviz.pem.card import KITTI_LICENCE, UNKNOWN_LICENCE, PemCard
from pemviz.pem.network import NetworkPem
from pemviz.pem.table import SalientTable

ModelKind = Literal["ml-nn"]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Provenance:
    """What the card of a fitted model says about its data."""

    data: str
    """The training data, in words."""
    licence: str = UNKNOWN_LICENCE
    """Terms that the data puts on the model."""


KITTI_YOLOV3 = Provenance(
    data=(
        "37,498 KITTI obstacles (no class Misc, no unknown occlusion) and what a YOLOv3 trained "
        "on KITTI made of each, published by C. Innes (github.com/craigiedon/"
        "PyTorch-YOLOv3-kitti, salient_dataset)"
    ),
    licence=KITTI_LICENCE,
)


def fit_pem(
    table: SalientTable,
    *,
    model: ModelKind = "ml-nn",
    seed: int = 0,
    name: str | None = None,
    provenance: Provenance | None = None,
    on_progress: Progress | None = None,
) -> NetworkPem:
    """Train a model; the same table and seed give the same model to the last bit.

    Args:
        table: obstacles and outcomes; normalisation is fitted on it too.
        model: the kind of model.
        seed: of everything random.
        name: of the model; its kind if None.
        provenance: for the card; taken from the table's source if None.
        on_progress: told (steps done, steps in all).
    """
    from pemviz.pem.fit_network import NetworkRecipe, fit_network  # noqa: PLC0415 (torch)

    told = provenance or Provenance(data=table.source)
    recipe = NetworkRecipe()
    card = PemCard(
        name=name or model,
        model=model,
        data=told.data,
        data_digest=table.digest,
        licence=told.licence,
        recipe=recipe.in_words(),
        seed=seed,
    )
    fitted = fit_network(table, seed=seed, recipe=recipe, on_epoch=on_progress)
    return NetworkPem(card, fitted.pose_mean, fitted.pose_std, fitted.layers)
