"""What all browsers share."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pemviz.panel.controller import Controller
from pemviz.panel.loading import LoadedRuns
from pemviz.panel.recordings import RecordingsFolder

OpenRecording = Callable[[Path], str]


@dataclass(frozen=True)
class Hub:
    """What all browsers share.

    Attributes:
        controller: Runs experiments.
        recordings: The runs kept.
        open_recording: Serves a recording to a viewer and returns the viewer's address;
            ``None`` where there is no viewer.
        loaded: Runs that browsers have loaded.
    """

    controller: Controller
    recordings: RecordingsFolder
    open_recording: OpenRecording | None = None
    loaded: LoadedRuns = field(default_factory=LoadedRuns)
