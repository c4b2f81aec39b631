"""What a user of pemviz predicts from labelled frames: its own commands, and nothing else.

``pem collect``, ``pem fit --memory`` (which also checks the model against the sequences that each
part of it did not see), and ``record`` in five variants: misses independent, with the memory time
alone, with the frailty alone, with both, each with the value that was fitted for that variant, and
with a visibility that comes and goes. Then ``pem check`` of the fitted model on as many sequences
that it has not seen.
"""

import csv
import io
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pemviz.files.atomic import write_text
from pemviz.pem.models.varying_frailty import VaryingFrailty
from studies.detector_in_the_loop.drives import FRAMES
from studies.detector_in_the_loop.labelled import RATE_HZ
from studies.detector_in_the_loop.settings import Setting
from studies.detector_in_the_loop.training import IOU_ABOVE

SCENARIO_SIZE = ("1.53", "1.63", "4.5")
"""Height, width, length of the lead car of pemviz's braking scenario [m]."""
ROUNDED_M = 0.5
KIND = "ml-nn"
"""Of error model; boosted trees do not follow how steeply P(missed) falls near by."""
VISIBILITY = "visibility"
VARIANTS = ("independent", "memory", "frailty", "both", VISIBILITY)
"""As ``pem check`` names them; the last one has a visibility that comes and goes."""


class CommandError(RuntimeError):
    """A command of pemviz's failed."""


