"""Edited run folders are refused, in a line that names what does not agree; whoever reads them."""

import json
import math
import shutil
from dataclasses import dataclass, replace
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import pemviz
from pemviz.cli.main import main
from pemviz.errors import InputError
from pemviz.files.atomic import document_digest, file_digest
from pemviz.panel.loading import load_run
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.reading import read_result
from pemviz.runs.rollout_files import part_path
from pemviz.runs.run_folder import record
from tests.faults.test_resume import StopAfter, contents, folder_of
from tests.runs.test_reading import RULES, SMALL
from tests.runs.test_result_file import changed, paths

CONFIG = replace(SMALL.with_rules(RULES), method="mixture", repetitions=2)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of ours, with a recording's place taken, and one that differs from it by its seed."""
    folders = []
    for seed in (3, 4):
        folder = tmp_path_factory.mktemp("recordings") / "run"
        folder.mkdir()
        (folder / "run.rrd").write_bytes(b"RRF2" + bytes(range(256)) * 20)
        record(build_experiment(replace(CONFIG, seed=seed)), folder)
        folders.append(folder)
    return folders


@pytest.fixture
def run(made, tmp_path):
    """A copy that may be edited."""
    shutil.copytree(made[0], tmp_path / "recordings" / "run")
    return tmp_path / "recordings" / "run"


def edit(run, change, *, sealed=False):
    """Change the document; ``sealed``: with digests that fit, as who means to deceive would."""
    path = run / "result.json"
    document = json.loads(path.read_text())
    change(document)
    if sealed:
        document["files"] = {name: file_digest(run / name) for name in document["files"]}
        del document["digest"]
        document["digest"] = document_digest(document)
    path.write_text(json.dumps(document))


def edit_rollouts(run, **changes):
    path = run / "rollouts.npz"
    with np.load(path) as arrays:
        table = {name: arrays[name] for name in arrays.files}
    for name, change in changes.items():
        table[name] = change(table[name])
    np.savez(path, **table)


def at(*path, change, sealed=False):
    """Change what stands somewhere in the document."""

    def edited(document):
        *way, last = path
        holder = reduce(getitem, way, document)
        holder[last] = change(holder[last])

    return in_document(edited, sealed=sealed)


def scaled(estimate, factor=0.5):
    names = ("probability", "std_error", "ci_low", "ci_high")
    log10 = estimate["log10_probability"] + math.log10(factor)
    return {**estimate, **{n: estimate[n] * factor for n in names}, "log10_probability": log10}


def all_consistently(document):
    document["estimate"] = scaled(document["estimate"], 0.01)
    document["repetitions"] = [scaled(one, 0.01) for one in document["repetitions"]]


def flip(values):
    values = values.copy()
    row = int(np.flatnonzero(values)[0])
    values[row] = not values[row]
    return values


def shifted(values):
    return np.where(values < 0, values - 0.1, values)


def reference(document):
    document["reference"]["probability"] /= 2
    document["reference"]["log10_probability"] -= math.log10(2)


def of_an_older_version(document):
    """As far as it goes: what has no digests is held to its rollouts all the same."""
    all_consistently(document)
    document["schema"] = 1
    del document["files"], document["digest"]


def cut(run, name):
    (run / name).write_bytes((run / name).read_bytes()[:-100])


def drop_a_rollout(run):
    with np.load(run / "rollouts.npz") as arrays:
        names = arrays.files
    edit_rollouts(run, **dict.fromkeys(names, lambda values: values[1:]))


def another_seed(run):
    path = run / "config.toml"
    path.write_text(path.read_text().replace("seed = 3", "seed = 5", 1))


def downgraded(document):
    """To the schema that has no digests, with its figures edited."""
    all_consistently(document)
    document["schema"] = 1


def in_document(change, **how):
    return lambda run, _: edit(run, change, **how)


EDITS = {
    "bound": (
        at("estimate", "ci_high", change=lambda end: end / 100),
        "estimate.ci_high = ", "must be at least"),
    "probability": (
        at("estimate", "probability", change=lambda p: p / 10),
        "estimate.probability", "estimate.ci_low = "),
    "consistent": (in_document(all_consistently), "repetitions[0].probability = ", "npz give "),
    "consistent and sealed": (
        in_document(all_consistently, sealed=True), "repetitions[0].probability = ", "npz give "),
    "repetition": (at("repetitions", 1, change=scaled), "estimate.", "repetitions give "),
    "rule": (
        at("rules", 0, "estimate", change=scaled, sealed=True),
        "rules[0].estimate.probability = ", "npz give "),
    "stage": (
        at("stages", 2, "failures", change=lambda count: count - 1, sealed=True),
        "stages[2].failures = ", "npz holds "),
    "refits": (
        at("pem_interval", "high", change=lambda _: 0.0, sealed=True), "pem_interval.high",
        "pem_interval."),
    "reference": (in_document(reference), "digest = ", "it was changed after it was written"),
    "older": (in_document(of_an_older_version), "repetitions[0].probability = ", "npz give "),
    "schema": (in_document(downgraded), "schema = 1", "must be 2"),
    "digest": (in_document(lambda document: document.pop("digest")), "digest", "must be a text"),
    "verdict": (lambda run, _: edit_rollouts(run, violated=flip), "violated = False", "robustness"),
    "rule's verdict": (
        lambda run, _: edit_rollouts(run, **{"broken.near": flip}),
        "rules[0].estimate.failures = ", "npz give "),
    "likelihoods": (
        lambda run, _: edit_rollouts(run, log_p=shifted), "repetitions[0].nll_mean", "npz give "),
    "proposal's likelihoods": (
        lambda run, _: edit_rollouts(run, log_q=shifted), "files.rollouts.npz = ", "was changed"),
    "rollout dropped": (lambda run, _: drop_a_rollout(run), "stages[0].rollouts = 40", "holds 39"),
    "seed": (lambda run, _: another_seed(run), "seed = 3, not 5", "config.toml"),
    "proposals": (
        lambda run, _: cut(run, "proposals.safetensors"), "files.proposals.safetensors", "changed"),
    "recording cut": (lambda run, _: cut(run, "run.rrd"), "files.run.rrd = ", "was changed"),
    "another run's rollouts": (
        lambda run, other: shutil.copy(other / "rollouts.npz", run), "failures = ", "rollouts.npz"),
}  # fmt: skip


