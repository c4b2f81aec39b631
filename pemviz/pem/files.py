"""Models on disk: safetensors with one line of JSON metadata; nothing read here can run code.

All metadata stands under one key, because the order of several keys in a safetensors file is
arbitrary and the same model must give the same bytes.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pemviz.arrays import AnyArray
from pemviz.pem.authors import authors_pem, is_authors_checkpoint
from pemviz.pem.card import PemCard, card_from_mapping
from pemviz.pem.errors import PemError
from pemviz.pem.network import Layer, NetworkPem

METADATA_KEY = "pemviz-pem"
FORMAT_VERSION = 1


def save_network(pem: NetworkPem, path: Path) -> None:
    """Write a network; the same model gives the same bytes."""
    write_tensors(path, kind="network", card=pem.card, tensors=pem.tensors())


def write_tensors(path: Path, *, kind: str, card: PemCard, tensors: Mapping[str, AnyArray]) -> None:
    """Write tensors with a model's kind and card as metadata."""
    header = {"version": FORMAT_VERSION, "kind": kind, "card": asdict(card)}
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    contiguous = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    path.write_bytes(save(contiguous, metadata={METADATA_KEY: text}))


def read_tensors(path: Path) -> tuple[dict[str, AnyArray], dict[str, str]]:
    """Tensors and raw metadata of a safetensors file.

    Raises:
        PemError: the file is missing, no safetensors file, or cut short.
    """
    if not path.is_file():
        raise PemError(f"{path}: no such file")
    try:
        with safe_open(path, framework="numpy") as stream:
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
            metadata = dict(stream.metadata() or {})
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise PemError(
            f"{path}: not a readable safetensors file ({reason}); torch files are refused"
        ) from None
    return tensors, metadata


def load_file(path: Path) -> NetworkPem:
    """Read a model from a safetensors file, ours or the authors'.

    Raises:
        PemError: the file cannot be used; one line says why.
    """
    tensors, metadata = read_tensors(path)
    if is_authors_checkpoint(tensors) and METADATA_KEY not in metadata:
        source = metadata.get("source")
        return authors_pem(tensors, name=path.stem, where=str(path), source=source)
    kind, card = _header(metadata, where=str(path))
    if kind != "network":
        raise PemError(f"{path}: unknown kind of model {kind!r}")
    return network_from_tensors(tensors, card=card, where=str(path))


def network_from_tensors(
    tensors: Mapping[str, AnyArray], *, card: PemCard, where: str
) -> NetworkPem:
    """A network from the tensors that NetworkPem.tensors names.

    Raises:
        PemError: tensors are missing, unknown, misshapen or not finite.
    """
    count = sum(name.endswith(".weight") for name in tensors)
    wanted = {"pose.mean", "pose.std"}
    wanted |= {f"layers.{index}.{part}" for index in range(count) for part in ("weight", "bias")}
    if set(tensors) != wanted:
        raise PemError(
            f"{where}: lacks tensors {sorted(wanted - set(tensors))}, "
            f"has unknown {sorted(set(tensors) - wanted)}"
        )
    doubles = {name: np.asarray(array, dtype=np.float64) for name, array in tensors.items()}
    layers = tuple(
        Layer(weight=doubles[f"layers.{index}.weight"], bias=doubles[f"layers.{index}.bias"])
        for index in range(count)
    )
    return NetworkPem(
        card=card, pose_mean=doubles["pose.mean"], pose_std=doubles["pose.std"], layers=layers
    )


def _header(metadata: Mapping[str, str], *, where: str) -> tuple[str, PemCard]:
    if METADATA_KEY not in metadata:
        raise PemError(f"{where}: no {METADATA_KEY!r} metadata and no authors' tensor names")
    try:
        header: Any = json.loads(metadata[METADATA_KEY])
    except json.JSONDecodeError as error:
        raise PemError(f"{where}: metadata is not JSON ({error})") from None
    if not isinstance(header, dict) or header.get("version") != FORMAT_VERSION:
        raise PemError(f"{where}: metadata has no 'version' {FORMAT_VERSION}")
    card = header.get("card")
    if not isinstance(card, dict) or not isinstance(header.get("kind"), str):
        raise PemError(f"{where}: metadata lacks 'kind' or 'card'")
    return header["kind"], card_from_mapping(card, where=where)
