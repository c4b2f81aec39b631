"""Diagnostics in ``result.json``: what is read back gives the answers that the run gave."""

import json
from pathlib import Path

import pytest

from pemviz.config import METHODS, ExperimentConfig
from pemviz.errors import InputError
from pemviz.reports.gate import unreliable_because
from pemviz.runs.engine import run_experiment
from pemviz.runs.result import estimate_document, estimate_from_document

ROOT = Path(__file__).resolve().parents[2]
SIZES = {"stages": 1, "rollouts": 20, "final_rollouts": 20, "epochs": 5}


def through_json(estimate):
    return json.loads(json.dumps(estimate_document(estimate), allow_nan=False))


def older(document):
    """As written before diagnostics were kept."""
    return {name: value for name, value in document.items() if name != "diagnostics"}


# value-twisted takes long to begin, and its estimates have nothing wrong
@pytest.fixture(scope="module", params=sorted({*METHODS.shipped} - {"value-twisted"}))
def result(request):
    return run_experiment(ExperimentConfig(method=request.param, repetitions=2, **SIZES))


def test_what_is_read_back_is_as_reliable_as_it_was(result):
    assert any(estimate.diagnostics for estimate in result.repetitions)
    for estimate in (result.estimate, *result.repetitions):
        found = estimate_from_document(through_json(estimate))
        assert found == estimate
        assert unreliable_because(found) == unreliable_because(estimate)


def test_older_results_give_the_same_answers(result):
    for estimate in (result.estimate, *result.repetitions):
        found = estimate_from_document(older(through_json(estimate)))
        assert found.warnings == estimate.warnings
        assert [one.kind for one in found.diagnostics] == [o.kind for o in estimate.diagnostics]
        assert unreliable_because(found) == unreliable_because(estimate)

    document = json.loads((ROOT / "recordings/sample/result.json").read_text(encoding="utf-8"))
    found = estimate_from_document(document["estimate"])
    assert list(found.warnings) == document["estimate"]["warnings"]
    assert unreliable_because(found) == (
        "one rollout carries 51% of the weight",
        "the effective sample size is 3.0",
    )


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ({"warnings": ["all is well"]}, "must be the texts"),
        ({"warnings": []}, "must be the texts"),
        ({"warnings": [3]}, "must be texts"),
        ({"diagnostics": [{"kind": "fine", "value": 1.0, "limit": 2.0, "text": "x"}]}, "'fine'"),
        ({"diagnostics": [{"kind": "heavy-tail"}]}, "not as pemviz writes it"),
        ({"diagnostics": ["heavy-tail"]}, "not as pemviz writes it"),
        (
            {"diagnostics": [{"kind": "heavy-tail", "value": "x", "limit": 0.7, "text": "x"}]},
            "none that pemviz writes",
        ),
    ],
)
def test_diagnostics_that_nobody_wrote_are_refused(damage, words):
    config = ExperimentConfig(method="monte-carlo", final_rollouts=20)
    document = through_json(run_experiment(config).estimate)
    with pytest.raises(InputError, match=words):
        estimate_from_document({**document, **damage})
