"""One run at a time, stop, errors; what is shown never changes what is computed."""

import json
import threading
import time
from contextlib import closing
from dataclasses import replace

from pemviz.panel.controller import Controller
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document
from tests import comparable_results
from tests.panel.conftest import NAIVE, SMALL, wait_until

VARYING = ("run_id", *comparable_results.VARYING)


def fixed(document):
    return {key: value for key, value in document.items() if key not in VARYING}


def test_a_run_is_kept_and_equals_one_without_a_panel(kept):
    folder, state = kept
    alone = result_document(run_experiment(SMALL))
    on_disk = json.loads((folder / "result.json").read_text())
    assert fixed(on_disk) == fixed(alone)
    assert fixed(result_document(state.run.result)) == fixed(alone)
    assert not state.running
    assert state.finished_runs == 1


def test_progress_counts_all_rollouts(kept):
    progress = kept[1].progress
    assert progress.done == progress.planned == 4 * 40 + 40
    assert progress.share == 1.0
    assert progress.left_s == 0.02 * 200 * progress.sampled_s / 200  # once more


def test_every_stage_adds_a_curve_and_its_rollouts(live_run):
    assert [curve.stage for curve in live_run.curves] == [0, 1, 2, 3]
    assert live_run.kept == live_run.simulated == 200
    assert live_run.rollouts["stage"].tolist() == [s for s in range(5) for _ in range(40)]
    assert live_run.rollouts["rollout"].tolist() == [*range(40)] * 5


def test_a_second_run_is_refused_while_one_is_under_way(controller):
    assert controller.start(replace(SMALL, epochs=2000))
    assert not controller.start(NAIVE)
    controller.stop()
    state = wait_until(controller)
    assert state.error is None


def test_stop_keeps_what_was_finished(controller):
    controller.start(replace(SMALL, stages=1000))
    wait_until(controller, lambda s: s.run is not None and s.run.kept >= 80)
    began_s = time.monotonic()
    controller.stop()
    assert controller.state.stopping
    state = wait_until(controller)
    assert time.monotonic() - began_s < 30.0  # a stage of this size takes milliseconds
    assert state.error is None
    assert state.run.result.status == "stopped"
    assert json.loads((state.run.folder / "result.json").read_text())["status"] == "stopped"
    assert (state.run.folder / "rollouts.npz").exists()


def test_stop_with_nothing_running_stops_nothing_later(controller):
    controller.stop()
    controller.start(NAIVE)
    assert wait_until(controller).run.result.status == "done"


def test_bad_input_is_told_and_the_worker_lives_on(controller):
    controller.start(replace(SMALL, spec="always[0,99] (gap >="))
    state = wait_until(controller)
    assert "spec" in state.error
    assert "\n" not in state.error
    controller.start(NAIVE)
    state = wait_until(controller)
    assert state.error is None
    assert state.run.result.status == "done"


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "recordings").write_text("a file, not a folder")
    with closing(Controller(tmp_path / "recordings")) as controller:
        controller.start(NAIVE)
        assert wait_until(controller).error.startswith("recordings = ")


def test_a_failing_observer_fails_the_run_only(tmp_path):
    class Failing:
        def notify(self, event):
            raise RuntimeError("no ink")

    with closing(Controller(tmp_path, observers=lambda folder: [Failing()])) as controller:
        controller.start(NAIVE)
        assert wait_until(controller).error == "the run failed: RuntimeError: no ink"


def test_a_quick_look_leaves_nothing_on_disk(controller):
    controller.start(NAIVE, keep=False)
    state = wait_until(controller)
    assert state.run.folder is None
    assert not controller.recordings.exists()


def test_version_grows_with_every_change(controller):
    seen = []
    watching = threading.Event()

    def watch():
        while not watching.is_set():
            seen.append(controller.state.version)
            time.sleep(0.001)

    thread = threading.Thread(target=watch)
    thread.start()
    controller.start(NAIVE)
    wait_until(controller)
    watching.set()
    thread.join()
    assert seen == sorted(seen)
    assert len(set(seen)) > 1


def test_processes_simulate_what_is_slow_to_the_same_result(tmp_path):
    """And nothing where they are of no use."""
    slow = replace(
        NAIVE, simulator="highway-env", measured_memory=False, plan=False, final_rollouts=24,
        scenario=replace(NAIVE.scenario, states=50), spec="always[0,49] (gap >= 2.0)",
    )  # fmt: skip
    results, told = [], set()
    for workers in (None, 2):
        folder = tmp_path / str(workers)
        with closing(Controller(folder, workers=workers)) as controller:
            for config in (slow, replace(slow, simulator="vectorized")):
                assert controller.start(config)
                while controller.state.running:
                    progress = controller.state.progress
                    told.add((config.simulator, progress.workers if progress else ""))
                    time.sleep(0.02)
                assert controller.state.error is None
                results.append(controller.state.run.result.estimate)
    assert results[:2] == results[2:]
    assert ("highway-env", "by 2 processes") in told
    assert ("vectorized", "by 2 processes") not in told
