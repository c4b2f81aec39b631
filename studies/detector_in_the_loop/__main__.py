"""``python -m studies.detector_in_the_loop``: the study from nothing, or on from where it was."""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import torch

from pemviz.files.atomic import write_json
from studies.detector_in_the_loop.drives import DriveKind
from studies.detector_in_the_loop.page import write_page
from studies.detector_in_the_loop.settings import QUICK, SETTINGS, WHOLE
from studies.detector_in_the_loop.study import (
    document_of,
    predictions,
    reasons,
    tell_since,
    the_detector,
    truths,
)

LABELS = (*get_args(DriveKind), "fine")
PARTS = ("all", "detector", "truth", "predictions", "why")


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m studies.detector_in_the_loop")
    parser.add_argument("--out", type=Path, default=Path("detector-in-the-loop"))
    parser.add_argument("--quick", action="store_true", help="a small study, under 20 minutes")
    parser.add_argument("--part", choices=PARTS, default="all", help="do no more than this")
    every = [setting.name for setting in SETTINGS]
    parser.add_argument("--settings", nargs="+", choices=every, default=every)
    parser.add_argument("--share", type=float, help="of the rollouts of each setting, 0 to 1")
    parser.add_argument("--frames", type=int, nargs="+", help="labelled frames of predictions")
    parser.add_argument(
        "--labels", choices=LABELS, default="usual", help="predictions from others, alone"
    )
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    effort = QUICK if given.quick else WHOLE
    if given.share is not None:
        effort = replace(effort, share=given.share)
    if given.frames is not None:
        most = max(given.frames)
        by_kind = min(effort.frames_by_kind, most)
        effort = replace(effort, frames=tuple(given.frames), frames_by_kind=by_kind)
    tell = partial(tell_since, time.time())
    given.out.mkdir(parents=True, exist_ok=True)
    if given.labels != "usual":
        predictions(given.out, effort, names=given.settings, tell=tell, labels=given.labels)
        return 0
    if given.part == "detector":
        the_detector(given.out, effort, tell)
        return 0
    names, out = given.settings, given.out
    found = truths(out, effort, names=names, tell=tell) if given.part in {"all", "truth"} else {}
    rows = []
    if given.part in {"all", "predictions"}:
        rows = predictions(out, effort, names=names, tell=tell)
    why = reasons(out, effort, names=names, tell=tell) if given.part in {"all", "why"} else {}
    if given.part == "all":
        write_json(out / "results.json", document_of(rows, found, why))
        write_page(out, rows, found, why, effort=effort, tell=tell)
    return 0


if __name__ == "__main__":
    sys.exit(main())
