"""A memory that an error model carries goes with it into every run, unless it is switched off."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import pemviz
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_text, load_config, load_preset
from pemviz.pem import load_pem, memory_of
from pemviz.pem.models.memory import Memory
from pemviz.runs.experiment import build_experiment
from pemviz.runs.model_comparison import compare_models
from pemviz.sampling.state.composed import memory_of_pem

RRC = memory_of(load_pem("rrc"))


def assumed(config: ExperimentConfig) -> Memory:
    return memory_of_pem(build_experiment(config).pem)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, RRC),
        ({"memory_s": 0.0}, replace(RRC, tau_s=0.0)),
        ({"frailty": 0.0}, replace(RRC, frailty=0.0)),
        ({"memory_s": 0.0, "frailty": 0.0}, Memory()),
        ({"memory_s": 0.1, "frailty": 0.2}, Memory(0.1, 0.2)),
        ({"assumed_memory_s": 0.1}, RRC),
        ({"pem": "ml-nn"}, Memory()),
        ({"pem": "ml-nn", "assumed_memory_s": 0.1}, Memory(0.1)),
        ({"pem": "ml-nn", "assumed_memory_s": 0.1, "memory_s": 0.0}, Memory()),
    ],
)
def test_what_is_left_out_is_the_models_own(changed, expected):
    config = replace(ExperimentConfig(pem="rrc"), **changed)
    assert assumed(config) == expected


def test_a_model_of_ones_own_brings_its_memory():
    @dataclass(frozen=True)
    class Camera:
        memory: Memory

        def logit(self, salient):
            return np.full(salient.shape[:-1], 2.0)

    experiment = build_experiment(ExperimentConfig(), pem=Camera(Memory(0.3, 0.4)))
    assert memory_of_pem(experiment.pem) == Memory(0.3, 0.4)
    with pytest.raises(pemviz.InputError, match="Camera: its memory is a str, must be a Memory"):
        build_experiment(ExperimentConfig(), pem=Camera("long"))


def test_where_there_are_slots_the_memory_time_stays_and_the_frailty_is_told_of():
    experiment = build_experiment(replace(load_preset("cut-in"), pem="rrc"))
    assert memory_of_pem(experiment.pem) == Memory(RRC.tau_s)
    assert any("its frailty 0.68 is left out" in line for line in experiment.warnings)
    assert assumed(load_preset("cut-in")) == Memory(0.25)


def test_left_out_and_none_are_told_apart_in_files(tmp_path: Path):
    path = tmp_path / "config.toml"
    for config in (ExperimentConfig(pem="rrc"), ExperimentConfig(pem="rrc", memory_s=0.0)):
        path.write_text(config_text(config))
        assert load_config(path) == config
    path.write_text('pem = "rrc"\nmemory_s = 0.0\nfrailty = 0.0\n')  # as earlier versions have it
    assert assumed(load_config(path)) == Memory()


def test_models_are_compared_without_their_memory():
    """With it ``rrc`` has 5e-3."""
    figures = compare_models(ExperimentConfig(), ["rrc", "ml-nn"], rollouts=50)
    assert all(one.probability < 1e-12 for one in figures)
