"""Targets that read run folders: what the panel does with each file, and recordings."""

import io
import json
import random
import shutil
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from safetensors.numpy import load

from pemviz.cli.record_run import gate_exit_code
from pemviz.config import ExperimentConfig
from pemviz.config.rule_words import GateLimits
from pemviz.config.toml_files import load_config
from pemviz.panel.compare_page import metrics_page, runs_page
from pemviz.panel.learning_page import learning
from pemviz.panel.loading import load_run
from pemviz.panel.pieces import drawn
from pemviz.panel.ranking import METRIC_NAMES, rank, ranking_csv, row
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.rollout_charts import track, track_charts
from pemviz.panel.rollout_tables import check_table
from pemviz.panel.run_data import RunData
from pemviz.panel.site import dumps
from pemviz.panel.why_page import why
from pemviz.recording.open import find_recording
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.pipeline import junit_xml
from pemviz.reports.terminal import print_summary
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import has_result, result_document
from pemviz.runs.rollout_files import PART_FOLDER, finished_stage, load_rollouts
from pemviz.simulators.braking.scenario import scenario_signals
from tests.fuzz.containers import archive, damage_npz, damage_safetensors
from tests.fuzz.harness import Case, Target, documented
from tests.fuzz.mutate import as_json, damage_bytes, damage_tree
from tests.fuzz.text_targets import toml_bytes

FILES = ("config.toml", "result.json", "rollouts.npz", "proposals.safetensors")


@cache
def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _npz_bytes(rng: random.Random, path: Path) -> bytes:
    arrays = _arrays(path)
    return damage_npz(rng, arrays, [archive(arrays, compress=True), b"PK\x05\x06" + b"\0" * 18])


def _json_bytes(rng: random.Random, path: Path) -> bytes:
    content = path.read_bytes()
    if rng.random() < 0.3:
        return damage_bytes(rng, content, [content, b"[" * 100_000, b"9" * 5000])
    return as_json(damage_tree(rng, json.loads(content))).encode(errors="replace")


def _safetensors_bytes(rng: random.Random, path: Path) -> bytes:
    content = path.read_bytes()
    return damage_safetensors(rng, load(content), {}, [content])


def pages(run: RunData) -> None:
    """Everything that the panel makes of a run."""
    compared = metrics_page(run) + runs_page([run, run])
    page = learning(run) + why(run) + compared
    assert "Traceback" not in page
    if run.kept:
        for metric in METRIC_NAMES:
            ranking = rank(run, metric)
            assert ranking.order.size == run.kept
        for chart in track_charts(track(run, row(run, ranking, 0)), width=400):
            drawn(chart)
        ranking_csv(run, ranking)


def _listed(recordings: RecordingsFolder) -> None:
    """A run is in the list, or what is wrong with it is."""
    entries, damaged = recordings.entries(), recordings.damaged()
    assert len(entries) + len(damaged) == len(recordings.names())
    assert all(documented(words) for words in damaged)
    dumps([entry.summary for entry in entries])


def read_run(case: Case) -> None:
    """A run folder with one file damaged: it is listed or told of, and shown or refused."""
    rng = case.rng
    root = case.folder / "recordings"
    run = root / "run"
    source = case.valid.stages if rng.random() < 0.3 else case.valid.run
    shutil.copytree(source, run)
    names = [str(path.relative_to(run)) for path in sorted(run.rglob("*")) if path.is_file()]
    path = run / rng.choice(names)
    if rng.random() < 0.05:
        path.unlink()
    elif path.suffix == ".npz":
        path.write_bytes(_npz_bytes(rng, source / path.relative_to(run)))
    elif path.suffix == ".json":
        path.write_bytes(_json_bytes(rng, path))
    elif path.suffix == ".toml":
        path.write_bytes(toml_bytes(rng, load_config(path)))
    else:
        path.write_bytes(_safetensors_bytes(rng, path))
    recordings = RecordingsFolder(root)
    _listed(recordings)
    pages(load_run(run, most_read_bytes=int(rng.choice([0, 2**30]))))


@cache
def _shown(folder: Path) -> RunData:
    return load_run(folder)


def show_result(case: Case) -> None:
    """A damaged result.json beside sound rollouts, on every page."""
    path = case.folder / "recordings" / "run" / "result.json"
    path.parent.mkdir(parents=True)
    shutil.copy(case.valid.run / "config.toml", path.parent)
    path.write_bytes(_json_bytes(case.rng, case.valid.run / "result.json"))
    recordings = RecordingsFolder(case.folder / "recordings")
    _listed(recordings)
    result = read_result(path.parent)
    json.dumps(result_document(result), allow_nan=False)
    pages(replace(_shown(case.valid.run), result=result))


def read_rollouts(case: Case) -> None:
    """A damaged archive of rollouts; what loads has the shapes that were promised."""
    path = case.folder / "rollouts.npz"
    path.write_bytes(_npz_bytes(case.rng, case.valid.run / "rollouts.npz"))
    check_table(load_rollouts(case.folder), _config(case.valid.run), where=str(path))


def read_stage(case: Case) -> None:
    """A damaged file of one stage, from which a run would go on."""
    source = next((case.valid.begun / PART_FOLDER).glob("*.npz"))
    path = case.folder / source.name
    path.write_bytes(_npz_bytes(case.rng, source))
    signals = scenario_signals(_config(case.valid.run).scenario)
    scored = finished_stage(path, signals).scored
    assert scored.violated.dtype == np.bool_
    assert np.isfinite(scored.rollouts.log_weight).all()


def read_begun(case: Case) -> None:
    """A damaged ``result.json`` of a run that is to go on."""
    (case.folder / "result.json").write_bytes(_json_bytes(case.rng, case.valid.run / "result.json"))
    assert has_result(case.folder)
    result = read_result(case.folder)
    with redirect_stderr(io.StringIO()):  # the gate's sentence
        gate_exit_code(result, limits=GateLimits(1e-9))
    summary_markdown(result)
    junit_xml(result)
    with redirect_stdout(io.StringIO()):
        print_summary(result, case.folder)


@cache
def _config(folder: Path) -> ExperimentConfig:
    return load_config(folder / "config.toml")


def open_recording(case: Case) -> None:
    """A damaged recording: found or refused."""
    content = case.valid.recording
    (case.folder / "run.rrd").write_bytes(damage_bytes(case.rng, content, [content]))
    find_recording(case.folder)


TARGETS = (
    Target("run", read_run, 6),
    Target("result", show_result, 6),
    Target("rollouts", read_rollouts, 8),
    Target("stage", read_stage, 4),
    Target("begun", read_begun, 3),
    Target("open", open_recording, 4),
)
