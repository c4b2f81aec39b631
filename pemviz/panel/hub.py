"""What all pages share: the controller, the folder of runs, what was read of them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pemviz.panel.controller import Controller
from pemviz.panel.loading import LoadedRuns
from pemviz.panel.recordings_folder import RecordingsFolder

OpenRecording = Callable[[Path], str]


@dataclass(frozen=True)
class Hub:
    """What all pages share.

    Attributes:
        open_recording: Serves a recording to a viewer and returns the viewer's address;
            ``None`` where there is no viewer.
    """

    controller: Controller
    recordings: RecordingsFolder
    open_recording: OpenRecording | None = None
    loaded: LoadedRuns = field(default_factory=LoadedRuns)
