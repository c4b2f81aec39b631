"""A folder that keeps violations alone tells the same as one that keeps all rollouts."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.panel.loading import load_run
from pemviz.reports.markdown import summary_markdown
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.kept_rollout import read_kept_rollout, read_rollout
from pemviz.runs.observers import LeastRobust
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import write_result
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record
from tests.faults.test_resume import StopAfter, contents, folder_of

ALL = ExperimentConfig(
    method="mixture",
    stages=1,
    rollouts=60,
    final_rollouts=240,
    seed=4,
    memory_s=0.2,
    measured_memory=False,
)
CONFIGS = {"all": ALL, "violations": replace(ALL, keep="violations")}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Of both; where few are kept, of a run that was stopped once its final stage was in a file."""
    root = tmp_path_factory.mktemp("kept")
    found = {name: folder_of(root, name) for name in CONFIGS}
    record(build_experiment(CONFIGS["all"]), found["all"])
    experiment, stop = build_experiment(CONFIGS["violations"]), StopAfter(3)
    stopped = record(experiment, found["violations"], observers=[stop], should_stop=stop)
    assert (stopped.status, len(stopped.stages)) == ("stopped", 3)
    record(experiment, found["violations"])
    return found


def test_results_do_not_depend_on_what_is_kept(folders):
    every, few = (contents(folder)["result"] for folder in folders.values())
    assert few["config"].pop("keep") == "violations"
    assert every == few
    assert not (folders["violations"] / "stages").exists()


def test_violations_and_the_least_robust_are_kept_as_they_were(folders):
    every, few = (load_rollouts(folder) for folder in folders.values())
    result = contents(folders["violations"])["result"]
    final = [s["stage"] for s in result["stages"] if s["kind"] == "final"]
    is_final = np.isin(every["stage"], final)
    index = np.concatenate([np.arange(s["rollouts"]) for s in result["stages"]])
    few_final = np.isin(few["stage"], final)
    assert few_final.sum() >= every["violated"][is_final].sum() > 20
    assert few_final.sum() < is_final.sum()
    np.testing.assert_array_equal(few["rollout"][~few_final], index[~is_final])
    rows = {key: row for row, key in enumerate(zip(every["stage"], index, strict=True))}
    kept = [rows[key] for key in zip(few["stage"], few["rollout"], strict=True)]
    for name, values in every.items():
        np.testing.assert_array_equal(few[name], values[kept], err_msg=name)
    left_out = np.setdiff1d(np.arange(index.size), kept)
    assert not every["violated"][left_out].any()
    listed = {(one["stage"], one["rollout"]) for one in result["least_robust"]}
    assert listed <= set(zip(few["stage"].tolist(), few["rollout"].tolist(), strict=True))


def test_a_rank_names_the_same_rollout(folders):
    for rank in (1, 7, 20):
        every, few = (read_kept_rollout(folder, rank=rank) for folder in folders.values())
        assert (every.stage, every.rollout) == (few.stage, few.rollout)
        np.testing.assert_array_equal(every.signals["gap_m"], few.signals["gap_m"])
    for rank in (360, 0, -1, 1.5, "x"):
        words = rf"rank = {rank!r}: must be a whole number from 1 to \d+, .* kept in"
        with pytest.raises(InputError, match=words):
            read_kept_rollout(folders["violations"], rank=rank)


def test_the_panel_and_the_report_say_that_others_are_left_out(folders):
    every, few = (load_run(folder) for folder in folders.values())
    assert every.kept == every.simulated == few.simulated == 360
    assert few.kept < few.simulated
    listed = few.rollouts["rollout"][few.rollouts["stage"] == few.result.stages[-1].stage]
    assert listed[-1] > listed.size  # counted in the stage, not in what is kept of it
    assert "rollouts in its files" in summary_markdown(few.result)
    assert "rollouts in its files" not in summary_markdown(every.result)


def test_a_table_whose_numbers_are_none_is_refused(folders, tmp_path):
    folder = folder_of(tmp_path, "damaged")
    (folder / "config.toml").write_bytes((folders["violations"] / "config.toml").read_bytes())
    write_result(folder, read_result(folders["violations"]))
    table = load_rollouts(folders["violations"])
    np.savez(folder / "rollouts.npz", **table | {"rollout": table["rollout"][1:]})
    with pytest.raises(InputError, match="rollout has shape"):
        load_run(folder)
    with pytest.raises(InputError, match="rollout has shape"):
        read_kept_rollout(folder, rank=1)


@pytest.mark.parametrize("name", CONFIGS)
def test_a_kept_rollout_is_the_one_that_an_observer_saw(folders, name):
    worst = LeastRobust()
    run(build_experiment(ALL), observers=[worst])
    seen, kept = worst.rollout, read_rollout(folders[name])
    assert seen is not None
    np.testing.assert_array_equal(kept.detected, seen.detected)
    np.testing.assert_allclose(kept.time_s, seen.time_s)
    for signal, values in kept.signals.items():
        same = next(one for one in seen.signals if f"{signal}_".startswith(f"{one}_"))
        np.testing.assert_allclose(values, seen.signals[same], rtol=1e-6)
    assert list(kept.signals)[:3] == ["gap_m", "ego_speed_mps", "lead_speed_mps"]
    assert (kept.stage, kept.robustness, kept.violated) == (
        seen.stage,
        pytest.approx(seen.robustness),
        seen.violated,
    )
    assert kept.nll == pytest.approx(seen.nll, rel=1e-6)
    assert str(read_rollout(folders[name], rank=2)).startswith("rollout of rank 2: ")
    assert "<svg" in kept._repr_html_()
