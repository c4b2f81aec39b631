"""result.json: what is written is read back; what no run writes is refused by file and field."""

import copy
import json
import math
import os
import re
from dataclasses import asdict, replace

import pytest
from hypothesis import HealthCheck, given, settings

from pemviz.config import METHODS, ExperimentConfig, ScenarioConfig
from pemviz.errors import LONGEST_MESSAGE, InputError
from pemviz.files.shipped import sample_run
from pemviz.reports.gate import interval_caveats
from pemviz.runs import result_file
from pemviz.runs.engine import run_experiment
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import (
    KeptResult,
    has_result,
    read_kept,
    result_document,
    result_from_document,
    write_result,
)
from pemviz.runs.run_folder import RunStore
from tests.comparable_results import comparable_result
from tests.reports.runs import PLAN
from tests.reports.runs import result as made_up_result
from tests.runs.results import results

MAY_BE_NULL = re.compile(
    r"message|config\.(target|alpha|chains|max_rollouts|max_minutes|memory_s|frailty)"
    r"|memory|memory\.fitted|memory\.((frailty_)?curve\[\d+\]|measured\[\d+\]\.point)\.(low|high|ess)"
    r"|memory\.measured\[\d+\]\.point\.diagnostics\[\d+\]\.(value|limit)"
    r"|memory\.fitted\.frailty(_low|_high)?"
    r"|reference|reference\.log10_probability|pem_interval"
    r"|pem_interval\.(low|high|median|log10_answers\[\d+\])|data_bound"
    r"|sensitivity\[\d+\]\.(low|high|elasticity|target_factor|target_ess|warning|std_error)"
    r"|causes\.(memory|bursts)|causes\.memory\.(elasticity|target_tau_s|target_ess|warning|std_error)"
    r"|causes\.bursts\.(begins_gap_m|again)|causes\.stage|causes\.chains\[\d+\]\.likeliest"
    r"|(estimate|repetitions\[\d+\])\.(log10_probability|std_error|ci_low|ci_high|nll_mean"
    r"|nll_log_mean|ess|pareto_k|max_weight_share|unbiased\.(probability|std_error)"
    r"|diagnostics\[\d+\]\.(value|limit))|estimate"
    r"|uncertainty\[\d+\]\.(low|high)"
    r"|plan|plan\.(labels|reason|sequences|labels\.warning)"
    r"|plan\.labels\.bands\[\d+\]\.(low_m|high_m|labels|most_missed)"
    r"|plan\.refits\[\d+\]\.(low_m|high_m)"
    r"|stages\[\d+\]\.(threshold|log10_probability|ess|loss)|least_robust\[\d+\]\.(robustness|share)"
)
MAY_BE_ABSENT = re.compile(
    r"seed|message|estimate|repetitions|stages|least_robust|reference|pem_interval|data_bound"
    r"|pem_interval\.log10_answers|model_classes|uncertainty|plan|plan\.labels\.warning|memory"
    r"|memory\.(fitted|curve|frailty|frailty_curve|hidden|measured|unmeasured|visibility|carried)|memory\.fitted\.frailty(_low|_high)?|warnings|timings_s"
    r"|memory\.measured\[\d+\]\.point\.(frailty|diagnostics)"
    r"|(estimate|repetitions\[\d+\])\.(diagnostics|confidence|interval_caveats|try_next)"
    r"|causes\.(memory|bursts|memory\.(warning|std_error)|stage|slots|chains\[\d+\]\.(likeliest|slots))"
    r"|least_robust\[\d+\]\.share"
    r"|sensitivity\[\d+\]\.(warning|std_error)|config\.(?!seed$).*|versions\..*|timings_s\..*"
)
OTHER_TYPE = {
    bool: 1, int: "1", float: "1", str: 1, list: {"a": 1}, dict: [1], type(None): {"a": 1},
}  # fmt: skip


TINY = ExperimentConfig(method="adaptive",
    stages=1, rollouts=20, final_rollouts=30, epochs=2, seed=3, spec="always[0,11] (gap >= 2.0)",
    scenario=ScenarioConfig(states=12, dt_s=0.4), measured_memory=False,
)  # fmt: skip


