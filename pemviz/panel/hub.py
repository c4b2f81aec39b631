"""What all browsers share."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pemviz.panel.controller import Controller
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
    """

    controller: Controller
    recordings: RecordingsFolder
    open_recording: OpenRecording | None = None
