"""The truth, counted: plain rollouts of the closed loop in blocks, each kept once it is done."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import beta

from pemviz.files.atomic import write_text
from studies.detector_in_the_loop.detector import Detector
from studies.detector_in_the_loop.loop import Driven, Loop
from studies.detector_in_the_loop.scene import LIGHTS, WEATHERS, draw_scenes
from studies.detector_in_the_loop.settings import BLOCK, ENOUGH, TRUTH, Setting, seeds


@dataclass(frozen=True)
class Count:
    """What rollouts came to.

    Attributes:
        failed: That broke the rule.
        rollouts: In all.
        frames: That were rendered and looked at.
        by_hidden: Failed and all by light and weather.
    """

    failed: int
    rollouts: int
    frames: int
    by_hidden: dict[str, tuple[int, int]]

    @property
    def probability(self) -> float:
        """Their share."""
        return self.failed / max(self.rollouts, 1)

    @property
    def interval(self) -> tuple[float, float]:
        """At 95 % (Clopper & Pearson 1934)."""
        return exact_interval(self.failed, self.rollouts)


def exact_interval(events: int, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """The interval of a binomial share (Clopper & Pearson 1934, Biometrika 26:404)."""
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if events == 0 else float(beta.ppf(tail, events, trials - events + 1))
    high = 1.0 if events == trials else float(beta.ppf(1.0 - tail, events + 1, trials - events))
    return low, high


def driven_block(setting: Setting, detector: Detector, *, block: int, rollouts: int) -> Driven:
    """The rollouts of a block; those of a smaller one are the first of a larger."""
    scenes = block_scenes(setting, block).take(np.arange(rollouts))
    start = seeds(TRUTH, *_place(setting), block, 1)
    normals = np.random.default_rng(start).standard_normal((BLOCK, setting.world.starts))
    loop = Loop(setting.world, detector, setting.threshold(detector.threshold))
    return loop.drive(scenes, normals[:rollouts])


def block_scenes(setting: Setting, block: int):  # noqa: ANN201  Scenes
    """The scenes of a block."""
    own = seeds(TRUTH, *_place(setting), block, 0)
    return draw_scenes(setting.domain, count=BLOCK, cars=setting.world.cars, seeds=own)


def _place(setting: Setting) -> tuple[int, ...]:
    """Numbers that belong to a setting's name."""
    return tuple(setting.name.encode())


def count_block(setting: Setting, detector: Detector, folder: Path, *, block: int) -> bool:
    """Count the failures of a block and keep them in ``folder``.

    Nothing is done where they are kept, or where ``ENOUGH`` have failed in the blocks before.

    Returns:
        Whether it was counted.

    Raises:
        OSError: A file cannot be written.
    """
    path = _path(folder, setting, block)
    if path.exists() or counted(setting, folder).failed >= ENOUGH:
        return False
    driven = driven_block(setting, detector, block=block, rollouts=BLOCK)
    scenes = block_scenes(setting, block)
    kinds = [
        f"{LIGHTS[int(light)]}, {WEATHERS[int(weather)]}"
        for light, weather in zip(scenes.column("light"), scenes.column("weather"), strict=True)
    ]
    hidden = {
        kind: (
            sum(bool(f) for k, f in zip(kinds, driven.failed, strict=True) if k == kind),
            kinds.count(kind),
        )
        for kind in sorted(set(kinds))
    }
    document = {
        "failed": int(driven.failed.sum()),
        "rollouts": BLOCK,
        "frames": int(driven.looks.step.size),
        "hidden": hidden,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(document))
    return True


def counted(setting: Setting, folder: Path) -> Count:
    """What the blocks kept in ``folder`` come to: from the first to the one by which ENOUGH failed.

    So the count is the same however many processes work on blocks beside each other.
    """
    blocks, failed = [], 0
    while failed < ENOUGH and (path := _path(folder, setting, len(blocks))).exists():
        blocks.append(json.loads(path.read_text(encoding="utf-8")))
        failed += blocks[-1]["failed"]
    return summed(blocks)


def _path(folder: Path, setting: Setting, block: int) -> Path:
    return folder / setting.name / f"{block:04d}.json"


def summed(blocks: list[dict]) -> Count:  # pyright: ignore[reportMissingTypeArgument]
    """All blocks together."""
    hidden: dict[str, tuple[int, int]] = {}
    for block in blocks:
        for kind, (failed, all_) in block["hidden"].items():
            before = hidden.get(kind, (0, 0))
            hidden[kind] = (before[0] + failed, before[1] + all_)
    return Count(
        failed=sum(block["failed"] for block in blocks),
        rollouts=sum(block["rollouts"] for block in blocks),
        frames=sum(block["frames"] for block in blocks),
        by_hidden=hidden,
    )