@pytest.fixture(scope="module")
def sample():
    """The document of the sample run with a reference; of every kind of entry, two."""
    document = result_document(read_result(sample_run()))
    causes = document["causes"]
    for entries in (document["stages"], document["least_robust"], causes["chains"],
                    causes["misses_by_distance"], causes["miss_probability_by_step"]):  # fmt: skip
        del entries[2:]
    del document["sensitivity"][3:]
    causes["memory"] = {
        "tau_s": 0.2, "elasticity": 1.9, "target_tau_s": 0.07, "target_ess": 90.0, "warning": "few",
        "std_error": 0.1,
    }  # fmt: skip
    assert causes["bursts"]
    warning = {"kind": "few-failures", "value": 3.0, "limit": 10.0, "text": "few"}
    for table in (document["estimate"], *document["repetitions"]):
        table["diagnostics"] = [dict(warning), dict(warning)]
        table["warnings"] = ["few", "few"]
    document["reference"] = {"probability": 1e-18, "std_error": 1e-21, "log10_probability": -18.0}
    fitted = {"tau_s": 0.24, "low_s": 0.2, "high_s": 0.3, "confidence": 0.95}
    fitted |= {"frailty": 0.7, "frailty_low": 0.3, "frailty_high": 1.2}
    document["memory"]["fitted"] = fitted
    point = {"tau_s": 0.1, "probability": 1e-9, "low": 1e-10, "high": 1e-8, "ess": 20.0}
    document["memory"]["curve"] = [point, dict(point)]
    document["plan"] = asdict(PLAN)
    document["plan"]["labels"]["bands"] = list(document["plan"]["labels"]["bands"])
    document["plan"]["refits"] = list(document["plan"]["refits"])
    assert document["causes"]["chains"]
    assert document["pem_interval"]["warnings"]
    return document


def paths(value, at=()):
    """Where every value of a document stands, and the value."""
    if at:
        yield at, value
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from paths(item, (*at, key))


def text_of(path):
    joined = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    return joined.removeprefix(".")


def changed(document, path, value):
    """A copy with another value somewhere; ``...`` takes it out."""
    document = copy.deepcopy(document)
    holder = document
    for key in path[:-1]:
        holder = holder[key]
    if value is ...:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    return document


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(results())
def test_what_is_written_is_read_back(tmp_path, result):
    write_result(tmp_path, result)
    assert read_kept(tmp_path) == KeptResult(result, {}, None)


def test_the_document_is_what_the_file_holds_in_its_order(tmp_path):
    write_result(tmp_path, made_up_result())
    document = result_document(made_up_result())
    text = (tmp_path / "result.json").read_text(encoding="utf-8")
    kept = json.loads(text)
    assert text == f"{json.dumps(kept, indent=1, ensure_ascii=False)}\n"
    assert {**document, "schema": 2, "files": {}, "digest": kept["digest"]} == kept
    assert list(kept) == [
        "schema", "run_id", "status", "message", "seed", "versions", "config", "pem", "estimate",
        "memory", "reference", "pem_interval", "model_classes", "uncertainty", "data_bound", "plan",
        "sensitivity", "causes", "repetitions", "stages", "least_robust", "assumptions", "warnings",
        "timings_s", "files", "digest",
    ]  # fmt: skip


def test_the_sample_run_is_read_and_written_to_the_same_document(tmp_path):
    result = read_result(sample_run())
    write_result(tmp_path, result)
    assert comparable_result(tmp_path) == comparable_result(sample_run())
    assert result.run_id == "sample"
    assert result.estimate.probability == pytest.approx(10**result.estimate.log10_probability)
    assert len(result.least_robust) == 20
    assert result.explanation.sensitivity[0].low is None


@pytest.mark.parametrize(
    "config",
    [
        *(replace(TINY, method=method) for method in METHODS.names()),
        replace(TINY, method="naive", spec="true"),  # infinitely robust
        replace(TINY, method="naive", spec="always[0,9] (gap >= 2.0 and false)"),
        replace(
            TINY,
            method="mixture",
            reference=True,
            target=1e-20,
            repetitions=2,
            plan=True,  # mixture with all that a run can tell
            measured_memory=True,
        ),
    ],
    ids=lambda config: f"{config.method}-{config.spec[:6]}",
)
def test_what_runs_tell_is_read_back_from_their_folders(config, tmp_path):
    result = run_experiment(config, observers=[RunStore(tmp_path)])
    assert read_result(tmp_path) == result
    assert result.status == "done"


def test_results_of_versions_that_knew_fewer_fields_are_read(sample):
    document = copy.deepcopy(sample)
    for name in ("causes", "sensitivity", "data_bound"):
        del document[name]
    for name in ("step_time_limit_s", "reference", "target"):
        del document["config"][name]
    result = result_from_document(document)
    assert result.explanation is None
    assert result.data_bound is None
    assert result.config.step_time_limit_s == 600.0
    assert result.estimate == result_from_document(sample).estimate


