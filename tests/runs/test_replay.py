"""One rollout of a run again, alone: with what it was given, and what came of it."""

import re
from dataclasses import replace

import pytest

import pemviz
from pemviz.cli.main import main
from pemviz.config.toml_files import load_preset
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record
from tests.fragile_walk import BREAKS_AT, STATES, breaks, experiment


def failed(tmp_path, how, **options):
    """The folder of a run that its simulator ended, and the rollout that its message names."""
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(pemviz.RunError) as caught:
        record(experiment(how, **options), folder, workers=2)
    return folder, caught.value


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing ended, of the same random numbers."""
    folder = tmp_path_factory.mktemp("whole")
    record(experiment("holds"), folder)
    return folder, load_rollouts(folder)


@pytest.fixture(scope="module")
def aborted(tmp_path_factory):
    return failed(tmp_path_factory.mktemp("aborted"), "aborts")


@pytest.mark.parametrize(
    ("how", "fault"),
    [("aborts", "the process was ended by SIGABRT"), ("stalls", "nothing came of it for 1 s")],
)
def test_a_rollout_that_a_message_names_fails_again_with_what_it_had(aborted, whole, how, fault):
    folder, error = aborted
    assert error.rollout is not None, str(error)
    repetition, stage, rollout = error.rollout
    assert f"rollout {rollout} (stage {stage})" in str(error)
    found = pemviz.replay(
        folder, stage=stage, rollout=rollout, experiment=experiment(how), limit_s=1.0
    )
    assert (repetition, found.failed, found.fault, found.kept) == (0, True, fault, False)
    assert (found.step, found.steps) == (3, STATES - 1)
    assert found.outcomes == {"": BREAKS_AT}
    assert found.state == {"gap": 0.5}
    # the very numbers of the stage: a run that nothing ended has them there
    assert whole[1]["detected"][rollout][:4].tolist() == list(BREAKS_AT)
    assert "outcomes, 1 detected, 0 missed: 1001" in str(found)


def test_a_rollout_that_the_run_ended_at_and_that_runs_to_the_end_now_is_told(aborted):
    folder, error = aborted
    _, stage, rollout = error.rollout
    again = {"stage": stage, "experiment": experiment("holds")}
    found = pemviz.replay(folder, rollout=rollout, **again)
    assert (found.failed, found.had_failed) == (False, True)
    assert (
        "but the run ended at it: has its cause been removed, or does it depend on a count"
        in str(found)
    )
    other = pemviz.replay(folder, rollout=rollout - 1, **again)
    assert (other.failed, other.had_failed) == (False, False)


def test_what_a_simulator_raises_is_shown_with_its_traceback(tmp_path, whole):
    folder, error = failed(tmp_path, "raises")
    assert error.rollout is None  # of a batch nobody knows which
    (number, *_) = [n for n, row in enumerate(whole[1]["detected"]) if breaks(row)]
    found = pemviz.replay(folder, stage=0, rollout=number, experiment=experiment("raises"))
    assert found.fault == "simulator fragile-walk: step raises ValueError in step 3: wheel fell off"
    assert 'raise ValueError("wheel fell off")' in found.traceback_text
    assert found.outcomes == {"": BREAKS_AT}


def test_another_rollout_runs_to_the_end(aborted, whole):
    folder, _ = aborted
    (number, *_) = [n for n, row in enumerate(whole[1]["detected"]) if not breaks(row)]
    found = pemviz.replay(folder, stage=0, rollout=number, experiment=experiment())
    assert not found.failed
    assert found.step == STATES - 1
    assert list(found.outcomes[""]) == whole[1]["detected"][number].tolist()
    assert found.robustness == whole[1]["robustness"][number]
    assert found.violated == whole[1]["violated"][number]
    assert "the run kept nothing of it" in str(found)


def test_what_a_run_kept_is_equal_and_of_another_simulator_not(whole):
    folder, table = whole
    found = pemviz.replay(folder, experiment=experiment("holds"))
    assert found.kept
    assert (found.robustness, found.violated) == (table["robustness"].min(), True)
    assert str(found).splitlines()[1].endswith("violated; equal to what the run kept")
    (number, *_) = [n for n, row in enumerate(table["detected"]) if breaks(row)]
    again = pemviz.replay(folder, stage=0, rollout=number, experiment=experiment("drifts"))
    assert re.fullmatch(r"gap \S+ and now \S+ at step 6", again.difference)
    assert "not equal to what the run kept" in str(again)


def test_learned_stages_are_numbered_as_the_run_does(tmp_path):
    """What is sampled again from the seed is what the run that goes on samples there."""
    options = {"method": "mixture", "stages": 1, "rollouts": 40, "final_rollouts": 40}
    folder, whole = tmp_path / "run", tmp_path / "whole"
    for path in (folder, whole):
        path.mkdir()
    record(experiment("holds", **options), whole)
    table = load_rollouts(whole)

    class After:
        """Stops the run after its first stage."""

        done = 0

        def notify(self, event):
            self.done += type(event).__name__ == "StageDone"

        def __call__(self):
            return self.done > 0

    stop = After()
    record(experiment("holds", **options), folder, observers=[stop], should_stop=stop)
    for stage in (0, 1):
        of_stage = table["detected"][table["stage"] == stage]
        found = pemviz.replay(
            folder, stage=stage, rollout=23, experiment=experiment("holds", 7, **options)
        )
        assert found.kept == (stage == 0)
        assert list(found.outcomes[""]) == of_stage[23].tolist()


def test_slots_and_latents_are_those_that_a_run_kept(tmp_path):
    start = load_preset("cut-in")
    config = replace(start, method="naive", final_rollouts=20, measured_memory=False, plan=False)
    found = record(pemviz.build_experiment(config), tmp_path)
    worst = found.least_robust[0]
    again = pemviz.replay(tmp_path, rank=1)
    assert (again.stage, again.rollout) == (worst.stage, worst.rollout)
    assert (again.kept, again.difference) == (True, "")
    assert (again.robustness, again.violated) == (worst.robustness, worst.violated)
    kept = pemviz.read_rollout(tmp_path, rank=1)
    assert again.start == tuple(kept.start)
    assert len(again.start) > 0
    assert next(iter(again.outcomes.values())) == tuple(kept.detected)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"stage": 0}, "stage and rollout: give both, or a rank"),
        ({"stage": 0, "rollout": 1, "rank": 2}, "rank = 2: give it, or stage and rollout"),
        ({"stage": 0, "rollout": 60}, "rollout = 60: must be from 0 to 59"),
        ({"stage": 1, "rollout": 0}, "stage = 1: .* has the stages 0 to 0"),
        ({"stage": 0, "rollout": 0, "repetition": 1}, "repetition = 1: must be from 0 to 0"),
        ({"rank": 61}, "rank = 61: must be a whole number from 1 to 60"),
    ],
)
def test_what_there_is_not_is_refused(whole, given, words):
    with pytest.raises(pemviz.InputError, match=words):
        pemviz.replay(whole[0], experiment=experiment("holds"), **given)


def test_the_command_line_names_the_command_and_its_exit_codes(tmp_path, monkeypatch, capfd):
    info = tmp_path / "fragile-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fragile\nVersion: 1.0\n")
    point = "fragile-walk = tests.fragile_walk:simulator"
    (info / "entry_points.txt").write_text(f"[pemviz.simulators]\n{point}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)

    def pemviz_command(*words):
        return main(list(words)), capfd.readouterr()  # of processes that it starts too

    words = ["--simulator", "fragile-walk", "--pem", "tests.fragile_walk:PEM", "--allow-python"]
    words += ["--spec", f"always[0,{STATES - 1}] (gap >= 0)", "--method", "monte-carlo"]
    words += ["--final-rollouts", "60", "--seed", "3", "--workers", "2", "--no-recording"]
    code, shown = pemviz_command("record", *words)
    assert code == 3
    command = re.search(r"see that rollout alone with: pemviz (replay [^;]*);", shown.err)
    assert command is not None
    code, shown = pemviz_command(*command[1].split())
    assert code == 1
    assert "failed at step 3 of 8: the process was ended by SIGABRT" in shown.out
    assert "fragile_walk.py" in shown.err  # where it aborted
    run = command[1].split()[1]
    code, shown = pemviz_command("replay", run, "--stage", "0", "--rollout", "0", "--allow-python")
    assert (code, "ran to the end" in shown.out) == (0, True)
    code, shown = pemviz_command("replay", run, "--stage", "9", "--rollout", "0", "--allow-python")
    assert (code, shown.err.count("\n")) == (2, 1)
