"""Models on disk: safetensors with one line of JSON metadata; nothing read here can run code.

All metadata stands under one key, because the order of several keys in a safetensors file is
arbitrary and the same model must give the same bytes.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pemviz.arrays import AnyArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, write_bytes
from pemviz.files.json_text import parse_json
from pemviz.pem.models.authors_network import authors_pem, is_authors_checkpoint
from pemviz.pem.models.card import PemCard, card_from_mapping
from pemviz.pem.models.encoding import PAPER_INPUTS
from pemviz.pem.models.ensemble import EnsemblePem, SingleModel
from pemviz.pem.models.layers import Layer
from pemviz.pem.models.network import NetworkPem
from pemviz.pem.models.tabulated import TabulatedPem
from pemviz.pem.models.tensors import as_double
from pemviz.pem.models.tree_features import FEATURES, FeatureSet
from pemviz.pem.models.trees import TreesPem

METADATA_KEY = "pemviz-pem"
_MEMBER = re.compile("[0-9]{1,6}")
FORMAT_VERSION = 1

StoredPem = NetworkPem | TreesPem | TabulatedPem | EnsemblePem


@dataclass(frozen=True)
class _Header:
    """What the metadata of our files says."""

    kind: str
    options: Mapping[str, Any]
    card: PemCard


def _without_empty_memory(card: dict[str, Any]) -> dict[str, Any]:
    """A card of a model without memory has no such entry."""
    return {name: value for name, value in card.items() if name != "memory" or value}


def save_pem(pem: StoredPem, path: Path) -> None:
    """Write a model as safetensors; the same model gives the same bytes."""
    header = {
        "version": FORMAT_VERSION,
        "kind": pem.kind,
        "options": pem.options(),
        "card": _without_empty_memory(asdict(pem.card)),
    }
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    contiguous = {name: np.ascontiguousarray(array) for name, array in pem.tensors().items()}
    write_bytes(path, save(contiguous, metadata={METADATA_KEY: text}))


def load_file(path: Path) -> StoredPem:
    """Read a model from a safetensors file, ours or the authors'.

    Raises:
        PemError: the file cannot be used; one line says why.
    """
    tensors, metadata = read_tensors(path)
    where = str(path)
    if is_authors_checkpoint(tensors) and METADATA_KEY not in metadata:
        return authors_pem(tensors, name=path.stem, where=where, source=metadata.get("source"))
    header = _header(metadata, where=where)
    if header.kind == "ensemble":
        return _ensemble(tensors, header, where=where)
    if header.kind == "table":
        _exactly(tensors, {"table.distance_m", "table.logit"}, where=where)
        distance_m, logit = (
            as_double(tensors["table.distance_m"]),
            as_double(tensors["table.logit"]),
        )
        return TabulatedPem(header.card, distance_m, logit, header.options.get("between", ""))
    return _single(tensors, header, where=where)


def read_tensors(path: Path) -> tuple[dict[str, AnyArray], dict[str, str]]:
    """Tensors and raw metadata of a safetensors file.

    Raises:
        PemError: the file is missing, no safetensors file, or cut short.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    try:
        with safe_open(path, framework="numpy") as stream:
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
            metadata = dict(stream.metadata() or {})
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PemError(
            f"{path}: not a readable safetensors file ({reason}); torch files are refused"
        ) from None
    for name, array in tensors.items():
        if array.dtype.kind not in "iuf":
            raise PemError(
                f"{path}: tensor {name!r} is of type {array.dtype}, must be real numbers"
            )
    return tensors, metadata


def _single(tensors: Mapping[str, AnyArray], header: _Header, *, where: str) -> SingleModel:
    if header.kind == "network":
        _check_inputs(header, PAPER_INPUTS, where=where)
        return _network(tensors, card=header.card, where=where)
    if header.kind == "trees":
        feature_set: object = header.options.get("feature_set")
        if feature_set not in tuple(FEATURES):  # a tuple, because a list has no hash
            raise PemError(f"{where}: metadata option 'feature_set' is {feature_set!r}")
        _check_inputs(header, FEATURES[feature_set], where=where)
        return _trees(tensors, card=header.card, feature_set=feature_set, where=where)
    raise PemError(f"{where}: unknown kind of model {header.kind!r}")


