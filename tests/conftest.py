import os
import signal
import sys
from pathlib import Path

# a worker a core: threads within one would but wait for those of the others; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")
# hundreds of processes are started: each would compile anew what may not be kept compiled
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    sys.dont_write_bytecode = False

import numpy as np
import pytest
from hypothesis import settings

from pemviz.sampling.problem import Problem
from tests.toy import MissCounter, constant_pem

settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("repeatable")

TESTS = Path(__file__).resolve().parent
TOGETHER = {
    *("browser", "panel", "recording", "reproduce", "studies", "sweep"),
    *(
        "test_budget_document.py",
        "test_edited_runs.py",
        "test_every_method.py",
        "test_gsn_file.py",
        "test_house_rules.py",
        "test_interpretation.py",
        "test_interval_words.py",
        "test_learning_in_parts.py",
        "test_memory_curve.py",
        "test_result_file.py",
        "test_risk_budget.py",
        "test_store.py",
    ),
}
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name: str) -> Path:
    """A file of the development data; absent in a user's checkout, required in CI."""
    path = SHARED_DATA / name
    if not path.exists():
        if os.environ.get("PEMVIZ_REQUIRE_DATA") == "1":
            pytest.fail(f"the development data must be here: {path}")
        pytest.skip(f"development data {path} is not here")
    return path


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Browser tests are slow, and share one worker: two cores are too few for two browsers.

    So do the tests of what else is in ``TOGETHER``: each has what takes long to make.
    """
    for item in items:
        path = item.path.relative_to(TESTS)
        if path.parts[0] == "browser":
            item.add_marker(pytest.mark.slow)
        for shared_runs in {path.parts[0], path.name} & TOGETHER:
            item.add_marker(pytest.mark.xdist_group(shared_runs))


@pytest.fixture(scope="session", autouse=True)
def _no_power_cuts():
    """Nothing waits for the disk: what a file holds after a power cut, no test can see."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session")
def authors_checkpoint() -> Path:
    return shared("authors_pem/pem_ml_nn.safetensors")


@pytest.fixture(scope="session")
def authors_proposals() -> list[Path]:
    folder = shared("authors_pem")
    return sorted(folder.glob("proposal_*.safetensors"))


@pytest.fixture
def toy_problem() -> Problem:
    """Six steps, a miss with probability 0.1 each; four misses or more violate."""
    return Problem(
        simulator=MissCounter(states=7),
        pem=constant_pem(detection_probability=0.9),
        robustness=lambda signals: np.min(signals["gap"], axis=1),
        violated=lambda signals: np.min(signals["gap"], axis=1) < 0.0,
    )


@pytest.fixture
def ctrl_c():
    """SIGINT raises KeyboardInterrupt, as in a terminal; what runs in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
