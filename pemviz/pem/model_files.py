"""Models by the name or path that a user gives, and their files; reading one cannot run code.

A file is safetensors with one line of JSON metadata. It stands under one key, because the order of
several keys in a safetensors file is arbitrary and the same model must give the same bytes. Shipped
models of position errors lie in a folder of their own, apart from the error models of misses.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pemviz.arrays import AnyArray, FloatArray
from pemviz.config.ranges import did_you_mean
from pemviz.errors import PemError
from pemviz.faults import exception_text
from pemviz.files.atomic import file_digest, is_file, write_bytes
from pemviz.files.json_text import parse_json
from pemviz.files.shipped import asset_path
from pemviz.pem.models.binned_position_errors import (
    BIN_DEVIATIONS,
    BIN_MEANS,
    BIN_SENSOR,
    BINS,
    BinnedPositionErrors,
)
from pemviz.pem.models.cards import Carded, PemCard, card_from_mapping, position_card_from_mapping
from pemviz.pem.models.ensemble import EnsemblePem, SingleModel
from pemviz.pem.models.network import (
    Layer,
    NetworkPem,
    authors_pem,
    input_names,
    is_authors_checkpoint,
)
from pemviz.pem.models.own_features import features_from_json
from pemviz.pem.models.position_errors import ErrorAxis, NoiseMemory, PositionErrorModel
from pemviz.pem.models.protocol import (
    DetectorModel,
    OwnPem,
    Pem,
    PemEnsemble,
    as_double,
    as_pem,
)
from pemviz.pem.models.tabulated import TabulatedPem, load_csv
from pemviz.pem.models.trees import FEATURES, OWN, FeatureSet, OwnSet, TreesPem, seen_names

ASSET_FOLDER = "pem"
POSITION_ASSET_FOLDER = "position_errors"
SUFFIX = ".safetensors"
ENSEMBLE_ENDING = "-ensemble"
METADATA_KEY = "pemviz-pem"
POSITION_METADATA_KEY = "pemviz-position-errors"
FORMAT_VERSION = 1
POSITION_PARTS = {"mean": (4,), "log_scale": (6,), "tail": (1,), "memory": (2,)}
"""Shape of each tensor of a kind of position error."""
_MEMBER = re.compile("[0-9]{1,6}")
_OBJECT_NAME = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")

StoredPem = NetworkPem | TreesPem | TabulatedPem | EnsemblePem
Tensors = Mapping[str, AnyArray]


def shipped_pems() -> tuple[str, ...]:
    """Names of the models that come with pemviz."""
    return _shipped(ASSET_FOLDER)


def shipped_position_errors() -> tuple[str, ...]:
    """Names of the models of position errors that come with pemviz."""
    return _shipped(POSITION_ASSET_FOLDER)


def _shipped(folder: str) -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in asset_path(folder).glob(f"*{SUFFIX}")))


def load_pem(name_or_path: str, *, allow_python: bool = False) -> Pem:
    """Load a shipped model by name, a model file by path, or an allowed Python object.

    Args:
        name_or_path: a name of shipped_pems(); or a path to ``.safetensors`` (ours or the
            authors' format) or ``.csv`` (columns distance_m and p_detected); or, if allowed,
            ``module:attribute``, where a class or function without arguments is called. What it
            gives needs ``logit`` alone; without a digest of its own it has that of its module.
        allow_python: whether code of the user's may run.

    Raises:
        PemError: no such model, or one that cannot be used; one line says why.

    Example:
        >>> import numpy as np
        >>> from pemviz.pem import SALIENT_COLUMNS, load_pem
        >>> pem = load_pem("ml-nn")
        >>> size = {"height_m": 1.5, "width_m": 1.6, "length_m": 3.9}
        >>> heading = {"alpha_rad": -np.pi / 2, "rotation_y_rad": -np.pi / 2}  # as the ego
        >>> car = {"y_m": 1.65, "z_m": 12.0, **size, **heading}  # the rest 0: in plain view
        >>> logit = pem.logit(np.array([[car.get(name, 0.0) for name in SALIENT_COLUMNS]]))
        >>> print((1 / (1 + np.exp(logit))).round(4))  # P(missed) at 12 m
        [0.0113]
    """
    if name_or_path in shipped_pems():
        return load_file(asset_path(ASSET_FOLDER, f"{name_or_path}{SUFFIX}"))
    path = Path(name_or_path)
    if path.suffix == SUFFIX:
        return load_file(path)
    if path.suffix == ".csv":
        return load_csv(path)
    if is_python(name_or_path):
        return _load_object(name_or_path, allowed=allow_python)
    if is_file(path):
        raise PemError(f"{path}: not a {SUFFIX} or .csv file; torch and pickle files are refused")
    raise PemError(
        f"no perception error model {name_or_path!r}; give one of {', '.join(shipped_pems())}, "
        f"a path to {SUFFIX} or .csv, or an allowed module:attribute"
        f"{did_you_mean(name_or_path, shipped_pems())}"
    )


def is_python(name_or_path: str) -> bool:
    """Whether it names an object of a module, ``module:attribute``."""
    return _OBJECT_NAME.fullmatch(name_or_path) is not None


def _load_object(text: str, *, allowed: bool) -> Pem:
    """Import ``module:attribute``, which runs the module's code."""
    if not allowed:
        raise PemError(
            f"{text!r} would run Python code: allow that on the command line (--allow-python), "
            "or give a file"
        )
    module_name, attribute = text.split(":")
    try:
        module = import_module(module_name)
        model: object = module
        for part in attribute.split("."):
            model = getattr(model, part)
        # A class passes for a model by its attributes: it is an instance that answers.
        if isinstance(model, type) or (not hasattr(model, "logit") and callable(model)):
            model = model()
    except BaseException as error:  # the user's code may raise anything
        here = isinstance(error, ModuleNotFoundError) and is_file(Path(f"{error.name}.py"))
        hint = "; PYTHONPATH=. before the command has Python look in this folder" * here
        raise PemError(f"{text!r} cannot be imported: {exception_text(error)}{hint}") from error
    try:
        pem = as_pem(cast("DetectorModel", model))
    except PemError as error:
        raise PemError(f"{text!r} is no perception error model: {error}") from error
    source = getattr(module, "__file__", None)
    if not isinstance(pem, OwnPem) or source is None or not Path(source).is_file():
        return pem
    return replace(pem, digest=file_digest(Path(source)))  # an edited module is another model


def load_ensemble(name_or_path: str) -> PemEnsemble:
    """Load an ensemble by shipped name or path.

    Raises:
        PemError: no such model, or it is no ensemble.
    """
    pem = load_pem(name_or_path)
    if not isinstance(pem, PemEnsemble):
        raise PemError(f"{name_or_path!r} is a single model, not an ensemble")
    return pem


def ensemble_of(name_or_path: str) -> PemEnsemble | None:
    """The ensemble that says how uncertain a model is, if there is one.

    For a shipped ``ml-nn`` that is the shipped ``ml-nn-ensemble``, for a file ``own.safetensors``
    the file ``own-ensemble.safetensors`` beside it; an ensemble is its own.

    Raises:
        PemError: the ensemble is there but cannot be used, or belongs to another model.
    """
    if name_or_path in shipped_pems():
        partner = f"{name_or_path.removesuffix(ENSEMBLE_ENDING)}{ENSEMBLE_ENDING}"
        return load_ensemble(partner) if partner in shipped_pems() else None
    path = Path(name_or_path)
    if path.suffix != SUFFIX or not is_file(path):
        return None
    beside = path.with_name(f"{path.stem.removesuffix(ENSEMBLE_ENDING)}{ENSEMBLE_ENDING}")
    beside = beside.with_suffix(SUFFIX)
    pem = load_pem(name_or_path)
    if not is_file(beside):
        return pem if isinstance(pem, PemEnsemble) else None
    ensemble = load_ensemble(str(beside))
    _check_that_refits(ensemble, pem, beside=beside, path=path)
    return ensemble


def _check_that_refits(ensemble: PemEnsemble, pem: Pem, *, beside: Path, path: Path) -> None:
    """A file of an earlier fit, left beside a newer one, would answer another question."""
    if not (isinstance(pem, Carded) and isinstance(ensemble, Carded)):
        return
    refits, model = ensemble.card, pem.card
    told = (refits.data_digest, model.data_digest)
    if refits.model != model.model:
        differ = f"of kind {refits.model}, the model {model.model}"
    elif all(told) and told[0] != told[1]:
        differ = f"fitted to data of SHA-256 {told[0][:16]}, the model to {told[1][:16]}"
    else:
        return
    raise PemError(f"{beside}: its members are {differ} ({path.name}): fit both anew, or move it")


def save_pem(pem: StoredPem, path: Path) -> None:
    """Write a model as safetensors; the same model gives the same bytes."""
    card = asdict(pem.card)
    for name in ("memory", "check"):  # a card of a model without has no such entry
        if not card[name]:
            del card[name]
    header = {"kind": pem.kind, "options": pem.options(), "card": card}
    _save(pem.tensors(), header, path, key=METADATA_KEY)


def save_position_errors(model: PositionErrorModel, path: Path) -> None:
    """Write a model of position errors as safetensors; the same model gives the same bytes."""
    header = {"axes": [axis.name for axis in model.axes], "card": asdict(model.card)}
    _save(model.tensors(), header, path, key=POSITION_METADATA_KEY)


def _save(tensors: Tensors, header: Mapping[str, Any], path: Path, *, key: str) -> None:
    text = json.dumps({"version": FORMAT_VERSION, **header}, sort_keys=True, allow_nan=False)
    contiguous = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    write_bytes(path, save(contiguous, metadata={key: text}))


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


def _header(text: str, types: Mapping[str, type], *, where: str) -> Mapping[str, Any]:
    """The metadata of our files, with its entries of these types."""
    try:
        header: Any = parse_json(text)
    except ValueError as error:
        raise PemError(f"{where}: metadata is not JSON ({error})") from None
    if not isinstance(header, dict) or header.get("version") != FORMAT_VERSION:
        raise PemError(f"{where}: metadata does not say 'version' {FORMAT_VERSION}")
    if not all(isinstance(header.get(name), kind) for name, kind in types.items()):
        *first, last = map(repr, types)
        raise PemError(f"{where}: metadata lacks {', '.join(first)} or {last}")
    return header


def _exactly(tensors: Tensors, wanted: set[str], *, where: str) -> None:
    if set(tensors) != wanted:
        raise PemError(
            f"{where}: lacks tensors {sorted(wanted - set(tensors))}, "
            f"has unknown {sorted(set(tensors) - wanted)}"
        )


@dataclass(frozen=True)
class _Stored:
    """What a file of ours holds of an error model of misses, or of a member of an ensemble."""

    tensors: Tensors
    kind: str
    options: Mapping[str, Any]
    card: PemCard
    where: str

    def table(self) -> TabulatedPem:
        _exactly(self.tensors, {"table.distance_m", "table.logit"}, where=self.where)
        distance_m = as_double(self.tensors["table.distance_m"])
        logit = as_double(self.tensors["table.logit"])
        return TabulatedPem(
            self.card,
            distance_m,
            logit,
            self.options.get("between", ""),
            measure=self.options.get("measure", "ahead"),
            sensor_ahead_m=self._number("sensor_ahead_m") or 0.0,
            tau_s=self._number("tau_s"),
        )

    def _number(self, name: str) -> float | None:
        """An option that is a number; ``None`` where there is none."""
        value: object = self.options.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise PemError(f"{self.where}: metadata option {name!r} must be a number")
        return float(value)

    def ensemble(self) -> EnsemblePem:
        grouped: dict[str, dict[str, AnyArray]] = {}
        for name, array in self.tensors.items():
            prefix, _, rest = name.partition(".")
            index, _, inner = rest.partition(".")
            if prefix != "members" or not _MEMBER.fullmatch(index) or not inner:
                raise PemError(f"{self.where}: unknown tensor {name!r}")
            grouped.setdefault(index, {})[inner] = array
        kind = str(self.options.get("member_kind"))
        members: list[SingleModel] = []
        for index in sorted(grouped):
            card = replace(self.card, name=f"{self.card.name}[{int(index)}]")
            where = f"{self.where} member {index}"
            members.append(_Stored(grouped[index], kind, self.options, card, where).single())
        return EnsemblePem(self.card, tuple(members))

    def single(self) -> SingleModel:
        if self.kind == "network":
            return self._network()
        if self.kind == "trees":
            return self._trees()
        raise PemError(f"{self.where}: unknown kind of model {self.kind!r}")

    def _network(self) -> NetworkPem:
        own = features_from_json(self.options.get("features"), where=self.where)
        self._check_inputs(input_names(own))
        count = sum(name.endswith(".weight") for name in self.tensors)
        names = {f"layers.{index}.{part}" for index in range(count) for part in ("weight", "bias")}
        _exactly(self.tensors, names | {"pose.mean", "pose.std"}, where=self.where)
        doubles = {name: as_double(array) for name, array in self.tensors.items()}
        layers = tuple(
            Layer(weight=doubles[f"layers.{index}.weight"], bias=doubles[f"layers.{index}.bias"])
            for index in range(count)
        )
        return NetworkPem(self.card, doubles["pose.mean"], doubles["pose.std"], layers, own)

    def _trees(self) -> TreesPem:
        own = features_from_json(self.options.get("features"), where=self.where)
        given: object = self.options.get("feature_set")
        known: Mapping[object, FeatureSet | OwnSet] = {OWN: OWN}
        if own is None:
            known = {name: name for name in FEATURES}
        feature_set = known.get(given) if isinstance(given, str) else None
        if feature_set is None:
            raise PemError(f"{self.where}: metadata option 'feature_set' is {given!r}")
        self._check_inputs(seen_names(feature_set, own))
        parts = ("feature", "number", "left", "root")
        wanted = {*(f"trees.{part}" for part in parts), "calibration"}
        _exactly(self.tensors, wanted, where=self.where)
        return TreesPem(
            self.card,
            feature_set,
            feature=self.tensors["trees.feature"],
            number=as_double(self.tensors["trees.number"]),
            left=self.tensors["trees.left"],
            root=self.tensors["trees.root"],
            calibration=as_double(self.tensors["calibration"]),
            own=own,
        )

    def _check_inputs(self, expected: tuple[str, ...]) -> None:
        inputs = self.options.get("inputs")
        if inputs != list(expected):
            raise PemError(
                f"{self.where}: its inputs are {inputs}, this version computes {list(expected)}"
            )


def load_file(path: Path) -> StoredPem:
    """Read a model from a safetensors file, ours or the authors'.

    Raises:
        PemError: the file cannot be used; one line says why.
    """
    tensors, metadata = read_tensors(path)
    where = str(path)
    if METADATA_KEY not in metadata:
        if is_authors_checkpoint(tensors):
            return authors_pem(tensors, name=path.stem, where=where, source=metadata.get("source"))
        raise PemError(f"{where}: no {METADATA_KEY!r} metadata and no authors' tensor names")
    types = {"kind": str, "options": dict, "card": dict}
    header = _header(metadata[METADATA_KEY], types, where=where)
    card = card_from_mapping(header["card"], where=where)
    stored = _Stored(tensors, header["kind"], header["options"], card, where)
    if stored.kind == "ensemble":
        return stored.ensemble()
    return stored.table() if stored.kind == "table" else stored.single()


def is_position_errors(name_or_path: str) -> bool:
    """Whether a shipped name or a readable file is a model of position errors."""
    if name_or_path in shipped_position_errors():
        return True
    path = Path(name_or_path)
    return path.suffix == SUFFIX and POSITION_METADATA_KEY in read_tensors(path)[1]


def load_position_errors(name_or_path: str) -> PositionErrorModel:
    """Load a shipped model of position errors by name, or a file by path.

    Raises:
        PemError: There is none, or the file cannot be used; one line says why.
    """
    path = Path(name_or_path)
    if name_or_path in shipped_position_errors():
        path = asset_path(POSITION_ASSET_FOLDER, f"{name_or_path}{SUFFIX}")
    elif path.suffix != SUFFIX:
        raise PemError(
            f"no model of position errors {name_or_path!r}; give one of "
            f"{', '.join(shipped_position_errors())}, or a path to {SUFFIX}"
        )
    tensors, metadata = read_tensors(path)
    where = str(path)
    if POSITION_METADATA_KEY not in metadata:
        raise PemError(f"{where}: no model of position errors ('pemviz pem fit --position-errors')")
    header = _header(metadata[POSITION_METADATA_KEY], {"axes": list, "card": dict}, where=where)
    if not all(isinstance(name, str) for name in header["axes"]):
        raise PemError(f"{where}: metadata field 'axes' must hold text")

    def taken(name: str, shape: tuple[int, ...]) -> FloatArray:
        array = tensors.pop(name, None)
        if array is None or array.shape != shape:
            found = "missing" if array is None else f"of shape {list(array.shape)}"
            raise PemError(f"{where}: tensor {name!r} is {found}, need {list(shape)}")
        return as_double(array)

    def axis(name: str) -> ErrorAxis:
        parts = {part: taken(f"{name}.{part}", shape) for part, shape in POSITION_PARTS.items()}
        return ErrorAxis(
            name=name,
            mean=parts["mean"],
            log_scale=parts["log_scale"],
            degrees_of_freedom=float(parts["tail"][0]),
            memory=NoiseMemory(*parts["memory"].tolist()),
        )

    axes = tuple(axis(name) for name in header["axes"])
    (near, far), (left, right) = taken("ends", (2, 2)).tolist()
    correlation = taken("correlation", (len(axes), len(axes)))
    bins: list[FloatArray] = []
    if BINS in tensors:
        count = tensors[BINS].shape[:1][0] if tensors[BINS].ndim else 0
        shapes = {BINS: (count,), BIN_MEANS: (count, len(axes)), BIN_DEVIATIONS: (count, len(axes))}
        bins = [taken(name, shape) for name, shape in shapes.items()]
        bins.append(taken(BIN_SENSOR, (1,)))
    if tensors:
        raise PemError(f"{where}: unknown tensors {sorted(tensors)}")
    try:
        model = PositionErrorModel(
            axes=axes,
            correlation=correlation,
            distance_m=(near, far),
            bearing_rad=(left, right),
            card=position_card_from_mapping(header["card"], where=where),
        )
        return BinnedPositionErrors.of(model, *bins) if bins else model
    except PemError as error:
        raise PemError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from None
