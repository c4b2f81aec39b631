"""Training a perception error model, or an ensemble, by the name of its kind."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from pemviz.errors import PemError
from pemviz.pem.data.support import summarise_support
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.cards import KITTI_LICENCE, UNKNOWN_LICENCE, PemCard
from pemviz.pem.models.ensemble import EnsemblePem, SingleModel
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.trees import FEATURES, OWN, FeatureSet

ModelKind = Literal["guess-mu", "lr", "ml-nn", "b-nn", "gb-paper", "gb-raw"]
MODEL_KINDS: tuple[ModelKind, ...] = get_args(ModelKind)

Progress = Callable[[int, int], None]
BOOSTED: dict[ModelKind, FeatureSet] = {"gb-paper": "paper", "gb-raw": "raw"}
"""What boosted trees see, by the name of their kind."""


PAPER_WORDS, PAPER_LAYER = "the paper's 14 inputs", "Linear(14,"
"""What recipes say of the inputs, where these are not features of one's own."""


@dataclass(frozen=True)
class Provenance:
    """What the card of a fitted model says about its data, in words."""

    data: str
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
    calibrate: bool = True,
    on_progress: Progress | None = None,
) -> SingleModel | EnsemblePem:
    """Train a model; the same table and seed give the same model to the last bit.

    Normalisation is fitted on the table too. On video boosted trees are calibrated on sequences
    that they have not seen, or not at all without ``calibrate``; ``b-nn`` gives an ensemble of
    posterior samples. Name and provenance are the kind and the table's source if None;
    ``on_progress`` is called with steps done and steps in all.

    Raises:
        PemError: unknown kind, a missing optional package, or a table without both outcomes.
    """
    card = _card(table, model=model, name=name or model, seed=seed, provenance=provenance)
    return _fit(
        table, model=model, card=card, seed=seed, calibrate=calibrate, on_progress=on_progress
    )


def fit_ensemble(
    table: SalientTable,
    *,
    model: ModelKind = "ml-nn",
    members: int = 20,
    seed: int = 0,
    name: str | None = None,
    provenance: Provenance | None = None,
    on_progress: Progress | None = None,
) -> EnsemblePem:
    """Train members that differ in the bootstrap sample of the data and in initialisation.

    The model is the kind of the members, at least 2; a ``b-nn`` is an ensemble already. The name is
    the kind and ``-ensemble`` if None, the rest as for :func:`fit_pem`.

    Raises:
        PemError: fewer than two members, or what fit_pem raises.
    """
    if members < 2:
        raise PemError(f"members is {members}, allowed: 2 or more")
    if model == "b-nn":
        raise PemError("model 'b-nn' is an ensemble of posterior draws by itself")
    whole = name or f"{model}-ensemble"
    card = _card(table, model=model, name=whole, seed=seed, provenance=provenance)
    fitted: list[SingleModel] = []
    for index, child in enumerate(np.random.SeedSequence(seed).spawn(members)):
        random = np.random.default_rng(child)
        sample = table.take(random.integers(0, len(table), len(table)))
        member = _fit(
            sample,
            model=model,
            card=replace(card, name=f"{whole}[{index}]"),
            seed=int(random.integers(2**31)),
            calibrate=True,
            on_progress=None,
        )
        assert not isinstance(member, EnsemblePem)  # noqa: S101 (b-nn is refused above)
        fitted.append(member)
        if on_progress is not None:
            on_progress(index + 1, members)
    recipe = (
        f"{members} members, each on a bootstrap sample of the table and from its own "
        f"initialisation: {fitted[0].card.recipe}"
    )
    return EnsemblePem(replace(card, recipe=recipe), tuple(fitted))


def _card(
    table: SalientTable, *, model: str, name: str, seed: int, provenance: Provenance | None
) -> PemCard:
    given = provenance or Provenance(data=table.source)
    return PemCard(
        name=name,
        model=model,
        data=given.data,
        data_digest=table.digest,
        licence=given.licence,
        seed=seed,
        support={} if table.features is not None else summarise_support(table).to_json(),
    )


def _fit(
    table: SalientTable,
    *,
    model: ModelKind,
    card: PemCard,
    seed: int,
    calibrate: bool,
    on_progress: Progress | None,
) -> SingleModel | EnsemblePem:
    table.check_outcomes()
    own = table.features
    if own is not None and model == "gb-paper":
        raise PemError("model 'gb-paper' sees the paper's columns; with features use gb-raw")
    # torch, scikit-learn and pyro take seconds to import: each only for the models it fits.
    if model in ("ml-nn", "b-nn"):
        from pemviz.pem.fitting import networks  # noqa: PLC0415

        if model == "b-nn":
            card = replace(card, recipe=_recipe(networks.BAYES_RECIPE, own))
            return networks.fit_bayes(table, card=card, seed=seed, on_progress=on_progress)
        card = replace(card, recipe=_recipe(networks.RECIPE, own))
        return networks.fit_network(table, card=card, seed=seed, on_progress=on_progress)
    if model in MODEL_KINDS:
        from pemviz.pem.fitting import linear_and_trees as fits  # noqa: PLC0415

        if model == "lr":
            return fits.fit_logistic(table, card=replace(card, recipe=_recipe(fits.LR_RECIPE, own)))
        if model == "guess-mu":
            return fits.fit_guess_mu(table, card=replace(card, recipe=fits.GUESS_MU_RECIPE))
        sees = BOOSTED[model]
        words = fits.trees_recipe(
            FEATURES[sees] if own is None else own.input_names,
            by_sequence=table.sequence is not None,
            calibrated=calibrate,
        )
        return fits.fit_trees(
            table,
            card=replace(card, recipe=_recipe(words, own)),
            feature_set=sees if own is None else OWN,
            seed=seed,
            calibrate=calibrate,
            on_progress=on_progress,
        )
    raise PemError(f"unknown model {model!r}, allowed: {', '.join(MODEL_KINDS)}")


def _recipe(words: str, own: OwnFeatures | None) -> str:
    """How a model was trained, and on which features of one's own."""
    if own is None:
        return words
    on_own = words.replace(PAPER_WORDS, "the features").replace(
        PAPER_LAYER, f"Linear({len(own.input_names)},"
    )
    return f"{on_own}; features: {own}"