def line_of(capsys):
    lines = [line for line in capsys.readouterr().err.splitlines() if line]
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("kind", EDITS)
def test_an_edited_run_is_refused_everywhere_in_the_same_line(kind, made, run, tmp_path, capsys):
    change, *words = EDITS[kind]
    change(run, made[1])
    with pytest.raises(InputError) as refused:
        pemviz.read_result(run)
    told = str(refused.value)
    assert all(word in told for word in words), told
    assert str(run) in told
    if kind != "seed":  # of which each has its own configuration
        assert main(["record", "--resume", str(run)]) == 2
        assert told in line_of(capsys)
    for command in (
        ["report", str(run), "--out", str(tmp_path / "page.html")],
        ["export", str(run), "--format", "csv", "--out", str(tmp_path / "rollout.csv")],
    ):
        assert main(command) == 2
        assert told in line_of(capsys)
    with pytest.raises(InputError) as refused:
        load_run(run)
    assert str(refused.value) == told
    assert RecordingsFolder(run.parent).damaged() == [told]


def test_the_runs_are_believed_before(made):
    for folder in made:
        assert read_result(folder).status == "done"


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_single_value_is_changed_is_found(made, tmp_path, data):
    document = json.loads((made[0] / "result.json").read_text())
    leaves = [
        (path, value) for path, value in paths(document) if not isinstance(value, dict | list)
    ]
    path, value = data.draw(st.sampled_from(leaves))
    others = st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False, allow_infinity=False),
        st.text(max_size=4), st.just(...),
    )  # fmt: skip
    other = data.draw(others.filter(lambda x: json.dumps(x, default=str) != json.dumps(value)))
    folder = tmp_path / "one"
    folder.mkdir(exist_ok=True)
    (folder / "result.json").write_text(json.dumps(changed(document, path, other)))
    with pytest.raises(InputError) as refused:
        read_result(folder)
    assert "\n" not in str(refused.value)


@dataclass(frozen=True)
class Unfinished:
    """A run that was stopped after three stages, one of another seed, and what the first became."""

    experiment: Experiment
    stopped: Path
    other: Path
    whole: Path


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    root = tmp_path_factory.mktemp("unfinished")
    stopped, other, whole = (folder_of(root, name) for name in ("stopped", "other", "whole"))
    one, another = (
        build_experiment(replace(CONFIG, repetitions=1, seed=seed))
        for seed in (CONFIG.seed, CONFIG.seed + 1)
    )
    for experiment, folder in ((one, stopped), (another, other)):
        stop = StopAfter(3)
        record(experiment, folder, observers=[stop], should_stop=stop)
    record(one, whole)
    return Unfinished(one, stopped, other, whole)


def test_an_edited_stage_of_an_unfinished_run_is_computed_again(unfinished, tmp_path, caplog):
    edited = shutil.copytree(unfinished.stopped, tmp_path / "run")
    path = part_path(edited, repetition=0, stage=1)
    with np.load(path) as arrays:
        table = {name: arrays[name] for name in arrays.files}
    np.savez(path, **{**table, "violated": ~table["violated"]})
    with pytest.raises(InputError, match="was changed since it was written"):
        load_run(edited)
    record(unfinished.experiment, edited)
    assert "was changed since it was written" in caplog.text
    assert "it is computed again" in caplog.text
    assert contents(edited) == contents(unfinished.whole)


@pytest.mark.parametrize("what", ["digest", "place", "seed", "settings"])
def test_a_stage_that_is_not_this_runs_is_computed_again(what, unfinished, tmp_path):
    """Edited and without a digest, of another stage or seed, or of settings that were others."""
    begun = unfinished.other if what == "settings" else unfinished.stopped
    edited = shutil.copytree(begun, tmp_path / "run")
    before, last = (part_path(edited, repetition=0, stage=stage) for stage in (1, 2))
    if what == "digest":
        with np.load(last) as arrays:
            table = {name: arrays[name] for name in arrays.files if name != "digest"}
        np.savez(last, **{**table, "violated": ~table["violated"]})
    elif what == "place":
        last.write_bytes(before.read_bytes())
    elif what == "seed":
        last.write_bytes(part_path(unfinished.other, repetition=0, stage=2).read_bytes())
    else:
        (edited / "result.json").unlink()
        shutil.copy(unfinished.stopped / "config.toml", edited)
    record(unfinished.experiment, edited)
    read_result(edited)
    assert contents(edited) == contents(unfinished.whole)
