import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from pemviz.config.toml_files import load_config
from pemviz.errors import InputError
from pemviz.files.atomic import write_text
from pemviz.proposals.gap_network import gap_network_from_arrays
from pemviz.runs import rollout_files
from pemviz.runs.engine import run_experiment
from pemviz.runs.observers import KeptStages
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import RunStore, create_run_folder
from tests.comparable_results import comparable_result
from tests.faults.test_resume import StopAfter
from tests.runs.test_engine import SMALL

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    stages, config = KeptStages(), replace(SMALL, repetitions=2)
    run_experiment(config, run_id="test", observers=[RunStore(folder), stages])
    return folder, stages.stages, config


def test_the_folder_holds_what_the_contract_says(finished):
    folder, _, _ = finished
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.toml", "proposals.safetensors", "result.json", "rollouts.npz",
    ]  # fmt: skip


def test_rollouts_are_those_of_the_run(finished):
    folder, stages, _ = finished
    arrays = load_rollouts(folder)
    total = sum(stage.scored.rollouts.count for stage in stages)
    shapes = {name: array.shape for name, array in arrays.items()}
    assert shapes == {
        "repetition": (total,), "stage": (total,), "robustness": (total,), "violated": (total,),
        "gap_m": (total, 100), "ego_speed_mps": (total, 100), "lead_speed_mps": (total, 100),
        "detected": (total, 99), "log_p": (total, 99), "log_q": (total, 99),
    }  # fmt: skip
    for stage in stages:
        mine = (arrays["repetition"] == stage.repetition) & (arrays["stage"] == stage.stage)
        rollouts = stage.scored.rollouts
        np.testing.assert_array_equal(arrays["gap_m"][mine], rollouts.signals["gap"])
        np.testing.assert_array_equal(arrays["detected"][mine], rollouts.detected)
        np.testing.assert_array_equal(arrays["log_q"][mine], rollouts.log_q)
        np.testing.assert_array_equal(arrays["robustness"][mine], stage.scored.robustness)
    with np.load(folder / "rollouts.npz", allow_pickle=False) as plain:
        assert (plain["gap_m"].dtype, plain["detected"].dtype) == (np.float64, np.bool_)


def test_stages_are_joined_equally_however_many_files_are_open(tmp_path, monkeypatch):
    joined = []
    for most_open in (64, 1):
        monkeypatch.setattr(rollout_files, "MOST_OPEN", most_open)
        folder = tmp_path / str(most_open)
        folder.mkdir()
        run_experiment(SMALL, run_id="test", observers=[RunStore(folder)])
        joined.append((folder / "rollouts.npz").read_bytes())
    assert joined[0] == joined[1]


def test_proposals_are_those_learned(finished):
    folder, stages, _ = finished
    arrays = load_file(folder / "proposals.safetensors")
    learned = [stage for stage in stages if stage.learned is not None]
    assert len(arrays) == 6 * len(learned)
    gap_m = np.linspace(0, 15, 30)
    for stage in learned:
        prefix = f"repetition.{stage.repetition}.stage.{stage.stage}."
        mine = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
        network = gap_network_from_arrays(mine)
        np.testing.assert_array_equal(network.logit_at(gap_m), stage.learned.logit_at(gap_m))


def test_config_of_a_run_reproduces_it(finished, tmp_path):
    folder, _, config = finished
    again = load_config(folder / "config.toml")
    assert again == config
    run_experiment(again, run_id="test", observers=[RunStore(tmp_path)])
    assert comparable_result(folder) == comparable_result(tmp_path)


def test_result_is_strict_json_with_the_contracts_keys(finished):
    def refuse(constant):
        raise AssertionError(constant)

    text = (finished[0] / "result.json").read_text(encoding="utf-8")
    document = json.loads(text, parse_constant=refuse)
    assert set(document) >= {
        "schema", "run_id", "status", "seed", "versions", "config", "pem", "estimate",
        "reference", "pem_interval", "sensitivity", "repetitions", "stages", "least_robust",
        "assumptions", "timings_s",
    }  # fmt: skip
    assert set(document["estimate"]) >= {
        "method", "probability", "log10_probability", "std_error", "ci_low", "ci_high",
        "confidence", "rollouts_simulated", "rollouts_in_estimate", "failures", "nll_mean",
        "nll_log_mean", "ess", "pareto_k", "max_weight_share", "unbiased", "warnings",
    }  # fmt: skip
    assert document["schema"] == 2
    assert document["status"] == "done"
    assert len(document["least_robust"]) == 20


KILLED_RUN = """
import sys
from pathlib import Path
from dataclasses import replace
from pemviz.runs.engine import run_experiment
from pemviz.runs.run_folder import RunStore
from tests.runs.test_engine import SMALL

run_experiment(replace(SMALL, stages=1000), observers=[RunStore(Path(sys.argv[1]))])
"""


def test_a_killed_run_leaves_every_finished_stage_readable(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", KILLED_RUN, str(tmp_path)], cwd=ROOT)
    deadline = time.monotonic() + 60
    while len(list(tmp_path.glob("stages/repetition*.npz"))) < 4:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    document = json.loads((tmp_path / "result.json").read_text())
    arrays = load_rollouts(tmp_path)
    assert document["status"] == "stopped"
    assert len(document["stages"]) >= 3
    whole = 30 * len(document["stages"])
    assert arrays["gap_m"].shape[0] in (whole, whole + 30)
    assert load_config(tmp_path / "config.toml").stages == 1000


def test_a_stopped_run_is_joined_as_far_as_it_went(tmp_path):
    stop = StopAfter(2)
    run_experiment(SMALL, observers=[stop, RunStore(tmp_path)], should_stop=stop)
    assert load_rollouts(tmp_path)["stage"].tolist() == [0] * 30 + [1] * 30


def test_run_folders_never_collide(tmp_path):
    folders = {create_run_folder(tmp_path, label="adaptive") for _ in range(5)}
    assert len(folders) == 5
    assert all(folder.is_dir() for folder in folders)


def test_a_place_that_cannot_hold_runs_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no run folder can be made there"):
        create_run_folder(tmp_path / "file", label="adaptive")


def test_damaged_rollouts_are_named(tmp_path):
    with pytest.raises(InputError, match="has no rollouts"):
        load_rollouts(tmp_path)
    (tmp_path / "rollouts.npz").write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(InputError, match=r"rollouts\.npz: cannot be read"):
        load_rollouts(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "result.json"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "\ud800")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
