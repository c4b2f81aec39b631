"""Several models from one set of rollouts, against exactly known probabilities."""

import math

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import InputError
from pemviz.runs.experiment import build_experiment
from pemviz.runs.model_comparison import compare_models
from pemviz.sampling.zero_variance.reference import exact_log_probability

CONFIG = ExperimentConfig(scenario=ScenarioConfig(states=50), spec="always[0,49] (gap >= 6.5)")
MODEL = """
import numpy as np

class Model:
    name, digest, data, licence = "{name}", "", "nothing", "none"

    def logit(self, salient):
        return {at_zero} - 0.1 * np.asarray(salient)[..., 9]
"""


@pytest.fixture
def models(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, at_zero in (("careful_pem", 5.0), ("careless_pem", 3.0)):
        (tmp_path / f"{name}.py").write_text(MODEL.format(name=name, at_zero=at_zero))
    return "careful_pem:Model", "careless_pem:Model"


def test_every_model_gets_its_exact_probability(models):
    """z-tests at 4 standard errors: false alarm 6e-5 each; the seed is fixed."""
    figures = compare_models(CONFIG, models, rollouts=600, allow_python=True)
    truth = []
    for name, one in zip(models, figures, strict=True):
        experiment = build_experiment(
            ExperimentConfig(scenario=CONFIG.scenario, spec=CONFIG.spec, pem=name),
            allow_python=True,
        )
        exact = exact_log_probability(experiment.problem, twin=experiment.twin)
        assert exact is not None
        truth.append(math.exp(exact))
        assert abs(one.probability - truth[-1]) < 4 * one.std_error
        assert one.std_error < 0.1 * truth[-1]
        assert one.unreliable_because == one.interval_caveats == ()
    ratio = figures[1].to_first
    assert figures[0].to_first is None
    half = (ratio.log10_high - ratio.log10_low) / 2
    assert abs(ratio.log10_ratio - np.log10(truth[1] / truth[0])) < 4 * half / 1.96


def test_without_violations_there_is_no_ratio(models):
    config = ExperimentConfig(scenario=ScenarioConfig(states=20), spec="always[0,19] (gap >= 2.0)")
    figures = compare_models(config, models, rollouts=5, allow_python=True)
    assert [one.log10_probability for one in figures] == [None, None]
    assert [one.to_first for one in figures] == [None, None]
    assert all(one.unreliable_because for one in figures)


def test_code_runs_only_if_the_command_line_says_so(models, capsys, tmp_path):
    with pytest.raises(InputError, match="--allow-python"):
        build_experiment(ExperimentConfig(pem=models[0]))
    words = ["record", "--method", "monte-carlo", "--pem", models[0], "--out", str(tmp_path)]
    short = ["--scenario.states", "50", "--spec", CONFIG.spec, "--no-recording", "--json"]
    short += ["--no-measured-memory", "--no-plan"]
    assert main([*words, *short]) == 2
    assert "--allow-python" in capsys.readouterr().err
    assert main([*words, *short, "--allow-python"]) == 0


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["ml-nn"], "at least two"),
        (["ml-nn", "moon"], "moon"),
        (["ml-nn", "lr", "--rollouts", "1"], "rollouts"),
    ],
)
def test_bad_input_is_one_line(capsys, words, fragment):
    assert main(["pem", "compare", *words]) == 2
    shown = capsys.readouterr()
    assert fragment in shown.err
    assert shown.err.count("\n") == 1
