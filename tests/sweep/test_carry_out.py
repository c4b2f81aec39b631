import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError, RunError
from pemviz.pem import constant_errors, save_position_errors
from pemviz.processes import DIED, ONE_THREAD
from pemviz.sweep.carry_out import (
    ATTEMPTS,
    carry_out_runs,
    finished_before,
    read_finished,
    write_folder,
)
from pemviz.sweep.plan import make_plan, parse_variation
from pemviz.sweep.run_task import ModelFiles, RunOutcome, carry_out, model_files, models_of, task_of
from pemviz.sweep.tables import rows
from pemviz.sweep.workers import LocalWorkers
from tests.comparable_results import comparable, comparable_result

NAIVE = ExperimentConfig(method="naive", final_rollouts=20, measured_memory=False)
MODELS = {("ml-nn", None): ModelFiles()}


class InThisProcess:
    """Workers that fail as they are told: {run's number: how often}."""

    def __init__(self, plan, failures):
        self._left = {plan.runs[number].name: count for number, count in failures.items()}
        self._waiting = []
        self.handed_in = []

    capacity = 2

    def submit(self, task):
        self._waiting.append(task)
        self.handed_in.append(task.name)

    def finished(self, *, timeout_s):
        task = self._waiting.pop()  # the last first: order must not matter
        if self._left.get(task.name, 0):
            self._left[task.name] -= 1
            return [RunOutcome(task.name, message="the simulator raised")]
        return [carry_out(task)]


def driven(runs, plan, workers, *, keep="results", should_stop=lambda: False, reports=None):
    states = {}
    carry_out_runs(
        runs,
        plan.runs,
        workers,
        models=MODELS,
        keep=keep,
        on_report=[].append if reports is None else reports.append,
        on_end=lambda state: states.update({state.planned.name: state}),
        should_stop=should_stop,
    )
    return states


@pytest.mark.parametrize("failures", [{}, {1: 1}, {1: 5}, {0: 1, 3: 9}])
def test_what_fails_is_tried_once_more_and_the_rest_goes_on(tmp_path, failures):
    plan = make_plan(NAIVE, [], seeds=4)
    workers = InThisProcess(plan, failures)
    reports = []
    states = driven(tmp_path, plan, workers, reports=reports)
    for number, run in enumerate(plan.runs):
        failed = min(failures.get(number, 0), ATTEMPTS)
        state = states[run.name]
        assert state.status == ("failed" if failed == ATTEMPTS else "done")
        assert state.message == ("the simulator raised" if failed == ATTEMPTS else None)
        assert workers.handed_in.count(run.name) == min(failed + 1, ATTEMPTS)
        of_run = [report for report in reports if report.state.planned == run]
        assert [report.again for report in of_run] == [True, False][2 - len(of_run) :]
        assert (tmp_path / run.name / "result.json").exists() == (state.status == "done")
    table = rows(plan, [states[run.name] for run in plan.runs])
    assert [row["probability"] is None for row in table] == [
        failures.get(number, 0) >= ATTEMPTS for number in range(4)
    ]


def test_stopping_hands_in_nothing_more(tmp_path):
    plan = make_plan(NAIVE, [], seeds=5)
    workers = InThisProcess(plan, {})
    reports = []
    states = driven(tmp_path, plan, workers, reports=reports, should_stop=lambda: len(reports) == 2)
    assert len(states) == 2
    assert len(workers.handed_in) == 3
    before = finished_before(tmp_path, plan.runs, keep="results")
    assert {s.planned.name for s in before if s.status == "done"} == set(states)


def test_a_run_that_fails_by_itself_is_told_with_its_reason():
    (planned,) = make_plan(NAIVE, []).runs
    task = task_of(planned, model=ModelFiles(), keep="results")
    broken = replace(task, config_toml=task.config_toml.replace("gap >= 2.0", "gap >="))
    outcome = carry_out(broken)
    assert outcome.message is not None
    assert "spec" in outcome.message
    assert "\n" not in outcome.message
    assert outcome.files == ()


