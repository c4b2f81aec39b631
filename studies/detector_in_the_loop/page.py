"""The page: the truth, what was predicted over it, and whether the check told in advance."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pemviz.files.atomic import write_text
from studies.detector_in_the_loop.page_words import (
    VARIANT_TITLES,
    holds,
    ratio_of,
    ratio_words,
    short,
)
from studies.detector_in_the_loop.pictures import write_curve, write_frames, write_ratios
from studies.detector_in_the_loop.settings import SETTINGS, Effort
from studies.detector_in_the_loop.study import HIDDEN, Row, Truth, the_detector
from studies.detector_in_the_loop.why import Explained

Tell = Callable[[str], None]


def write_page(
    folder: Path,
    rows: Sequence[Row],
    found: Mapping[str, Truth],
    why: Mapping[str, Explained],
    *,
    effort: Effort,
    tell: Tell,
) -> None:
    """``results.md`` with its pictures, in ``folder``.

    Raises:
        OSError: A file cannot be written.
    """
    detector = the_detector(folder, effort, tell)
    write_frames(folder / "frames.png", detector)
    write_curve(folder / "detector.png", folder / "detector.json")
    write_ratios(folder / "ratios.png", rows, found)
    parts = [
        "# The detector in the loop: what came out\n",
        _detector_words(folder),
        "![What the camera sees, and what the detector makes of it](frames.png)\n",
        "![Precision and recall](detector.png)\n",
        "## The truth\n",
        truth_table(found),
        "## What was predicted, over the truth\n",
        ratio_table(rows, found),
        "![Predictions over the truth](ratios.png)\n",
        "## Does the check tell?\n",
        check_table(rows, found),
        "## Why\n",
        why_table(why),
    ]
    write_text(folder / "results.md", "\n".join(parts))
    tell(f"written: {folder / 'results.md'}")


def _detector_words(folder: Path) -> str:
    card = json.loads((folder / "detector.json").read_text(encoding="utf-8"))
    digest = hashlib.sha256((folder / "detector.safetensors").read_bytes()).hexdigest()[:12]
    return (
        f"The detector: {card['parameters']:,} parameters, trained on {card['pictures']:,} images "
        f"in {card['epochs']} epochs; average precision {card['average_precision']:.3f} on "
        f"{card['validation']:,} images of other scenes; threshold {card['threshold']:.3f}, where "
        f"F1 is greatest. Its weights, {digest}, may come out otherwise on another machine: no "
        "figure here may stand beside one of others.\n"
    )


def truth_table(found: Mapping[str, Truth]) -> str:
    """Each setting with its probability, and how that was found."""
    lines = [
        "| setting | domain | threshold, logits above the usual | failure probability | how |",
        "|---|---|---|---|---|",
    ]
    by_name = {setting.name: setting for setting in SETTINGS}
    for name, truth in found.items():
        setting = by_name[name]
        how = f"{truth.count.failed} of {truth.count.rollouts:,} rollouts fail"
        if truth.how != "counted":
            how = f"{truth.how}; {how}"
        value = f"{short(truth.probability)} ({short(truth.low)} to {short(truth.high)})"
        lines.append(f"| {name} | {setting.domain_name} | {setting.strict:g} | {value} | {how} |")
    return "\n".join(lines) + "\n"


def ratio_table(rows: Sequence[Row], found: Mapping[str, Truth]) -> str:
    """Predictions over the truth, a line for each setting and number of frames."""
    titles = list(VARIANT_TITLES)
    lines = [
        "| setting | labelled frames | " + " | ".join(VARIANT_TITLES.values()) + " |",
        "|---|---|" + "---|" * len(titles),
    ]
    frames = sorted({row.frames for row in rows})
    cells = {(row.setting, row.frames, row.variant): row for row in rows}
    for name, truth in found.items():
        for number in frames:
            words = []
            for variant in titles:
                row = cells.get((name, number, variant))
                words.append("" if row is None else ratio_words(ratio_of(row.answer, truth)))
            lines.append(f"| {name} | {number:,} | " + " | ".join(words) + " |")
    return "\n".join(lines) + "\n"


def check_table(rows: Sequence[Row], found: Mapping[str, Truth]) -> str:
    """Of each variant: how often nothing was refuted, and how often it then was right."""
    lines = [
        "| variant | within 2 of the truth | nothing refuted out of fold: within 2 | something "
        "refuted: within 2 | nothing refuted on unseen sequences: within 2 | something: within 2 | "
        "no misfit told by 'record': within 2 | some: within 2 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for variant, title in VARIANT_TITLES.items():
        own = [row for row in rows if row.variant == variant and row.setting in found]
        if not own:
            continue
        right = {id(row): holds(ratio_of(row.answer, found[row.setting])) for row in own}

        def share(chosen: Sequence[Row], right: Mapping[int, bool] = right) -> str:
            return f"{sum(right[id(row)] for row in chosen)} of {len(chosen)}" if chosen else "-"

        if variant == HIDDEN:
            lines.append(f"| {title} | {share(own)} | - | - | - | - | - | - |")
            continue
        parts = [
            own,
            [row for row in own if row.refuted == 0],
            [row for row in own if row.refuted],
            [row for row in own if not row.unseen],
            [row for row in own if row.unseen],
            [row for row in own if not row.answer.misfits],
            [row for row in own if row.answer.misfits],
        ]
        lines.append(f"| {title} | " + " | ".join(share(part) for part in parts) + " |")
    return "\n".join(lines) + "\n"


def why_table(why: Mapping[str, Explained]) -> str:
    """How likely all frames that decide are missed: counted, and by parts of the predictions."""
    lines = [
        "| setting | frames, gaps | all missed in the loop | normal latents of the same "
        "correlations | with the loop's own shares: independent, memory, frailty, both, visibility "
        "| with the model's P(missed): the same | P(missed) in the last frame: loop, model, model "
        "with copied outcomes |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in why.items():
        parts = [", ".join(short(pair[k]) for pair in one.by_variant.values()) for k in (0, 1)]
        gaps = f"{len(one.gap_m)}, {one.gap_m[0]:.0f} to {one.gap_m[-1]:.0f} m"
        last = ", ".join(short(each[-1]) for each in (one.loop, one.model, one.lagged))
        counted = f"{short(one.all_missed)} of {one.scenes:,} | {short(one.normal)}"
        lines.append(f"| {name} | {gaps} | {counted} | {parts[0]} | {parts[1]} | {last} |")
    return "\n".join(lines) + "\n"
