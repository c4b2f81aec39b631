"""Runs as they were kept are believed, figures that were scaled are not; is it the run wanted?"""

import shutil
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

import pemviz
from pemviz.config import WITHOUT_EFFECT, ExperimentConfig, ScenarioConfig
from pemviz.config.encounters import EncounterConfig
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.runs.coherence import recount
from pemviz.runs.experiment import build_experiment
from pemviz.runs.reading import read_result, read_whole_run, run_differs, setting_differences
from pemviz.runs.result_file import read_kept, write_result
from pemviz.runs.run_folder import record
from pemviz.sampling.registry import SHIPPED
from tests.comparable_results import without_digests
from tests.faults.test_resume import StopAfter, folder_of
from tests.reports.runs import result as made_up
from tests.runs.recounts import assert_recounted

SMALL = ExperimentConfig(
    stages=5, rollouts=40, final_rollouts=90, epochs=20, seed=3, plan=False,
    spec="always[0,59] (gap >= 6.5)", scenario=ScenarioConfig(states=60), measured_memory=False,
)  # fmt: skip
RULES = {"near": "always[0,59] (gap >= 6.5)", "nearer": "always[0,59] (gap >= 6.2)"}
CUT_IN = replace(
    SMALL,
    scenario=ScenarioConfig(),
    spec="always[0,90] (needless_deceleration <= 3.0)",
    encounter=EncounterConfig(logical_scenario="cut-in", ghost_probability=0.05),
)
KINDS = {
    "plain": SMALL,
    "measured memories": replace(SMALL, measured_memory=True),
    "violations": replace(SMALL, keep="violations"),
    "repetitions": replace(SMALL, repetitions=3),
    "rules": replace(SMALL.with_rules(RULES), repetitions=2),
    "rules, violations": replace(SMALL.with_rules(RULES), keep="violations"),
    "latents": replace(SMALL, position_errors="pointpillars"),
    "memory": replace(SMALL, memory_s=0.3),
    "agm": replace(SMALL, metric="agm"),
    "slots": CUT_IN,
}
WITHOUT = {
    "latents": ("adaptive", "zero-variance"),
    "slots": ("adaptive", "zero-variance"),
    # what they would give is sampled beside the run, whatever its method
    "measured memories": {method.name for method in SHIPPED} - {"mixture"},
}
CASES = [
    (kind, method.name)
    for kind in KINDS
    for method in SHIPPED
    if method.name not in WITHOUT.get(kind, ())
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Kind and method to the folder of such a run, made once."""

    @cache
    def made(kind, method):
        found = folder_of(tmp_path_factory.mktemp("kept"), "a")
        record(build_experiment(replace(KINDS[kind], method=method)), found)
        return found

    return made


@pytest.mark.parametrize(("kind", "method"), CASES)
def test_a_run_as_it_was_kept_is_believed_and_scaled_figures_are_not(folder, kind, method):
    assert_recounted(folder(kind, method))
    assert read_result(folder(kind, method)).estimate.failures > 0


@pytest.mark.parametrize("method", ["mixture", "splitting", "subset", "naive"])
def test_results_of_older_versions_are_held_as_far_as_they_go(folder, tmp_path, method):
    """They have no digests, and their rollouts nothing that a method alone keeps."""
    kept = tmp_path / "run"
    shutil.copytree(folder("rules", method), kept)
    with np.load(kept / "rollouts.npz") as arrays:
        table = {n: arrays[n] for n in arrays.files if not n.startswith("method.")}
    np.savez(kept / "rollouts.npz", **table)
    without_digests(kept)
    result = read_whole_run(kept)
    assert result == read_result(folder("rules", method))
    assert read_kept(kept).files == {}
    (one, *others) = result.repetitions
    wrong = replace(one, failures=one.failures - 1)
    (words, *_) = recount(kept, replace(result, repetitions=(wrong, *others)))
    expected = f"repetitions[0].failures = {one.failures - 1}: rollouts.npz give {one.failures}"
    assert words == expected


def test_repetitions_that_choose_different_methods_are_each_formed_again(folder):
    kept = folder("rules", "auto")
    methods = [one.method for one in read_result(kept).repetitions]
    assert sorted(methods) == ["mixture", "monte-carlo"]
    assert_recounted(kept)


def test_the_shipped_sample_is_believed():
    assert pemviz.read_result(sample_run()).status == "done"
    assert pemviz.read_result(str(sample_run())) == pemviz.read_result(sample_run())


def test_an_unfinished_run_is_read(tmp_path):
    stop = StopAfter(3)
    experiment = build_experiment(replace(SMALL, method="mixture"))
    record(experiment, tmp_path, observers=[stop], should_stop=stop)
    assert read_whole_run(tmp_path).status == "stopped"
    assert list(read_kept(tmp_path).files) == ["config.toml"]


def test_files_that_were_taken_away_are_not_missed(folder, tmp_path):
    kept = tmp_path / "run"
    shutil.copytree(folder("plain", "mixture"), kept)
    for name in ("rollouts.npz", "proposals.safetensors"):
        (kept / name).unlink()
        assert read_result(kept).status == "done"
    (kept / "config.toml").unlink()
    with pytest.raises(InputError, match=r"config\.toml: cannot be read"):
        read_whole_run(kept)


def test_a_method_that_is_not_installed_here_is_no_hindrance(folder, tmp_path):
    kept = folder("plain", "naive")
    result = read_result(kept)
    elsewhere = replace(result, config=replace(result.config, method="of-another-package"))
    assert list(recount(kept, elsewhere)) == []


def test_large_files_are_left_to_another_look(folder, tmp_path):
    kept = tmp_path / "run"
    shutil.copytree(folder("plain", "naive"), kept)
    rollouts = kept / "rollouts.npz"
    rollouts.write_bytes(rollouts.read_bytes() + b"\0")
    size = rollouts.stat().st_size
    assert read_result(kept, most_bytes=size - 1).status == "done"
    with pytest.raises(InputError, match=r"rollouts\.npz"):
        read_result(kept, most_bytes=size)


OTHER = {
    str: "x", float: 0.625, int: 77, bool: True, "method": "naive", "metric": "agm", "target": 1e-9,
    "alpha": 0.5, "position_errors": "x", "encounters_per_hour": 2.5,
    "keep": "violations", "carla": "x", "chains": 77, "max_rollouts": 777, "max_minutes": 7.5,
    "surrogate": "x", "memory_s": 0.5, "frailty": 0.5, "measured_memory": False,
    "varying_frailty": 1.5, "varying_frailty_s": 0.25,
}  # fmt: skip


@pytest.mark.parametrize("kind", [ExperimentConfig, ScenarioConfig])
def test_every_setting_tells_runs_apart(kind):
    config = ExperimentConfig(method="adaptive")
    part = config if kind is ExperimentConfig else config.scenario
    for field in fields(kind):
        if field.name in ("scenario", "encounter", "rules", "start", "sumo"):
            continue
        value = getattr(part, field.name)
        other = OTHER.get(field.name, OTHER.get(type(value)))
        changed = replace(part, **{field.name: other})
        if kind is ScenarioConfig:
            changed = replace(config, scenario=changed)
        prefix = "scenario." if kind is ScenarioConfig else ""
        assert setting_differences(config, changed) == {prefix + field.name: (value, other)}
        words = run_differs(replace(made_up(), config=config), config=changed)
        if field.name in WITHOUT_EFFECT:
            assert words is None
            continue
        assert f"({prefix}{field.name} = {value!r}, not {other!r})" in words


def test_rules_tell_runs_apart_by_name():
    first, second = (
        ExperimentConfig().with_rules(rules) for rules in ({"a": "gap > 0"}, {"b": "gap > 0"})
    )
    assert setting_differences(ExperimentConfig(), first) == {
        "spec": (ExperimentConfig().spec, "(gap > 0)"), "rules.a": (None, "gap > 0"),
    }  # fmt: skip
    assert setting_differences(first, second) == {
        "rules.a": ("gap > 0", None), "rules.b": (None, "gap > 0"),
    }  # fmt: skip


def test_the_same_settings_with_another_error_model_are_another_run():
    found = made_up()
    assert run_differs(found, config=found.config) is None
    assert run_differs(found, config=found.config, pem_digest="ab" * 32) is None
    words = run_differs(found, config=found.config, pem_digest="cd" * 32)
    assert words == (
        "another error model of the name 'ml-nn' (digest abababababab, now cdcdcdcdcdcd)"
    )


def test_a_folder_whose_files_differ_is_no_whole_run(tmp_path):
    found = made_up()
    write_result(tmp_path, found)
    with pytest.raises(InputError, match=r"config\.toml: cannot be read"):
        read_whole_run(tmp_path)
    (tmp_path / "config.toml").write_text(config_text(found.config))
    assert read_whole_run(tmp_path) == found
    (tmp_path / "config.toml").write_text(config_text(replace(found.config, alpha=0.5)))
    with pytest.raises(InputError, match=r"begun with settings other .* \(alpha = None, not 0.5\)"):
        read_whole_run(tmp_path)
