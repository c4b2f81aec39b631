"""What several of the ``pem`` commands ask of their options before they begin."""

import sys
from collections.abc import Iterable
from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.atomic import is_folder


def check_out(out: Path | None, *, ending: str) -> None:
    """Whether a file of this kind can be written there.

    Raises:
        PemError: It has another ending, or lies in no folder.
    """
    if out is None:
        return
    if out.suffix != ending:
        raise PemError(f"out is {str(out)!r}, must end in {ending}")
    if not is_folder(out.parent):
        raise PemError(f"out: no folder {str(out.parent)!r}")


def check_seed(seed: int) -> None:
    """Whether it is one.

    Raises:
        PemError: It is below 0.
    """
    if seed < 0:
        raise PemError(f"seed is {seed}, allowed: 0 or more")


def feature_names(given: str) -> tuple[str, ...]:
    """Names of columns that an option has between commas; none of an empty one."""
    return tuple(name.strip() for name in given.split(",")) if given else ()


def check_rate_hz(rate_hz: float | None) -> None:
    """Whether it is one, where it is given.

    Raises:
        PemError: It is not above 0, or not finite.
    """
    if rate_hz is not None and not 0.0 < rate_hz < float("inf"):
        raise PemError(f"rate_hz is {rate_hz:g}, allowed: above 0")


def check_table_out(out: Path, *, with_parquet: bool) -> None:
    """Whether a table can be written under this name: any but that of another form.

    Raises:
        PemError: It ends in .parquet where CSV is written, or as a file of Arrow's.
    """
    if out.suffix in (".arrow", ".feather") or (out.suffix == ".parquet" and not with_parquet):
        allowed = ".csv, or .parquet with format log"
        raise PemError(f"out = {out}: a table is written as {allowed}")


def tell_doubts(doubts: Iterable[str]) -> None:
    """Say on standard error what looks wrong, but may be meant."""
    for line in doubts:
        print(f"warning: {line}", file=sys.stderr)
