"""Targets that read text: configurations, formulas, labels, detections, tables."""

import io
import json
import random
from functools import cache, partial

import numpy as np
import tomli_w

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_table, config_text, load_config
from pemviz.pem import Pem, ensemble_of, load_pem
from pemviz.pem.data.collect import CollectOptions, collect
from pemviz.pem.data.detections import DetectionFormat
from pemviz.pem.data.support import summarise_support
from pemviz.pem.data.table import INPUTS_FILE, LABELS_FILE, SalientTable, load_table
from pemviz.runs.specification import build_formula, build_metric
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.registry import build_named_simulator
from pemviz.stl import parse
from tests.fuzz.harness import Case, Target
from tests.fuzz.mutate import WORDS, as_json, damage_bytes, damage_text, damage_tree, text_bytes
from tests.fuzz.valid import CONFIGS, FRAMES, coco_document, label_file, result_file, yolo_file
from tests.stl.test_fuzz import mutated, random_text

SIGNALS = ("gap", "x", "y", "d", "v", "a", "b", "c", "z")
MOST_STATES = 200
"""Scenarios that are longer are read and built, but not driven."""


def toml_bytes(rng: random.Random, config: ExperimentConfig) -> bytes:
    """A configuration file, damaged in its values or in its text."""
    others = [config_text(other) for other in CONFIGS]
    if rng.random() < 0.5:
        return text_bytes(rng, config_text(config), others)
    table = {name: value for name, value in config_table(config).items() if value is not None}
    try:
        return tomli_w.dumps(damage_tree(rng, table)).encode(errors="surrogatepass")
    except (TypeError, ValueError, AttributeError, RecursionError):
        return damage_bytes(rng, config_text(config).encode(), [o.encode() for o in others])


def read_config(case: Case) -> None:
    """What loads is valid, is written and read back the same, and drives without a warning."""
    path = case.folder / "damaged.toml"
    path.write_bytes(toml_bytes(case.rng, case.rng.choice(CONFIGS)))
    config = load_config(path)
    config.validate()
    copy = case.folder / "copy.toml"
    copy.write_text(config_text(config), encoding="utf-8")
    assert load_config(copy) == config
    # one back end is as good as the other here, and highway-env takes a second to import
    simulator = build_named_simulator("vectorized", config.scenario)
    build_formula(config, simulator)
    if config.pem != "ml-nn":
        ensemble_of(config.pem)
        load_pem(config.pem)
    if config.scenario.states <= MOST_STATES:
        build_metric(config, simulator)
        outcomes = np.random.default_rng(1).random((4, config.scenario.states - 1)) < 0.5
        outcomes[0] = False
        signals = replay(simulator=simulator, detected=outcomes)
        assert all(np.isfinite(signal).all() for signal in signals.values())
        assert np.isfinite(_shipped_pem().logit(simulator.salient(signals))).all()


@cache
def _shipped_pem() -> Pem:
    return load_pem("ml-nn")


def read_formula(case: Case) -> None:
    """What parses is written and parsed back the same."""
    text = case.rng.choice((random_text, mutated))(case.rng)
    formula = parse(text, signals=SIGNALS)
    assert parse(str(formula)) == formula


def _maybe(case: Case, content: bytes, damaged: bytes) -> bytes:
    return damaged if case.rng.random() < 0.6 else content


def _collected(case: Case, *, detection_format: DetectionFormat) -> None:
    """Labels and detections, at least one of them damaged; the table loads if models can use it."""
    rng = case.rng
    labels, found = case.folder / "labels", case.folder / "found"
    labels.mkdir()
    others = [label_file(rng), result_file(rng)]
    for frame in FRAMES:
        text = label_file(rng)
        content = _maybe(case, text.encode(), text_bytes(rng, text, others))
        (labels / f"{frame}.txt").write_bytes(content)
    sizes = None
    if detection_format == "coco":
        found.write_bytes(_coco_bytes(rng))
    else:
        found.mkdir()
        for frame in FRAMES[: 2 if rng.random() < 0.95 else 1]:
            text = yolo_file(rng) if detection_format == "yolo" else result_file(rng)
            content = _maybe(case, text.encode(), text_bytes(rng, text, [*others, yolo_file(rng)]))
            (found / f"{frame}.txt").write_bytes(content)
        sizes = case.folder / "sizes.csv"
        text = "frame,width_px,height_px\n" + "".join(f"{f},1242,375\n" for f in FRAMES)
        sizes.write_bytes(_maybe(case, text.encode(), text_bytes(rng, text, others)))
    out = case.folder / "obstacles.csv"
    options = CollectOptions(
        class_aware=rng.random() < 0.5, drop_unknown=True, skip_bad=rng.random() < 0.5
    )
    counts = collect(
        labels=labels,
        detections=found,
        out=out,
        detection_format=detection_format,
        options=options,
        image_sizes=sizes,
        missing_is_empty=rng.random() < 0.5,
    )
    if counts.obstacles:
        table = load_table(out)
        assert len(table) == counts.obstacles
        assert int(np.sum(~table.detected)) == counts.missed


def _coco_bytes(rng: random.Random) -> bytes:
    document = coco_document(rng)
    whole = document if rng.random() < 0.7 else document["annotations"]
    if rng.random() < 0.4:
        text = json.dumps(whole)
        return damage_bytes(rng, text.encode(), [b"[]", b"[" * 5000, b"9" * 5000])
    return as_json(damage_tree(rng, whole)).encode(errors="replace")


def read_table(case: Case) -> None:
    """A table of obstacles as CSV, or as the authors' two files; counts come from what loads."""
    rng = case.rng
    text = case.valid.table
    if rng.random() < 0.6:
        path = case.folder / "obstacles.csv"
        path.write_bytes(text_bytes(rng, text, [text, rng.choice(WORDS)]))
        _sound(load_table(path))
        return
    rows = [line.split(",") for line in text.splitlines()[1:]]
    for name, columns in ((INPUTS_FILE, slice(0, 11)), (LABELS_FILE, slice(11, 12))):
        lines = [" ".join(row[columns] + (["0"] * 8 if columns.start else [])) for row in rows]
        plain = "\n".join(lines)
        damaged = damage_text(rng, plain, [plain]) if rng.random() < 0.5 else plain
        content = damaged.encode(errors="surrogatepass")
        (case.folder / name).write_bytes(content)
    _sound(load_table(case.folder))


def _sound(table: SalientTable) -> None:
    assert table.salient.shape == (len(table), 11)
    assert np.isfinite(table.salient).all()
    assert int(summarise_support(table).obstacles.sum()) == len(table)
    assert io.StringIO(table.digest).read()


TARGETS = (
    Target("config", read_config, 24),
    Target("formula", read_formula, 20),
    Target("collect-kitti", partial(_collected, detection_format="kitti"), 6),
    Target("collect-yolo", partial(_collected, detection_format="yolo"), 5),
    Target("collect-coco", partial(_collected, detection_format="coco"), 5),
    Target("table", read_table, 6),
)