def test_what_earlier_versions_could_set_is_read_where_it_means_what_there_is(sample):
    document = copy.deepcopy(sample)
    document["config"]["device"] = "cpu"
    assert result_from_document(document) == result_from_document(sample)


def test_undefined_and_infinite_figures_are_null_and_read_as_such(tmp_path):
    one = made_up_result()
    (rollout,) = one.least_robust
    ranked = (replace(rollout, robustness=-math.inf), replace(rollout, nll=0.0, violated=False))
    estimate = replace(one.estimate, ci_high=math.inf, ess=math.nan)
    wild = replace(one, estimate=estimate, repetitions=(), least_robust=ranked)
    write_result(tmp_path, wild)
    found = read_kept(tmp_path).result
    assert "Infinity" not in (tmp_path / "result.json").read_text()
    assert found.estimate == replace(one.estimate, ci_high=None, ess=None)
    assert found.least_robust == ranked


def test_every_entry_has_its_type(sample):
    """What stands anywhere in a result is refused if it is of another type, and named."""
    for path, value in paths(sample):
        with pytest.raises(InputError) as caught:
            result_from_document(changed(sample, path, OTHER_TYPE[type(value)]))
        assert str(caught.value).startswith(text_of(path)), path
        assert "must be" in str(caught.value)


def test_null_stands_only_where_a_run_may_write_it(sample):
    for path, _ in paths(sample):
        document = changed(sample, path, None)
        if MAY_BE_NULL.fullmatch(text_of(path)):
            result_from_document(document)
        else:
            with pytest.raises(InputError) as caught:
                result_from_document(document)
            assert str(caught.value).startswith(text_of(path)), path


def test_what_a_run_always_writes_may_not_be_absent(sample):
    for path, _ in paths(sample):
        if isinstance(path[-1], int):
            continue
        document = changed(sample, path, ...)
        if MAY_BE_ABSENT.fullmatch(text_of(path)):
            result_from_document(document)
        else:
            with pytest.raises(InputError, match=re.escape(path[0])):
                result_from_document(document)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("status", "going", "status = 'going': must be one of done, stopped, failed"),
        ("seed", 6, "seed = 6: must be that of config, 10"),
        (
            "config.method",
            "best",
            "config.method = 'best': no such method; there are: auto, adaptive,",
        ),
        ("config.seed", -1, "config.seed = -1: must be a whole number, at least 0"),
        ("config.device", "cuda", "device"),
        ("config.scenario.dt_s", 0, "config.scenario.dt_s = 0: must be a number, at least 0.001"),
        ("estimate.failures", -1, "estimate.failures = -1: must be a whole number, at least 0"),
        ("estimate.probability", -1e-9, "estimate.probability = -1e-09: must be a number, at lea"),
        ("estimate.log10_probability", 1e308, "must be a number, at most 300"),
        ("estimate.max_weight_share", 1.1, "must be a number, at least 0 and at most 1"),
        ("estimate.confidence", 1, "must be a number, above 0 and below 1"),
        ("estimate.unbiased.std_error", "x", "estimate.unbiased.std_error = 'x': must be a numbe"),
        ("pem_interval.members", 2**53 + 1, "must be a whole number, at least 0 and at most 9"),
        ("causes.chains", [{}], "causes.chains[0].missed_steps: is missing"),
        ("causes.misses_by_distance", [], "sensitivity has 3 entries: must have one for all dis"),
        ("sensitivity", [], "sensitivity has 0 entries: must have one for all distances"),
        ("stages", [3], "stages[0] = 3: must be a table"),
        ("run_id", "\ud800", "run_id = '\\ud800': must be a text"),
        ("versions", {"\ud800": "1"}, "must be a name"),
        ("timings_s", {"total": -1}, "timings_s.total = -1: must be a number, at least 0"),
    ],
)
def test_what_is_out_of_range_is_named_with_what_is_allowed(sample, path, value, words):
    with pytest.raises(InputError) as caught:
        result_from_document(changed(sample, path.split("."), value))
    assert words in str(caught.value)
    assert len(str(caught.value)) <= LONGEST_MESSAGE


@pytest.mark.parametrize("schema", [3, 0, None, True, "1", ...])
def test_another_schema_is_refused(sample, schema):
    with pytest.raises(InputError, match=r"schema = .*: must be 2 or 1; another version of pemviz"):
        result_from_document(changed(sample, ("schema",), schema))


