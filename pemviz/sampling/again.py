"""How descriptions name :mod:`pemviz.sampling.recount`, which is slow to import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pemviz.sampling.kept import KeptRepetition, Recounted


def counted_again(kept: KeptRepetition) -> Recounted:
    """The share of violations among the final stages' rollouts."""
    from pemviz.sampling.recount import counted  # noqa: PLC0415  slow to import

    return counted(kept)


def averaged_again(kept: KeptRepetition) -> Recounted:
    """The average weight of violations, likewise."""
    from pemviz.sampling.recount import averaged  # noqa: PLC0415  slow to import

    return averaged(kept)