def pemviz(arguments: Sequence[object], *, allowed: tuple[int, ...] = (0,)) -> str:
    """What ``pemviz ARGUMENTS`` prints.

    Raises:
        CommandError: It ends with another exit code than is allowed.
    """
    words = [sys.executable, "-m", "pemviz", *(str(one) for one in arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(  # noqa: S603  our own command
        words, capture_output=True, text=True, check=False, env=environment
    )
    if done.returncode not in allowed:
        raise CommandError(f"{' '.join(words[1:])}: {done.stderr.strip()[-500:]}")
    return done.stdout


@dataclass(frozen=True)
class Variant:
    """An error model with what was fitted of its memory.

    Attributes:
        tau_s: Memory time [s].
        frailty: Frailty; of a visibility that comes and goes, what lasts.
        refuted: Quantities that are refuted on the sequences it was fitted to, out of fold.
        unseen: Quantities that are refuted on sequences that it has not seen, by name.
        varying: Of such a visibility, what comes and goes; 0: it is none.
        varying_s: Its time [s].
    """

    tau_s: float
    frailty: float
    refuted: int
    unseen: tuple[str, ...]
    varying: float = 0.0
    varying_s: float = 0.0

    @property
    def law(self) -> tuple[float, float] | VaryingFrailty:
        """Memory time and frailty, or the visibility."""
        if self.varying:
            return VaryingFrailty(self.frailty, self.varying, self.varying_s)
        return self.tau_s, self.frailty

    @property
    def options(self) -> tuple[str, ...]:
        """Of ``record``; the model carries what comes and goes."""
        if self.varying:
            return "--memory-law", VISIBILITY
        return "--memory-s", f"{self.tau_s:g}", "--frailty", f"{self.frailty:g}"


@dataclass(frozen=True)
class Fitted:
    """An error model.

    Attributes:
        path: The model.
        variants: By :data:`VARIANTS`; without the last where it was not fitted.
    """

    path: Path
    variants: dict[str, Variant]


def subset(folder: Path, out: Path, names: Sequence[str]) -> None:
    """A folder of some of the sequences' files."""
    for kind in ("label_02", "boxes"):
        (out / kind).mkdir(parents=True, exist_ok=True)
        for name in names:
            shutil.copyfile(folder / kind / f"{name}.txt", out / kind / f"{name}.txt")


def collected(folder: Path, table: Path, *, threshold: float) -> Path:
    """The table of a folder's sequences, by ``pem collect``."""
    if not table.exists():
        pemviz(
            [
                *("pem", "collect", "--labels", folder / "label_02"),
                *("--detections", folder / "boxes", "--format", "mot", "--types", "Car"),
                *("--iou-above", IOU_ABOVE, "--score-from", threshold),
                *("--rate-hz", f"{RATE_HZ:g}", "--out", table),
            ]
        )
    return table


def coarsened(table: Path) -> None:
    """Take out of a table what the scenario does not vary, in place.

    The scenario has one car, straight ahead to the last millimetre; the loop has many, and the ego
    has a place in its lane. A model with such features is asked about a car that hardly anybody
    labelled: of its own size, exactly where the detector's cells meet. So all cars get the
    scenario's size, and x is rounded to half a metre, alpha with it. How bodies and places differ
    then is hidden, as light and weather are.
    """
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    size = dict(zip(("height_m", "width_m", "length_m"), SCENARIO_SIZE, strict=True))
    words = io.StringIO()
    writer = csv.DictWriter(words, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        x_m = round(float(row["x_m"]) / ROUNDED_M) * ROUNDED_M
        rotation = -math.pi / 2 + round((float(row["rotation_y_rad"]) + math.pi / 2) / 0.05) * 0.05
        alpha = rotation - math.atan2(x_m, float(row["z_m"]))
        place = {
            "x_m": f"{x_m + 0.0:g}",
            "rotation_y_rad": f"{rotation:.10g}",
            "alpha_rad": f"{alpha:.10g}",
        }
        writer.writerow({**row, **size, **place})
    write_text(table, words.getvalue())


def sequences_for(frames: int) -> int:
    """How many sequences have so many frames."""
    return -(-frames // FRAMES)


def fitted(
    train: Path,
    other: Path,
    folder: Path,
    *,
    threshold: float,
    coarse: bool = True,
    varying: bool = True,
) -> Fitted:
    """Collect, fit with memory, and check on other sequences; what is there is kept.

    Without ``coarse`` the tables are as they come: see :func:`coarsened`. Without ``varying`` the
    law of a visibility that comes and goes is left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "fitted.json"
    if not kept.exists():
        table = collected(train, folder / "train.csv", threshold=threshold)
        unseen = collected(other, folder / "held-out.csv", threshold=threshold)
        if coarse:
            coarsened(table)
            coarsened(unseen)
        model = folder / "model.safetensors"
        laws = ["--memory", *(["--varying-frailty"] if varying else [])]
        pemviz(["pem", "fit", "--table", table, "--model", KIND, *laws, "--out", model])
        told = pemviz(["pem", "check", "--table", unseen, "--pem", model, "--json"])
        write_text(kept, told)
    card = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    seen = {one["name"]: one for one in card["check"]["variants"]}
    told = json.loads(kept.read_text(encoding="utf-8"))["check"]
    unseen = {one["name"]: one["quantities"] for one in told["variants"]}
    variants = {
        name: Variant(
            tau_s=seen[name]["tau_s"],
            frailty=seen[name]["frailty"],
            refuted=sum(quantity["refuted"] for quantity in seen[name]["quantities"]),
            unseen=tuple(q["name"] for q in unseen.get(name, ()) if q["refuted"]),
        )
        for name in VARIANTS
        if name in seen
    }
    # a run takes what the card keeps: fitted to all sequences
    both, memory = variants.get("both"), card["memory"]["fit"]["memory"]
    if both is not None:
        variants["both"] = replace(both, tau_s=memory["tau_s"], frailty=memory["frailty"])
    if VISIBILITY in variants:
        variants[VISIBILITY] = replace(variants[VISIBILITY], **card["memory"]["varying"]["law"])
    elif varying:
        raise CommandError(f"{folder}: fitted without a check of the visibility; delete it")
    return Fitted(folder / "model.safetensors", variants)


def recorded(
    setting: Setting, model: Path, *, memory: Sequence[object], out: Path, seed: int = 1
) -> dict[str, Any]:
    """What ``record`` answers with options of how misses hang together; what is there is kept."""
    if not out.exists():
        told = pemviz(
            [
                *("record", *setting.world.options, "--pem", model),
                *memory,
                *("--no-measured-memory", "--seed", seed, "--json"),
                *("--out", out.parent / "runs"),
            ],
            allowed=(0, 1, 4),
        )
        write_text(out, told)
    return json.loads(out.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Answer:
    """What a run of ``record`` says.

    Attributes:
        probability: Its estimate.
        low: Lower end of its 95 % interval; ``None`` without one.
        high: Upper end.
        warnings: In words.
    """

    probability: float
    low: float | None
    high: float | None
    warnings: tuple[str, ...]

    @property
    def misfits(self) -> int:
        """Warnings that P(missed) is not what was counted in the table, by distance."""
        return sum(words.startswith("misfit") for words in self.warnings)

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Answer":
        """From what it prints with ``--json``."""
        estimate = document["estimate"]
        words = tuple(document["warnings"])
        return Answer(estimate["probability"], estimate["ci_low"], estimate["ci_high"], words)


def mixed(parts: Sequence[tuple[float, Answer]]) -> Answer:
    """The answer for several kinds of light and weather together, with the share of each.

    Variances of independent estimates add, read from the half widths of their intervals.
    """
    probability = sum(share * one.probability for share, one in parts)
    halves = [
        share * (one.high - one.low) / 2.0
        for share, one in parts
        if one.low is not None and one.high is not None
    ]
    wide = math.sqrt(sum(half**2 for half in halves))
    bounded = len(halves) == len(parts)
    return Answer(
        probability,
        max(0.0, probability - wide) if bounded else None,
        probability + wide if bounded else None,
        tuple(words for _, one in parts for words in one.warnings),
    )