def test_what_is_unknown_is_ignored_but_for_settings(sample):
    document = changed(sample, ("per_decade",), [1])
    document = changed(document, ("estimate", "uncertainty"), "x")
    document = changed(document, ("stages", 0, "rules"), {})
    assert result_from_document(document) == result_from_document(sample)
    with pytest.raises(InputError, match=r"^config\.laziness: no such field"):
        result_from_document(changed(sample, ("config", "laziness"), 0.2))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[1, 2", "cannot be read"),
        (b"[" * 100_000, "nested more than 100 levels"),
        (b"[1, 2]", "must be a JSON object"),
        (b'"text"', "must be a JSON object"),
        (b"\xff\xfe", "cannot be read"),
        (b'{"schema": 1, "config": {}, "timings_s": {"total": NaN}}', "NaN is not a JSON number"),
        (b'{"schema": 1}', "config = None: must be a table"),
        (b"{}", "schema = None"),
        (b" " * 3000, "at most 2000 bytes"),
    ],
)
def test_a_hostile_file_ends_in_one_line(tmp_path, monkeypatch, content, words):
    if content.isspace():
        monkeypatch.setattr(result_file, "LARGEST_BYTES", 2000)
    (tmp_path / "result.json").write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_result(tmp_path)
    assert str(caught.value).startswith(f"result {tmp_path / 'result.json'}: ")
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_result_has_none(tmp_path):
    assert not has_result(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        read_result(tmp_path)
    (tmp_path / "result.json").mkdir()
    assert not has_result(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        read_result(tmp_path)


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="there is no file without an end")
def test_a_file_without_an_end_is_not_read_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr(result_file, "LARGEST_BYTES", 10_000)
    (tmp_path / "result.json").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="at most 10000 bytes"):
        read_result(tmp_path)


SIZES = {
    "stages": 1, "rollouts": 12, "final_rollouts": 12, "epochs": 5,
    "measured_memory": False,
}  # fmt: skip


def through_json(result):
    return json.loads(json.dumps(result_document(result), allow_nan=False))


def older(document):
    """As written before diagnostics were kept."""
    for estimate in (document["estimate"], *document["repetitions"]):
        del estimate["diagnostics"]
    return document


def estimates_of(result):
    return (result.estimate, *result.repetitions)


# zero-variance takes long to begin, and its estimates have nothing wrong
@pytest.fixture(scope="module", params=sorted({*METHODS.shipped} - {"zero-variance"}))
def warned_result(request):
    return run_experiment(ExperimentConfig(method=request.param, repetitions=2, seed=4, **SIZES))


def test_what_is_read_back_is_as_reliable_as_it_was(warned_result):
    assert any(estimate.diagnostics for estimate in warned_result.repetitions)
    read = result_from_document(through_json(warned_result))
    for found, estimate in zip(estimates_of(read), estimates_of(warned_result), strict=True):
        assert found == estimate
        assert interval_caveats(found) == interval_caveats(estimate)


def test_older_results_give_the_same_answers(warned_result):
    read = result_from_document(older(through_json(warned_result)))
    for found, estimate in zip(estimates_of(read), estimates_of(warned_result), strict=True):
        assert found.warnings == estimate.warnings
        assert [one.kind for one in found.diagnostics] == [o.kind for o in estimate.diagnostics]
        assert interval_caveats(found) == interval_caveats(estimate)


def test_the_sample_run_warns_of_nothing():
    document = json.loads((sample_run() / "result.json").read_text(encoding="utf-8"))
    for kept in (document, older(document)):
        found = result_from_document(kept).estimate
        assert found.warnings == ()
        assert interval_caveats(found) == ()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ({"warnings": ["all is well"]}, "must be the texts"),
        ({"warnings": []}, "must be the texts"),
        ({"warnings": [3]}, r"estimate\.warnings\[0\] = 3: must be a text"),
        ({"diagnostics": [{"kind": "fine", "value": 1.0, "limit": 2.0, "text": "x"}]}, "'fine'"),
        ({"diagnostics": [{"kind": "heavy-tail"}]}, r"diagnostics\[0\]\.value: is missing"),
        ({"diagnostics": ["heavy-tail"]}, r"diagnostics\[0\] = 'heavy-tail': must be a table"),
        (
            {"diagnostics": [{"kind": "heavy-tail", "value": "x", "limit": 0.7, "text": "x"}]},
            r"diagnostics\[0\]\.value = 'x': must be a number",
        ),
    ],
)
def test_diagnostics_that_nobody_wrote_are_refused(sample, damage, words):
    document = copy.deepcopy(sample)
    document["estimate"] |= damage
    with pytest.raises(InputError, match=words):
        result_from_document(document)
