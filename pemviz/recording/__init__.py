"""Recordings of runs for the rerun viewer: ``run.rrd``."""

from pemviz.recording.recorder import Recorder

__all__ = ["Recorder"]
