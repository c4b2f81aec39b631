"""Recordings of runs for the rerun viewer: writing and opening ``run.rrd``."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pemviz.recording.recorder import Recorder

__all__ = ["Recorder"]


def __getattr__(name: str) -> Any:
    """``Recorder``, imported when asked for: opening a recording needs nothing that heavy."""
    if name == "Recorder":
        from pemviz.recording.recorder import Recorder  # noqa: PLC0415

        return Recorder
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
