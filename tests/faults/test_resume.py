"""A run that is interrupted anywhere ends, once resumed, as if nothing had happened."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pemviz.cli import record as record_command
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.rule_words import GateLimits
from pemviz.config.toml_files import config_text, load_preset
from pemviz.errors import EXIT_DONE, EXIT_GATE_TRIPPED, InputError, RunError
from pemviz.reports.pipeline import ReportWriter
from pemviz.runs.events import RunDone, StageDone
from pemviz.runs.experiment import build_experiment
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result_file import write_result
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record, run_lock
from pemviz.sampling.rollouts.runners import run_here
from tests.comparable_results import comparable_result

SMALL = ExperimentConfig(method="adaptive",
    stages=3, rollouts=40, final_rollouts=60, epochs=5, repetitions=2, seed=11,
    scenario=ScenarioConfig(states=100), measured_memory=False,
)  # fmt: skip
MOST_REPEATED = 2
"""Rollouts of one of its stages."""
METHODS = (
    "adaptive", "mixture", "zero-variance", "splitting", "subset", "monte-carlo", "naive",
)  # fmt: skip
FILES = ("config.toml", "rollouts.npz", "proposals.safetensors")


def contents(folder):
    """Everything that must be the same, bytes where they are."""
    files = {n: (folder / n).read_bytes() for n in FILES if (folder / n).exists()}
    return {**files, "result": comparable_result(folder)}


def folder_of(root, name):
    folder = root / name / "run"  # one name: it stands in the result
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="module")
def small():
    return build_experiment(replace(SMALL, repetitions=1))


@pytest.fixture(scope="module")
def expected(small, tmp_path_factory):
    """What the small run, which nobody disturbed, left."""
    folder = folder_of(tmp_path_factory.mktemp("small"), "whole")
    record(small, folder)
    return contents(folder)


def stopped(experiment, folder, *, after):
    """Carry out so many stages."""
    stop = StopAfter(after)
    result = record(experiment, folder, observers=[stop], should_stop=stop)
    assert result.status == "stopped"
    return folder


class StopAfter:
    """Asks to stop once so many stages are done; the count goes on over several runs."""

    def __init__(self, stages):
        self.left = stages

    def notify(self, event):
        self.left -= isinstance(event, StageDone)

    def __call__(self):
        return self.left <= 0


def stopped_and_whole(experiment, root, *stops):
    """The result of a whole run, its folder, and that of one stopped after so many stages each."""
    whole, parts = folder_of(root, "whole"), folder_of(root, "parts")
    result = record(experiment, whole)
    for stages in stops:
        stop = StopAfter(stages)
        assert record(experiment, parts, observers=[stop], should_stop=stop).status == "stopped"
    assert record(experiment, parts).status == "done"
    assert contents(parts) == contents(whole)
    return result, whole, parts


@pytest.mark.parametrize("method", METHODS)
def test_a_stopped_run_goes_on_to_the_same_bytes(method, tmp_path):
    # what measured memories would give is sampled after the stages, whatever the method
    config = replace(SMALL, method=method, measured_memory=method == "naive")
    if method == "splitting":  # many levels take long
        config = replace(config, rollouts=8, repetitions=1)
    experiment = build_experiment(config)
    whole = folder_of(tmp_path, "whole")
    record(experiment, whole)
    parts = folder_of(tmp_path, "parts")
    stages = [s["stage"] for s in contents(whole)["result"]["stages"]]
    for after in range(1, len(stages), 2):
        stopped(experiment, parts, after=after)
        assert len(load_rollouts(parts)["stage"]) > 0
    record(experiment, parts)
    assert contents(parts) == contents(whole)
    assert not (parts / "stages").exists()


def test_a_stopped_run_of_a_logical_scenario_goes_on_to_the_same_bytes(tmp_path):
    """With all that its states remember: tracks, a ghost, errors of places, memory of misses."""
    preset = load_preset("cut-in")
    config = replace(
        preset, rules=(), spec="always[0,11] (clearance >= 12.0)", stages=2, rollouts=12,
        final_rollouts=12, position_errors="pointpillars", plan=False, measured_memory=False,
        scenario=replace(preset.scenario, tracker="2/3,coast=0.2,filter=kalman"),
        encounter=replace(preset.encounter, states=12, dt_s=0.3, ghost_probability=0.05),
    )  # fmt: skip
    experiment = build_experiment(config)
    whole, parts = folder_of(tmp_path, "whole"), folder_of(tmp_path, "parts")
    record(experiment, whole)
    assert contents(whole)["result"]["estimate"]["failures"] > 0
    record(experiment, stopped(experiment, parts, after=2))
    assert contents(parts) == contents(whole)


@pytest.mark.parametrize("after", [1, 6])
def test_stopping_while_it_reads_back_loses_nothing(after, tmp_path):
    experiment = build_experiment(SMALL)
    # the first repetition has five stages
    before = contents(stopped(experiment, tmp_path, after=8))
    assert len(before["result"]["stages"]) == 8
    assert contents(stopped(experiment, tmp_path, after=after)) == before


class EndsBefore:
    """A recorder that dies, as by a kill, before what it writes is whole."""

    def __init__(self, folder):
        self.folder, self.said = folder, None

    def notify(self, event):
        if isinstance(event, RunDone):
            self.said = json.loads((self.folder / "result.json").read_text())["status"]
            raise KeyboardInterrupt


def test_a_run_is_done_once_its_recording_is_whole(small, expected, tmp_path):
    parts = folder_of(tmp_path, "parts")
    recorder = EndsBefore(parts)
    with pytest.raises(KeyboardInterrupt):
        record(small, parts, recorders=[recorder])
    assert recorder.said == "stopped"
    assert contents(parts)["result"]["status"] == "stopped"
    assert record(small, parts).status == "done"
    assert contents(parts) == expected


def test_a_resumed_runs_recording_takes_the_old_ones_place(tmp_path):
    (tmp_path / "config.toml").write_text(config_text(replace(SMALL, repetitions=1)))
    (tmp_path / "run.rrd").write_bytes(b"cut off")
    assert record_command.run(["--resume", str(tmp_path), "--no-frames", "--json"]) == EXIT_DONE
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    assert list(tmp_path.glob(".*partial")) == []


def test_finished_stages_are_not_simulated_again(small, tmp_path):
    drawn = []

    def counting(simulator, pem, tasks):
        for batch in run_here(simulator, pem, tasks):
            drawn.append(batch.count)
            yield batch

    experiment = replace(small, problem=replace(small.problem, run_batches=counting))
    stopped(experiment, tmp_path, after=3)
    drawn.clear()
    record(experiment, tmp_path)
    several = [count for count in drawn if count > MOST_REPEATED]
    assert several[:2] == [40, 60]  # then the data's bound


def test_a_simulator_that_changed_since_a_run_was_stopped_is_told(small, tmp_path):
    stopped(small, tmp_path, after=3)
    brakes_less = replace(small.problem.simulator.config, emergency_deceleration_mps2=7.0)
    other = replace(small.problem.simulator, config=brakes_less)
    changed = replace(small, problem=replace(small.problem, simulator=other))
    found = record(changed, tmp_path).estimate.diagnostics[0]
    assert found.kind == "not-repeatable"
    assert "went otherwise (simulator vectorized: " in found.text


def test_a_run_that_failed_goes_on_once_the_fault_is_gone(tmp_path):
    experiment = build_experiment(replace(SMALL, repetitions=1, method="mixture"))
    whole = folder_of(tmp_path, "whole")
    record(experiment, whole)
    calls = []

    def failing(simulator, pem, tasks):
        calls.append(0)
        if len(calls) > 2:
            raise ConnectionError("the cable was pulled")
        return run_here(simulator, pem, tasks)

    parts = folder_of(tmp_path, "parts")
    broken = replace(experiment, problem=replace(experiment.problem, run_batches=failing))
    with pytest.raises(RunError, match="the cable was pulled"):
        record(broken, parts)
    assert json.loads((parts / "result.json").read_text())["status"] == "failed"
    record(experiment, parts)
    assert contents(parts) == contents(whole)


@pytest.mark.parametrize("damage", ["cut", "noise", "other shape", "gone"])
def test_a_damaged_stage_is_computed_again(small, expected, damage, tmp_path, caplog):
    parts = stopped(small, folder_of(tmp_path, "parts"), after=3)
    path = sorted((parts / "stages").glob("*.npz"))[1]
    data = path.read_bytes()
    match damage:
        case "cut":
            path.write_bytes(data[: len(data) // 2])
        case "noise":
            middle = len(data) // 2
            path.write_bytes(data[:middle] + bytes(64) + data[middle + 64 :])
        case "other shape":
            with np.load(path) as arrays:
                changed = dict(arrays) | {"robustness": np.zeros(3)}
            np.savez(path, **changed)
        case "gone":
            path.unlink()
    record(small, parts)
    assert ("it is computed again" in caplog.text) == (damage != "gone")
    assert contents(parts) == expected


@pytest.mark.parametrize("left", [b"", b"\0" * 4096, b'{"schema": 1, "run_id'])
def test_a_result_lost_in_a_power_cut_is_made_again_from_the_stages(
    small, expected, left, tmp_path, caplog
):
    parts = stopped(small, folder_of(tmp_path, "parts"), after=3)
    (parts / "result.json").write_bytes(left)
    stages = sorted((parts / "stages").glob("*.npz"))
    before = [path.read_bytes() for path in stages]
    stopped(small, parts, after=1)
    (line,) = caplog.messages
    assert line.startswith(f"run {parts}: result.json cannot be read; the run goes on")
    assert [path.read_bytes() for path in stages] == before
    assert json.loads((parts / "result.json").read_text())["status"] == "stopped"
    record(small, parts)
    assert contents(parts) == expected
    assert len(caplog.messages) == 1


@pytest.mark.parametrize("left", [b"", b"{}", b'{"schema": 1}'])
def test_a_damaged_result_is_refused_without_stages_or_where_it_is_a_document(
    small, left, tmp_path
):
    folder = stopped(small, tmp_path, after=2)
    if not left:
        shutil.rmtree(folder / "stages")
    (folder / "result.json").write_bytes(left)
    with pytest.raises(InputError, match=r"result .*result\.json"):
        record(small, folder)
    assert (folder / "result.json").read_bytes() == left


def test_two_processes_never_share_a_folder(tmp_path):
    experiment = build_experiment(SMALL)
    with run_lock(tmp_path), pytest.raises(InputError, match="another process is at work"):
        record(experiment, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock"]


def test_another_error_model_under_the_same_name_is_refused(tmp_path):
    experiment = build_experiment(replace(SMALL, method="naive"))
    result = record(experiment, tmp_path)
    write_result(tmp_path, replace(result, pem=replace(result.pem, digest="0" * 64)))
    with pytest.raises(InputError, match="begun with another error model"):
        record(experiment, tmp_path)


def test_settings_that_were_changed_meanwhile_are_refused(small, tmp_path):
    folder = stopped(small, tmp_path, after=2)
    config = (folder / "config.toml").read_text()
    (folder / "config.toml").write_text(config.replace("rollouts = 40", "rollouts = 80", 1))
    with pytest.raises(InputError, match="begun with settings other than those"):
        record_command.run(["--resume", str(folder), "--no-recording"])


def test_the_command_resumes_and_keeps_the_old_recording_until_the_new_is_whole(
    small, expected, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("CI", "1")
    folder = stopped(small, folder_of(tmp_path, "stopped"), after=2)
    (folder / "run.rrd").write_bytes(b"the old recording")
    assert record_command.run(["--resume", str(folder), "--no-frames"]) == EXIT_DONE
    assert contents(folder) == expected
    assert (folder / "run.rrd").stat().st_size > 100_000
    assert not (folder / ".run.rrd.partial").exists()
    capsys.readouterr()
    code = record_command.run(["--resume", str(folder), "--json", "--fail-above", "1e-30"])
    assert code in (EXIT_GATE_TRIPPED, 4)
    out = capsys.readouterr()
    assert "is done already" in out.err
    told = json.loads(out.out)
    assert told["status"] == "done"
    outcome = {EXIT_GATE_TRIPPED: "tripped", 4: "undecided"}[code]
    assert told["gate"].items() >= {"outcome": outcome, "limit": 1e-30, "exit_code": code}.items()
    assert told["gate"]["reason"] in out.err


def test_a_run_goes_on_with_another_time_limit(small, tmp_path):
    """Which is no part of what is answered: the folder stays that of its configuration."""
    folder = stopped(small, tmp_path, after=2)
    settings = (folder / "config.toml").read_bytes()
    assert record_command.run(["--resume", str(folder), "--step-time-limit-s", "77", "--json"]) == 0
    assert (folder / "config.toml").read_bytes() == settings
    assert read_whole_run(folder).status == "done"


SHORT = replace(SMALL, method="auto", seed=2, precision=0.05, max_rollouts=440)


def test_a_run_that_fell_short_goes_on_with_other_limits(tmp_path, capsys):
    """From all that it has; stopped in between, or read back to the end, to the same bytes."""
    longer = build_experiment(replace(SHORT, max_rollouts=1_800))
    folders = [folder_of(tmp_path, name) for name in ("whole", "parts")]
    for folder in folders:
        record(build_experiment(SHORT), folder)
    before = read_whole_run(folders[0])
    assert before.estimate.relative_half_width > SHORT.precision
    sampled = load_rollouts(folders[0])

    first = record(longer, folders[0])
    read_whole_run(folders[0])  # whose estimate is that of its rollouts
    assert first.estimate.rollouts_simulated > 2 * before.estimate.rollouts_simulated
    assert first.estimate.relative_half_width < before.estimate.relative_half_width
    after = load_rollouts(folders[0])
    for repetition in range(2):
        old, new = (table["repetition"] == repetition for table in (sampled, after))
        same = after["detected"][new][: old.sum()]
        np.testing.assert_array_equal(same, sampled["detected"][old])

    done = [len(result.stages) for result in (before, first)]
    answer = (folders[1] / "result.json").read_bytes()
    for stages in (done[0] // 2, done[1] - 1):
        stop = StopAfter(stages)
        assert record(longer, folders[1], observers=[stop], should_stop=stop).status == "stopped"
        assert (folders[1] / "former.json").read_bytes() == answer
    words = ["--resume", str(folders[1]), "--no-recording", "--max-rollouts", "1800"]
    assert record_command.run(words) == EXIT_DONE
    assert contents(folders[1]) == contents(folders[0])
    assert not (folders[1] / "former.json").exists()
    assert (
        f"to go on: pemviz record --resume {folders[1]} --max-rollouts " in capsys.readouterr().err
    )
    # by less that is asked nothing is lost, nor by a kill between the answer and its stages
    words = ["--resume", str(folders[1]), "--no-recording", "--precision"]
    assert record_command.run([*words, "50%"]) == EXIT_DONE
    (folders[1] / ".stages").rename(folders[1] / "stages")
    assert record_command.run([*words, "5%"]) == EXIT_DONE
    assert contents(folders[1]) == contents(folders[0])
    assert record(longer, folders[1]).status == "done"  # which reads its stages back
    assert contents(folders[1]) == contents(folders[0])
    # nothing more may be sampled: the same answer again
    fewer = replace(longer.config, max_rollouts=600, max_minutes=5.0)
    assert record(build_experiment(fewer), folders[1]).estimate == first.estimate


def test_a_run_that_is_as_precise_as_was_asked_has_no_stages_to_go_on_from(tmp_path):
    folder = folder_of(tmp_path, "whole")
    record(build_experiment(replace(SHORT, precision=0.9, repetitions=1)), folder)
    before = contents(folder)
    for words in (["--precision", "5%"], ["--max-minutes", "7", "--max-rollouts", "1800"]):
        with pytest.raises(InputError, match=r"as precise as it was to be, .*; start a new run$"):
            record_command.run(["--resume", str(folder), *words])
    with pytest.raises(InputError, match="was begun with settings other"):
        record(build_experiment(replace(SHORT, repetitions=1)), folder)
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--resume", "nowhere"],
            "resume = nowhere: must be a run folder, there is no such folder",
        ),
        (["--resume", "{run}", "--seed", "12"], "goes on with its own configuration"),
        (["--resume", "{run}", "--preset", "paper"], "give only one of them"),
    ],
)
def test_what_cannot_be_resumed_is_told_in_one_line(small, words, message, tmp_path):
    folder = stopped(small, tmp_path, after=2)
    before = contents(folder)
    with pytest.raises(InputError) as caught:
        record_command.run([word.format(run=folder) for word in words])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert contents(folder) == before


def test_a_folder_killed_before_its_first_stage_starts_anew(tmp_path):
    config = replace(SMALL, method="naive")
    (tmp_path / "config.toml").write_text(config_text(config))
    assert record_command.run(["--resume", str(tmp_path), "--no-recording"]) == EXIT_DONE


def test_a_run_that_is_done_already_is_still_reported(tmp_path):
    """Summary and JUnit file are those that the run itself would have written."""
    folder = folder_of(tmp_path, "whole")
    config = replace(SMALL, method="monte-carlo", repetitions=1)
    first = [tmp_path / name for name in ("first.md", "first.xml")]
    reports = ReportWriter(summary=first[0], junit=first[1], limits=GateLimits(0.5))
    record(build_experiment(config), folder, observers=[reports])
    before = contents(folder)
    again = [tmp_path / name for name in ("again.md", "again.xml")]
    words = ["--summary", str(again[0]), "--junit", str(again[1]), "--fail-above", "0.5"]
    assert record_command.run(["--resume", str(folder), *words]) == EXIT_DONE
    for one, other in zip(first, again, strict=True):
        assert other.read_text() == one.read_text()
    assert contents(folder) == before


def test_a_run_that_is_done_but_was_done_with_other_settings_is_refused(tmp_path):
    folder = folder_of(tmp_path, "whole")
    record(build_experiment(replace(SMALL, method="naive", repetitions=1)), folder)
    text = (folder / "config.toml").read_text()
    (folder / "config.toml").write_text(text.replace("seed = 11", "seed = 12", 1))
    with pytest.raises(InputError, match=r"other than those of its config\.toml \(seed = 11, not"):
        record_command.run(["--resume", str(folder)])
