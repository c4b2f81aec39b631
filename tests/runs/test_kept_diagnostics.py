"""Diagnostics in ``result.json``: what is read back gives the answers that the run gave."""

import json
from pathlib import Path

import pytest

from pemviz.config import METHODS, ExperimentConfig
from pemviz.errors import InputError
from pemviz.reports.gate import interval_caveats
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document, result_from_document

ROOT = Path(__file__).resolve().parents[2]
SIZES = {"stages": 1, "rollouts": 20, "final_rollouts": 20, "epochs": 5}


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
def result(request):
    return run_experiment(ExperimentConfig(method=request.param, repetitions=2, **SIZES))


def test_what_is_read_back_is_as_reliable_as_it_was(result):
    assert any(estimate.diagnostics for estimate in result.repetitions)
    read = result_from_document(through_json(result))
    for found, estimate in zip(estimates_of(read), estimates_of(result), strict=True):
        assert found == estimate
        assert interval_caveats(found) == interval_caveats(estimate)


def test_older_results_give_the_same_answers(result):
    read = result_from_document(older(through_json(result)))
    for found, estimate in zip(estimates_of(read), estimates_of(result), strict=True):
        assert found.warnings == estimate.warnings
        assert [one.kind for one in found.diagnostics] == [o.kind for o in estimate.diagnostics]
        assert interval_caveats(found) == interval_caveats(estimate)


def test_the_sample_run_warns_of_nothing():
    document = json.loads((ROOT / "recordings/sample/result.json").read_text(encoding="utf-8"))
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
def test_diagnostics_that_nobody_wrote_are_refused(damage, words):
    config = ExperimentConfig(method="monte-carlo", final_rollouts=20)
    document = through_json(run_experiment(config))
    document["estimate"] |= damage
    with pytest.raises(InputError, match=words):
        result_from_document(document)
