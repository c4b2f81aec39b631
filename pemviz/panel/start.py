"""What the panel shows when it starts: never an empty page."""

import logging
from dataclasses import replace
from pathlib import Path

from pemviz.config.toml_files import load_preset
from pemviz.errors import InputError
from pemviz.panel.controller import Controller
from pemviz.panel.loading import load_run
from pemviz.panel.recordings import RecordingsFolder, sample_folder

LOG = logging.getLogger(__name__)

QUICK_ROLLOUTS = 200


def show_something(controller: Controller, recordings: RecordingsFolder) -> None:
    """Show the shipped sample, else the newest readable run, else a quick look that is not kept."""
    candidates: list[Path] = []
    sample = sample_folder()
    if sample is not None:
        candidates.append(sample)
    candidates += [recordings.root / name for name in recordings.names()]
    for folder in candidates:
        try:
            controller.show(load_run(folder))
        except InputError as error:
            LOG.warning("%s", error)
        else:
            return
    quick = replace(load_preset("paper"), method="naive", final_rollouts=QUICK_ROLLOUTS)
    controller.start(quick, keep=False)
