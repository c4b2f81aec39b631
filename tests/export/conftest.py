from pathlib import Path

import pytest

import pemviz
from pemviz.config import ScenarioConfig
from pemviz.runs.run_folder import record
from tests.sampling.test_slots import BY_SLOT, GhostBrake

RULES = {"moves": "always[0,15] (speed >= 0.5)", "hits-not": "always[0,15] (gap >= 0.5)"}
SAMPLE = Path(__file__).resolve().parents[2] / "recordings" / "sample"


@pytest.fixture(scope="session")
def memory_run(tmp_path_factory):
    """The shipped scenario with misses that hang together and obstacles that differ."""
    config = pemviz.ExperimentConfig(
        method="naive",
        final_rollouts=4,
        pem="lr",
        memory_s=0.1,
        frailty=0.5,
        spec="always[0,5] (gap >= 2.0)",
        scenario=ScenarioConfig(states=6),
    )
    folder = tmp_path_factory.mktemp("memory")
    record(pemviz.build_experiment(config), folder)
    return folder


@pytest.fixture
def sample_run():
    """The run that is shipped: 174 rollouts of 70 states, of which some violate."""
    return SAMPLE


@pytest.fixture(scope="session")
def slots_run(tmp_path_factory):
    """A simulator of one's own with a car, a ghost, a memory of misses, and two rules."""
    config = pemviz.ExperimentConfig(
        method="naive", final_rollouts=60, seed=4, memory_s=0.2, plan=False
    ).with_rules(RULES)
    folder = tmp_path_factory.mktemp("slots")
    record(pemviz.build_experiment(config, simulator=GhostBrake(), pem=BY_SLOT), folder)
    return folder