def test_own_position_errors_travel_with_the_run_and_changed_ones_make_another_result(tmp_path):
    """A worker elsewhere sees no file of this machine; a folder of a run before tells which."""
    here, runs = tmp_path / "here" / "errors.safetensors", tmp_path / "runs"
    here.parent.mkdir()
    runs.mkdir()
    save_position_errors(constant_errors(range_sd_m=0.5), here)
    config = replace(NAIVE, position_errors=str(here))
    (planned,) = make_plan(config, []).runs
    task = task_of(planned, model=model_files(models_of(config)), keep="results")
    here.rename(tmp_path / "away.safetensors")
    outcome = carry_out(task)
    assert outcome.message is None
    write_folder(runs, planned.name, outcome.files)
    assert read_finished(runs, planned, keep="results") is not None
    save_position_errors(constant_errors(range_sd_m=0.6), here)
    (changed,) = make_plan(config, []).runs
    assert changed.name == planned.name
    assert read_finished(runs, changed, keep="results") is None
    here.unlink()
    with pytest.raises(InputError, match=r"errors\.safetensors': cannot be read "):
        model_files(models_of(config))


def test_another_version_is_refused():
    (planned,) = make_plan(NAIVE, []).runs
    task = replace(task_of(planned, model=ModelFiles(), keep="results"), version="0.0.1")
    assert "0.0.1" in (carry_out(task).message or "")


def test_a_result_of_another_error_model_is_no_result(tmp_path):
    (planned,) = make_plan(NAIVE, []).runs
    other = replace(planned, pem_digest="0" * 64)
    plan = replace(make_plan(NAIVE, []), runs=(other,))
    states = driven(tmp_path, plan, InThisProcess(plan, {}))
    assert states[planned.name].status == "failed"
    assert "another model" in (states[planned.name].message or "")


@pytest.mark.parametrize("name", ["../x", "a/b", ".hidden", "/etc/x", ""])
def test_files_that_workers_send_stay_in_their_folder(tmp_path, name):
    (tmp_path / "runs").mkdir()
    with pytest.raises(RunError, match="a worker sent a file named"):
        write_folder(tmp_path / "runs", "run", [(name, b"")])
    assert not (tmp_path / "runs" / "run").exists()
    assert {p.name for p in tmp_path.iterdir()} == {"runs"}


def test_a_folder_that_cannot_be_written_ends_the_sweep_in_one_line(tmp_path):
    plan = make_plan(NAIVE, [])
    with pytest.raises(RunError, match="its folder cannot be written") as caught:
        driven(tmp_path / "gone", plan, InThisProcess(plan, {}))
    assert "\n" not in str(caught.value)


THREADS = """
import numpy
from pemviz.sweep.run_task import _use_one_thread
_use_one_thread()
import torch
threads = [torch.get_num_threads()]
torch.set_num_threads(3)
_use_one_thread()
print([*threads, torch.get_num_threads()])
"""


def test_torch_has_one_thread_whether_it_is_imported_before_or_after():
    environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    done = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.strip() == "[1, 1]"


@pytest.mark.slow
def test_a_process_that_is_killed_costs_one_attempt_of_its_own_run(tmp_path):
    slow = ExperimentConfig(
        method="adaptive", stages=2, rollouts=20, final_rollouts=20, epochs=1500
    )
    plan = make_plan(slow, [parse_variation("alpha=0.1,0.5")], seeds=2)
    reports = []
    with LocalWorkers(2) as workers:
        killer = threading.Thread(target=_kill_one_child)
        killer.start()
        states = driven(tmp_path, plan, workers, reports=reports)
        killer.join()
    assert [report.state.message for report in reports if report.again] == [f"its {DIED}"]
    assert {state.status for state in states.values()} == {"done"}
    for run in plan.runs:
        alone = carry_out(task_of(run, model=ModelFiles(), keep="results"))
        expected = json.loads(dict(alone.files)["result.json"])
        assert comparable_result(tmp_path / run.name) == comparable(expected)
    assert multiprocessing.active_children() == []


def _kill_one_child():
    while not multiprocessing.active_children():
        time.sleep(0.05)
    time.sleep(0.5)
    pid = multiprocessing.active_children()[0].pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
