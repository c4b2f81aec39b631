"""A perception error model given as a table of distance and probability."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.text_files import open_text, read_numbers
from pemviz.pem.models.cards import Carded, PemCard
from pemviz.pem.models.protocol import COLUMN, as_rows, check_finite, check_rows, tensors_digest

Between = Literal["linear", "step"]

CSV_COLUMNS = ("distance_m", "p_detected")


@dataclass(frozen=True, eq=False)
class TabulatedPem(Carded):
    """P(detected) by distance z; outside the table the nearest point's value holds.

    Raises:
        PemError: it is no table; one line says why.
    """

    kind: ClassVar[str] = "table"

    card: PemCard
    distance_m: FloatArray
    """Increasing distances z along the camera's axis [m], shape [points]."""
    table_logit: FloatArray
    """Logit of P(detected) at each, shape [points]."""
    between: Between = "linear"
    """Between points the logit is linear, or (step) stays what it was at the lower distance."""

    def __post_init__(self) -> None:
        name = self.card.name
        check_finite(self.tensors(), where=name)
        if self.distance_m.ndim != 1 or self.distance_m.shape != self.table_logit.shape:
            raise PemError(f"{name}: distances and probabilities differ in shape")
        if len(self.distance_m) == 0 or (self.distance_m[1:] <= self.distance_m[:-1]).any():
            raise PemError(f"{name}: distances must be there and increase")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            slope = np.diff(self.table_logit) / np.diff(self.distance_m)
            extent_m = np.ptp(self.distance_m)
        if not (np.isfinite(slope).all() and np.isfinite(extent_m)):
            raise PemError(f"{name}: points so far apart that lines between them overflow")
        if self.between not in ("linear", "step"):
            raise PemError(f"{name}: between is {self.between!r}, allowed: linear, step")

    @property
    def digest(self) -> str:
        """SHA-256 of the table."""
        return tensors_digest(f"{self.kind}:{self.between}", self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        return {"table.distance_m": self.distance_m, "table.logit": self.table_logit}

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors."""
        return {"between": self.between}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11]."""
        rows, shape = as_rows(salient)
        check_rows(rows)
        z_m = rows[:, COLUMN["z_m"]]
        if self.between == "step":
            index = np.searchsorted(self.distance_m, z_m, side="right") - 1
            return self.table_logit[np.maximum(index, 0)].reshape(shape)
        return np.interp(z_m, self.distance_m, self.table_logit).reshape(shape)


def load_csv(path: Path) -> TabulatedPem:
    """Read a table with the columns distance_m and p_detected.

    Raises:
        PemError: naming file, line and what is wrong there.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    with open_text(path) as stream:
        header = tuple(name.strip() for name in stream.readline().split(","))
    if header != CSV_COLUMNS:
        raise PemError(f"{path}:1: the header must be {','.join(CSV_COLUMNS)}")
    values = read_numbers(path, separator=",", columns=CSV_COLUMNS, skip_lines=1)
    probability = values[:, 1]
    if not ((probability > 0.0) & (probability < 1.0)).all():
        raise PemError(f"{path}: p_detected must lie strictly between 0 and 1 in every row")
    card = PemCard(
        name=path.stem,
        model="table",
        data=f"not stated (table {path.name})",
        licence="not stated (a table of the user's)",
        recipe="tabulated",
    )
    return TabulatedPem(card, values[:, 0], np.log(probability) - np.log1p(-probability))
