import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from pemviz.config import ExperimentConfig
from pemviz.panel.controller import Controller, PanelState
from pemviz.panel.loading import load_run
from pemviz.panel.run_data import RunData

SMALL = ExperimentConfig(
    method="adaptive",
    stages=3,
    rollouts=40,
    final_rollouts=40,
    epochs=20,
    seed=5,
    measured_memory=False,
)
NAIVE = replace(SMALL, method="naive", final_rollouts=60)


def wait_until(controller: Controller, done=lambda state: not state.running, *, timeout_s=600.0):
    """The controller's state once ``done``; fails after the timeout."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        state = controller.state
        if done(state):
            return state
        time.sleep(0.01)
    pytest.fail(f"the controller did not get there: {controller.state}")


@pytest.fixture
def controller(tmp_path):
    with closing(Controller(tmp_path / "recordings")) as made:
        yield made


def ran(root: Path, config: ExperimentConfig) -> PanelState:
    """The panel's last state of a run that is over."""
    with closing(Controller(root)) as made:
        assert made.start(config)
        state = wait_until(made)
    assert state.error is None
    assert state.run is not None
    return state


@pytest.fixture(scope="session")
def kept(tmp_path_factory) -> tuple[Path, PanelState]:
    """A small adaptive run that is over: its folder, and the panel's last state of it."""
    state = ran(tmp_path_factory.mktemp("recordings"), SMALL)
    return state.run.folder, state


@pytest.fixture(scope="session")
def live_run(kept) -> RunData:
    return kept[1].run


@pytest.fixture(scope="session")
def loaded_run(kept) -> RunData:
    return load_run(kept[0])


@pytest.fixture(scope="session")
def naive_run(tmp_path_factory) -> RunData:
    """Most of its rollouts violate; it tells what measured memories would give."""
    config = replace(NAIVE, measured_memory=True)
    return ran(tmp_path_factory.mktemp("recordings"), config).run
