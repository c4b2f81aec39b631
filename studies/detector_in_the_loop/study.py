"""The parts of the study, in order; what is done is kept in files, and the same command goes on."""

import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch

from pemviz.files.atomic import write_text
from pemviz.pem import load_pem
from pemviz.processes import map_in_processes, usable_cpus
from studies.detector_in_the_loop.detector import Detector, load_detector, save_network
from studies.detector_in_the_loop.drives import DriveKind
from studies.detector_in_the_loop.labelled import AT_A_TIME, write_sequences
from studies.detector_in_the_loop.loop import Loop
from studies.detector_in_the_loop.predictions import (
    VARIANTS,
    Answer,
    Fitted,
    fitted,
    mixed,
    recorded,
    sequences_for,
    subset,
)
from studies.detector_in_the_loop.scene import LIGHTS, WEATHERS, Domain, draw_scenes
from studies.detector_in_the_loop.settings import (
    BLOCK,
    HELD_OUT,
    LABELLED,
    SETTINGS,
    TRAINING,
    VALIDATION,
    WHY,
    Effort,
    Setting,
    seeds,
)
from studies.detector_in_the_loop.splitting import of_runs, split_run
from studies.detector_in_the_loop.training import draw_pictures, quality_of, train
from studies.detector_in_the_loop.truth import Count, count_block, counted
from studies.detector_in_the_loop.why import Explained, explained
from studies.detector_in_the_loop.worlds import BrakingWorld

Item = TypeVar("Item")
Result = TypeVar("Result")
Tell = Callable[[str], None]
Labels = DriveKind | Literal["fine"]
"""Of predictions: from drives of a kind; ``fine``: with sizes and exact places as features."""
HIDDEN = "hidden"
"""The variant that knows light and weather: a model for each, with both memory and frailty."""
FEWEST_OF_A_KIND = 5
"""Sequences of a kind of light and weather without which it gets no model of its own."""
KINDS = tuple(f"{light}, {weather}" for light in LIGHTS for weather in WEATHERS)


@dataclass(frozen=True)
class Truth:
    """How likely a setting fails, with the detector in the loop.

    Attributes:
        probability: Counted, or by splitting.
        low: Of its 95 % interval.
        high: Likewise.
        how: In words.
        count: The plain rollouts.
    """

    probability: float
    low: float
    high: float
    how: str
    count: Count


@dataclass(frozen=True)
class Row:
    """A prediction.

    Attributes:
        setting: Its name.
        frames: Labelled.
        variant: One of :data:`.predictions.VARIANTS` or :data:`HIDDEN`.
        answer: Of ``record``.
        tau_s: With which memory time; ``None`` with several models.
        frailty: With which frailty, that lasts.
        refuted: Quantities refuted on the sequences that it was fitted to.
        unseen: Likewise on others, by name.
        varying: With which frailty that comes and goes.
        varying_s: In which time.
    """

    setting: str
    frames: int
    variant: str
    answer: Answer
    tau_s: float | None
    frailty: float | None
    refuted: int | None
    unseen: tuple[str, ...]
    varying: float = 0.0
    varying_s: float = 0.0


def tell_since(began_s: float, words: str) -> None:
    """Say on standard error what is done, and how long after a time of :func:`time.time`."""
    print(f"[{time.time() - began_s:6.0f} s] {words}", file=sys.stderr, flush=True)


