"""Whether a folder's run is the one asked for: one answer, whoever asks."""

from dataclasses import fields, replace

import pytest

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.runs.reading import read_whole_run, run_differs, setting_differences
from pemviz.runs.result_file import write_result
from tests.reports.runs import result

OTHER = {
    str: "x", float: 0.625, int: 77, bool: True, "method": "naive", "metric": "agm", "target": 1e-9,
    "alpha": 0.5, "position_errors": "x", "encounters_per_hour": 2.5,
    "keep": "violations", "carla": "x",
}  # fmt: skip


CONFIG = ExperimentConfig()


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
        words = run_differs(replace(result(), config=config), config=changed)
        assert f"({prefix}{field.name} = {value!r}, not {other!r})" in words


def test_rules_tell_runs_apart_by_name():
    first, second = (CONFIG.with_rules(rules) for rules in ({"a": "gap > 0"}, {"b": "gap > 0"}))
    assert setting_differences(CONFIG, first) == {
        "spec": (CONFIG.spec, "(gap > 0)"), "rules.a": (None, "gap > 0"),
    }  # fmt: skip
    assert setting_differences(first, second) == {
        "rules.a": ("gap > 0", None), "rules.b": (None, "gap > 0"),
    }  # fmt: skip


def test_the_same_settings_with_another_error_model_are_another_run():
    found = result()
    assert run_differs(found, config=found.config) is None
    assert run_differs(found, config=found.config, pem_digest="ab" * 32) is None
    words = run_differs(found, config=found.config, pem_digest="cd" * 32)
    assert words == (
        "another error model of the name 'ml-nn' (digest abababababab, now cdcdcdcdcdcd)"
    )


def test_a_folder_whose_files_differ_is_no_whole_run(tmp_path):
    found = result()
    write_result(tmp_path, found)
    with pytest.raises(InputError, match=r"config\.toml: cannot be read"):
        read_whole_run(tmp_path)
    (tmp_path / "config.toml").write_text(config_text(found.config))
    assert read_whole_run(tmp_path) == found
    (tmp_path / "config.toml").write_text(config_text(replace(found.config, alpha=0.5)))
    with pytest.raises(InputError, match=r"begun with settings other .* \(alpha = None, not 0.5\)"):
        read_whole_run(tmp_path)