def _check_inputs(header: _Header, expected: tuple[str, ...], *, where: str) -> None:
    inputs = header.options.get("inputs")
    if inputs != list(expected):
        raise PemError(f"{where}: its inputs are {inputs}, this version computes {list(expected)}")


def _network(tensors: Mapping[str, AnyArray], *, card: PemCard, where: str) -> NetworkPem:
    count = sum(name.endswith(".weight") for name in tensors)
    names = {f"layers.{index}.{part}" for index in range(count) for part in ("weight", "bias")}
    _exactly(tensors, names | {"pose.mean", "pose.std"}, where=where)
    doubles = {name: as_double(array) for name, array in tensors.items()}
    layers = tuple(
        Layer(weight=doubles[f"layers.{index}.weight"], bias=doubles[f"layers.{index}.bias"])
        for index in range(count)
    )
    return NetworkPem(card, doubles["pose.mean"], doubles["pose.std"], layers)


def _trees(
    tensors: Mapping[str, AnyArray], *, card: PemCard, feature_set: FeatureSet, where: str
) -> TreesPem:
    parts = ("feature", "number", "left", "root")
    _exactly(tensors, {*(f"trees.{part}" for part in parts), "calibration"}, where=where)
    return TreesPem(
        card,
        feature_set,
        feature=tensors["trees.feature"],
        number=as_double(tensors["trees.number"]),
        left=tensors["trees.left"],
        root=tensors["trees.root"],
        calibration=as_double(tensors["calibration"]),
    )


def _ensemble(tensors: Mapping[str, AnyArray], header: _Header, *, where: str) -> EnsemblePem:
    grouped: dict[str, dict[str, AnyArray]] = {}
    for name, array in tensors.items():
        prefix, _, rest = name.partition(".")
        index, _, inner = rest.partition(".")
        if prefix != "members" or not _MEMBER.fullmatch(index) or not inner:
            raise PemError(f"{where}: unknown tensor {name!r}")
        grouped.setdefault(index, {})[inner] = array
    member_kind = str(header.options.get("member_kind"))
    members: list[SingleModel] = []
    for index in sorted(grouped):
        card = replace(header.card, name=f"{header.card.name}[{int(index)}]")
        of_member = _Header(kind=member_kind, options=header.options, card=card)
        members.append(_single(grouped[index], of_member, where=f"{where} member {index}"))
    return EnsemblePem(header.card, tuple(members))


def _exactly(tensors: Mapping[str, AnyArray], wanted: set[str], *, where: str) -> None:
    if set(tensors) != wanted:
        raise PemError(
            f"{where}: lacks tensors {sorted(wanted - set(tensors))}, "
            f"has unknown {sorted(set(tensors) - wanted)}"
        )


def _header(metadata: Mapping[str, str], *, where: str) -> _Header:
    if METADATA_KEY not in metadata:
        raise PemError(f"{where}: no {METADATA_KEY!r} metadata and no authors' tensor names")
    try:
        header: Any = parse_json(metadata[METADATA_KEY])
    except ValueError as error:
        raise PemError(f"{where}: metadata is not JSON ({error})") from None
    if not isinstance(header, dict) or header.get("version") != FORMAT_VERSION:
        raise PemError(f"{where}: metadata does not say 'version' {FORMAT_VERSION}")
    kind, options, card = (header.get(key) for key in ("kind", "options", "card"))
    if not (isinstance(kind, str) and isinstance(options, dict) and isinstance(card, dict)):
        raise PemError(f"{where}: metadata lacks 'kind', 'options' or 'card'")
    return _Header(kind=kind, options=options, card=card_from_mapping(card, where=where))