def the_detector(folder: Path, effort: Effort, tell: Tell) -> Detector:
    """The detector: kept, or trained on scenes of its own, with its curve and card beside it."""
    path = folder / "detector.safetensors"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        network = train(
            pictures=effort.pictures,
            epochs=effort.epochs,
            seeds=seeds(TRAINING),
            on_epoch=lambda epoch, loss: tell(f"epoch {epoch}: loss {loss:.3f}"),
        )
        quality = quality_of(
            network, draw_pictures(count=effort.validation, seeds=seeds(VALIDATION))
        )
        threshold = quality.best_f1()
        step = max(1, quality.threshold.size // 400)
        document = {
            "pictures": effort.pictures,
            "epochs": effort.epochs,
            "validation": effort.validation,
            "average_precision": quality.average_precision,
            "threshold": threshold,
            "parameters": sum(each.numel() for each in network.parameters()),
            "curve": {name: getattr(quality, name)[::step].tolist() for name in asdict(quality)},
        }
        write_text(folder / "detector.json", json.dumps(document))
        save_network(network, path, threshold=threshold)
    return load_detector(path)


def labelled(
    folder: Path,
    domain: Domain,
    detector: Detector,
    *,
    frames: int,
    purpose: int,
    tell: Tell,
    kind: DriveKind = "usual",
) -> list[str]:
    """Names of a domain's sequences with that many frames; those that are missing are rendered."""
    wanted, place = sequences_for(frames), tuple(domain.name.encode())
    for start in range(0, wanted, AT_A_TIME):
        last = folder / HIDDEN / f"{min(start + AT_A_TIME, wanted) - 1:06d}.json"
        if last.exists():
            continue
        own = seeds(purpose, *place)
        count = min(AT_A_TIME, wanted - start)
        write_sequences(
            domain,
            detector,
            folder,
            count=count,
            seeds=own,
            offset=start,
            kind=kind,
        )
        tell(f"{domain.name}: {start + count} of {wanted} sequences labelled")
    return [f"{number:06d}" for number in range(wanted)]


def fitted_to(
    folder: Path,
    setting: Setting,
    detector: Detector,
    *,
    frames: int,
    tell: Tell,
    labels: Labels = "usual",
) -> tuple[Fitted, Path, Sequence[str], Path, Sequence[str]]:
    """The error model of a setting's detector from so many frames, checked on a fifth as many."""
    kind: DriveKind = "usual" if labels == "fine" else labels
    kept = partial(labelled, domain=setting.domain, detector=detector, tell=tell, kind=kind)
    data = folder / _named("labelled", kind) / setting.domain_name
    names = kept(data / "train", frames=frames, purpose=LABELLED)
    others = kept(data / "other", frames=max(frames // 5, 1_000), purpose=HELD_OUT)
    own = folder / _named("models", labels) / f"{setting.domain_name}_{setting.strict:g}_{frames}"
    if not (own / "fitted.json").exists():
        subset(data / "train", own / "train", names)
        subset(data / "other", own / "other", others)
    threshold = setting.threshold(detector.threshold)
    coarse = labels != "fine"
    model = fitted(own / "train", own / "other", own, threshold=threshold, coarse=coarse)
    return model, data / "train", names, own, others


def _named(kept: str, labels: Labels) -> str:
    return kept if labels == "usual" else f"{kept}-{labels}"


def possible(setting: Setting) -> tuple[str, ...]:
    """Variants that ``record`` can answer for: with several obstacles it takes no frailty."""
    return VARIANTS if setting.world.cars == 1 else VARIANTS[:2]


def predicted(
    folder: Path,
    setting: Setting,
    detector: Detector,
    *,
    frames: int,
    tell: Tell,
    labels: Labels = "usual",
) -> list[Row]:
    """What is predicted of a setting from so many labelled frames, each variant a row."""
    model, *_ = fitted_to(folder, setting, detector, frames=frames, tell=tell, labels=labels)
    answers, rows = folder / _named("answers", labels) / setting.name, list[Row]()
    answers.mkdir(parents=True, exist_ok=True)
    for name in VARIANTS:
        if (variant := model.variants.get(name)) is None or name not in possible(setting):
            continue
        told = recorded(
            setting,
            model.path,
            memory=variant.options,
            out=answers / f"{frames}_{name}.json",
        )
        answer = Answer.of(told)
        tell(f"{setting.name}, {frames} frames, {name}: {answer.probability:.2e}")
        rows.append(
            Row(
                setting=setting.name,
                frames=frames,
                variant=name,
                answer=answer,
                tau_s=variant.tau_s,
                frailty=variant.frailty,
                refuted=variant.refuted,
                unseen=variant.unseen,
                varying=variant.varying,
                varying_s=variant.varying_s,
            )
        )
    return rows


def predicted_by_kind(
    folder: Path, setting: Setting, detector: Detector, *, frames: int, tell: Tell
) -> list[Row]:
    """What is predicted if light and weather of each sequence were known: a model for each kind.

    Each kind counts by its share of the labelled sequences; those with too few are left to the
    model of all.
    """
    whole, data, names, own, others = fitted_to(folder, setting, detector, frames=frames, tell=tell)
    answers = folder / "answers" / setting.name
    kinds, other_kinds = _kinds(data, names), _kinds(data.parent / "other", others)
    parts: list[tuple[float, Answer]] = []
    for place, kind in enumerate(KINDS):
        mine = [name for name in names if kinds[name] == kind]
        theirs = [name for name in others if other_kinds[name] == kind]
        if not mine:
            continue
        model, where = whole, own / f"kind-{place}"
        if len(mine) >= FEWEST_OF_A_KIND and len(theirs) >= 2:
            if not (where / "fitted.json").exists():
                subset(data, where / "train", mine)
                subset(data.parent / "other", where / "other", theirs)
            threshold = setting.threshold(detector.threshold)
            model = fitted(
                where / "train", where / "other", where, threshold=threshold, varying=False
            )
        both = model.variants["both" if "both" in possible(setting) else "memory"]
        out = answers / f"{frames}_{HIDDEN}-{place}.json"
        told = recorded(setting, model.path, memory=both.options, out=out)
        parts.append((len(mine) / len(names), Answer.of(told)))
    answer = mixed(parts)
    tell(f"{setting.name}, {frames} frames, {HIDDEN}: {answer.probability:.2e}")
    return [Row(setting.name, frames, HIDDEN, answer, None, None, None, ())]


def _kinds(data: Path, names: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for name in names:
        told = json.loads((data / HIDDEN / f"{name}.json").read_text(encoding="utf-8"))
        found[name] = f"{told['light']}, {told['weather']}"
    return found


def predictions(
    folder: Path,
    effort: Effort,
    *,
    names: Sequence[str],
    tell: Tell,
    labels: Labels = "usual",
) -> list[Row]:
    """All predictions of the settings named, the fewest frames first; each domain in a process.

    From other labels than the usual ones without those by kind of light and weather.
    """
    the_detector(folder, effort, tell)
    groups = by_domain(setting for setting in SETTINGS if setting.name in names)
    rows = in_processes(partial(_predictions_of, folder, effort, tell, labels), groups)
    place = {setting.name: number for number, setting in enumerate(SETTINGS)}
    return sorted(chain.from_iterable(rows), key=lambda row: (row.frames, place[row.setting]))


def _predictions_of(
    folder: Path, effort: Effort, tell: Tell, labels: Labels, settings: Sequence[Setting]
) -> list[Row]:
    detector, rows = the_detector(folder, effort, tell), list[Row]()
    for frames, setting in product(effort.frames, settings):
        rows += predicted(folder, setting, detector, frames=frames, tell=tell, labels=labels)
    for setting in settings if labels == "usual" else ():
        frames = effort.frames_by_kind
        rows += predicted_by_kind(folder, setting, detector, frames=frames, tell=tell)
    return rows


def truths(folder: Path, effort: Effort, *, names: Sequence[str], tell: Tell) -> dict[str, Truth]:
    """The truth of each setting named: plain rollouts, and splitting where these show too little.

    Runs of splitting, which take longest, come first; then all settings' first blocks of rollouts,
    their second ones and so on.
    """
    the_detector(folder, effort, tell)
    chosen = [setting for setting in SETTINGS if setting.name in names]
    runs = [
        partial(_split, folder, effort, tell, setting, run)
        for setting in chosen
        for run in range(effort.splitting_runs if setting.levels_m else 0)
    ]
    blocks = [
        (block, place, partial(_count, folder, effort, tell, setting, block))
        for place, setting in enumerate(chosen)
        for block in range(-(-effort.rollouts_of(setting) // BLOCK))
    ]
    blocks.sort(key=lambda each: each[:2])
    in_processes(_called, [*runs, *(call for _, _, call in blocks)])
    return {setting.name: _truth(folder / "truth", setting) for setting in chosen}


def _called(call: Callable[[], None]) -> None:
    call()


def _count(folder: Path, effort: Effort, tell: Tell, setting: Setting, block: int) -> None:
    detector, kept = the_detector(folder, effort, tell), folder / "truth"
    if count_block(setting, detector, kept, block=block):
        count, wanted = counted(setting, kept), effort.rollouts_of(setting)
        tell(f"{setting.name}: {count.failed} of {count.rollouts} fail, {wanted} wanted")


def _split(folder: Path, effort: Effort, tell: Tell, setting: Setting, run: int) -> None:
    path = _run_path(folder / "truth", setting, run)
    if path.exists():
        return
    detector = the_detector(folder, effort, tell)
    loop = Loop(setting.world, detector, setting.threshold(detector.threshold))
    count = max(300, int(setting.particles * min(1.0, 5.0 * effort.share)))
    made = split_run(setting, loop, levels_m=np.array(setting.levels_m), count=count, run=run)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(asdict(made)))
    tell(f"{setting.name}, splitting: {made.probability:.2e}, {made.shares}")


def _run_path(folder: Path, setting: Setting, run: int) -> Path:
    return folder / f"{setting.name}-splitting" / f"{run:02d}.json"


def _truth(folder: Path, setting: Setting) -> Truth:
    count = counted(setting, folder)
    if not setting.levels_m:
        return Truth(count.probability, *count.interval, "counted", count)
    files = sorted(_run_path(folder, setting, 0).parent.glob("*.json"))
    runs = [json.loads(path.read_text(encoding="utf-8"))["probability"] for path in files]
    probability, low, high = of_runs(runs)
    if high == 1.0 and count.failed:
        apart = f"{len(runs)} runs of splitting, too different for an interval: {probability:.2g}"
        return Truth(count.probability, *count.interval, f"counted; {apart}", count)
    return Truth(probability, low, high, f"{len(runs)} runs of splitting", count)


def reasons(
    folder: Path, effort: Effort, *, names: Sequence[str], tell: Tell
) -> dict[str, Explained]:
    """Why predictions from the most labelled frames are off, in the braking scenario."""
    the_detector(folder, effort, tell)
    (folder / "why").mkdir(parents=True, exist_ok=True)
    chosen = [
        setting
        for setting in SETTINGS
        if setting.name in names and isinstance(setting.world, BrakingWorld)
    ]
    parts = in_processes(partial(_reasons_of, folder, effort, tell), by_domain(chosen))
    found = {name: one for part in parts for name, one in part.items()}
    return {setting.name: found[setting.name] for setting in chosen}


def _reasons_of(
    folder: Path, effort: Effort, tell: Tell, settings: Sequence[Setting]
) -> dict[str, Explained]:
    return {one.name: _reason_of(folder, effort, tell, one) for one in settings}


def _reason_of(folder: Path, effort: Effort, tell: Tell, setting: Setting) -> Explained:
    frames = effort.frames[-1]
    path = folder / "why" / f"{setting.name}_{frames}.json"
    if not path.exists():
        detector = the_detector(folder, effort, tell)
        model, *_ = fitted_to(folder, setting, detector, frames=frames, tell=tell)
        laws = {name: one.law for name, one in model.variants.items()}
        place = tuple(setting.name.encode())
        scenes = draw_scenes(setting.domain, count=effort.scenes, cars=1, seeds=seeds(WHY, *place))
        loop = Loop(setting.world, detector, setting.threshold(detector.threshold))
        made = explained(loop, scenes, load_pem(str(model.path)), laws)
        write_text(path, json.dumps(asdict(made)))
        tell(f"{setting.name}: all frames missed {made.all_missed:.2e}; {made.by_variant}")
    return Explained(**json.loads(path.read_text(encoding="utf-8")))


def by_domain(settings: Iterable[Setting]) -> list[list[Setting]]:
    """Settings that share labelled sequences and models together.

    The last domain has most kinds of light and weather, takes longest, and comes first.
    """
    found: dict[str, list[Setting]] = {}
    for setting in settings:
        found.setdefault(setting.domain_name, []).append(setting)
    return list(found.values())[::-1]


def in_processes(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The results of all, on every core; each process calculates with one thread."""
    return map_in_processes(partial(_alone, function), items, workers=usable_cpus())


def _alone(function: Callable[[Item], Result], item: Item) -> Result:
    torch.set_num_threads(1)
    return function(item)


def document_of(
    rows: Sequence[Row], found: dict[str, Truth], why: dict[str, Explained]
) -> dict[str, Any]:
    """Everything, for a file."""
    return {
        "truths": {name: asdict(one) for name, one in found.items()},
        "predictions": [asdict(row) for row in rows],
        "why": {name: asdict(one) for name, one in why.items()},
    }
