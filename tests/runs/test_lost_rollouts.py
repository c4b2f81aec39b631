"""Rollouts that cannot be simulated: counted as violations, as none, or the end of the run."""

import json
from dataclasses import replace

import numpy as np
import pytest

import pemviz
from pemviz.cli.record_arguments import parse
from pemviz.config.toml_files import config_text
from pemviz.reports.gate import decide_run
from pemviz.runs.events import StageDone
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import Archive, going_on, record
from pemviz.runs.uncertainty import uncertainty_budget
from pemviz.sampling.problem import score
from pemviz.sampling.rollouts.losing import lost_at, lost_rows, marked
from pemviz.types import LOST, RolloutBatch
from tests.comparable_results import comparable_result
from tests.fragile_walk import STATES, FragileWalk, breaks, exact, experiment

RARE = 0.02
METHODS = {
    "monte-carlo": {"final_rollouts": 3000},
    "naive": {"final_rollouts": 3000},
    "mixture": {"stages": 3, "rollouts": 300, "final_rollouts": 600},
    "auto": {"stages": 3, "rollouts": 300, "final_rollouts": 600},
}
WITHIN_ERRORS = 4.5
"""Of an answer that is right, the farthest once in 150,000."""


@pytest.mark.parametrize("lost", ["violation", "none"])
@pytest.mark.parametrize("method", METHODS)
def test_an_answer_is_the_exact_one_however_lost_rollouts_count(method, lost):
    result = pemviz.run(experiment("raises", method=method, lost=lost, **METHODS[method]))
    found, told = result.estimate, result.lost
    assert found is not None
    assert told is not None
    want = exact(lost_violate=lost == "violation")
    assert abs(found.probability - want) < WITHIN_ERRORS * found.std_error
    p_lost = exact(lost_violate=True) - exact(lost_violate=False)
    assert abs(told.probability - p_lost) < WITHIN_ERRORS * told.std_error
    assert (told.counts_as, told.simulated) == (lost, sum(one.rollouts for one in result.stages))
    assert 0 < told.count < told.simulated
    assert len(told.first) == min(told.count, 20)
    assert {one.step for one in told.first} == {3}


@pytest.mark.parametrize("lost", ["violation", "none"])
def test_weights_are_right_where_what_breaks_is_as_rare_as_what_violates(lost):
    """A lost rollout has the weight of its outcomes up to there; 4.6e-4 and 7.9e-4 exactly."""
    options = {"stages": 4, "rollouts": 500, "final_rollouts": 2000}
    result = pemviz.run(experiment("raises", miss=RARE, method="mixture", lost=lost, **options))
    found, told = result.estimate, result.lost
    assert found is not None
    assert told is not None
    want = exact(lost_violate=lost == "violation", miss=RARE)
    assert abs(found.probability - want) < WITHIN_ERRORS * found.std_error
    assert found.std_error < 0.1 * want
    p_lost = exact(lost_violate=True, miss=RARE) - exact(lost_violate=False, miss=RARE)
    assert abs(told.probability - p_lost) < WITHIN_ERRORS * told.std_error


def kept(folder):
    """All that a run leaves, but for its timings."""
    files = {name: (folder / name).read_bytes() for name in ("config.toml", "rollouts.npz")}
    return {**files, "result": comparable_result(folder)}


def carried_out(tmp_path, name, how, **options):
    folder = tmp_path / name / "run"
    folder.mkdir(parents=True)
    given = {"final_rollouts": 24, "lost": "violation", "seed": 3, **options}
    workers = given.pop("workers", None)
    record(experiment(how, **given), folder, workers=workers)
    return folder


def test_workers_that_die_lose_what_one_process_loses_to_the_last_bit(tmp_path):
    here = carried_out(tmp_path, "here", "raises")
    table = load_rollouts(here)
    broken = [n for n, row in enumerate(table["detected"]) if breaks(row)]
    told = json.loads((here / "result.json").read_text())["lost"]
    assert [one["rollout"] for one in told["first"]] == broken
    assert len(broken) == 1
    assert table["violated"][broken].all()
    assert (table["gap_m"][broken, 4:] == 0.5).all()  # it stays where it was
    for workers in (1, 3):
        elsewhere = carried_out(tmp_path, f"{workers}", "aborts", workers=workers)
        assert kept(elsewhere) == kept(here)


@pytest.mark.slow
def test_a_worker_that_stalls_loses_the_same(tmp_path):
    here = carried_out(tmp_path, "here", "raises")
    options = {"workers": 2, "step_time_limit_s": 10.0}
    stalled = carried_out(tmp_path, "stalled", "stalls", **options)
    one, other = kept(stalled), kept(here)
    assert one["rollouts.npz"] == other["rollouts.npz"]
    assert one["result"]["lost"] == other["result"]["lost"]


class StopAfterStage:
    """Asks to stop once a stage is done."""

    done = False

    def notify(self, event):
        self.done |= isinstance(event, StageDone)

    def __call__(self):
        return self.done


@pytest.mark.parametrize("keep", ["all", "violations"])
def test_a_run_that_is_gone_on_with_tells_of_the_same_losses(tmp_path, keep):
    options = {"method": "mixture", "stages": 2, "rollouts": 60, "final_rollouts": 60}
    options |= {"keep": keep, "lost": "none"}
    whole = carried_out(tmp_path, "whole", "raises", **options)
    folder = tmp_path / "stopped" / "run"
    folder.mkdir(parents=True)
    stop = StopAfterStage()
    asked = experiment("raises", seed=3, **options)
    record(asked, folder, observers=[stop], should_stop=stop)
    record(asked, folder)
    assert kept(folder) == kept(whole)
    assert pemviz.read_result(folder).lost == pemviz.read_result(whole).lost


@pytest.mark.parametrize(
    "options",
    [
        {"method": "auto", "stages": 3, "rollouts": 60, "final_rollouts": 60},
        {"method": "monte-carlo", "repetitions": 20, "final_rollouts": 200, "keep": "violations"},
    ],
)
def test_a_run_that_a_rollout_ended_goes_on_as_if_such_had_counted_from_the_start(
    tmp_path, options, caplog
):
    """What it kept lost none, and is read back: a stage of plain rollouts, or some repetitions."""
    options = {"miss": RARE, "seed": 3, **options}
    whole = carried_out(tmp_path, "whole", "raises", lost="none", **options)
    assert pemviz.read_result(whole).lost is not None
    with pytest.raises(pemviz.RunError, match="wheel fell off"):
        carried_out(tmp_path, "ended", "raises", lost="end", **options)
    ended = tmp_path / "ended" / "run"
    assert pemviz.read_result(ended).stages
    with pytest.raises(pemviz.InputError, match="seed = 3, not 4"):
        record(experiment("raises", lost="none", **{**options, "seed": 4}), ended)
    asked = experiment("raises", lost="none", **options)
    left = going_on(asked, Archive(ended, asked.declared.signals)).problem.finished(0, 0)
    assert (left is None) == ("keep" in options)  # what is kept in part is simulated again
    assert left is None or not left.scored.rollouts.memory[LOST].any()
    record(asked, ended)
    assert not caplog.messages
    assert kept(ended) == kept(whole)
    with pytest.raises(pemviz.InputError, match="lost = 'none', not 'violation'"):
        record(experiment("raises", lost="violation", **options), ended)


def test_only_a_run_that_had_to_end_is_resumed_with_another_lost(tmp_path):
    def asked(begun):
        config = replace(pemviz.ExperimentConfig(), lost=begun)
        (tmp_path / "config.toml").write_text(config_text(config))
        return parse(["--resume", str(tmp_path), "--lost", "violation"]).experiment

    assert asked("end").lost == "violation"
    with pytest.raises(pemviz.InputError, match="goes on with its own configuration"):
        asked("none")


def test_what_violated_before_it_broke_violates_however_it_counts():
    """Verdicts on rollouts that broke at their sixth outcome: with three misses by then, or two."""
    gaps = np.array([[2.5, 1.5, 0.5, -0.5, -0.5, -0.5], [2.5, 1.5, 0.5, 0.5, 0.5, 0.5]])
    problem = experiment("holds", spec="always[0,6] (gap >= 0)").problem
    signals = {"gap": np.hstack([gaps, gaps[:, -1:], gaps[:, -1:], gaps[:, -1:]])}
    none = np.zeros((2, STATES - 1))
    batch = RolloutBatch(signals, {}, none.astype(np.bool_), none, none)
    for lost, verdicts in (("violation", [True, True]), ("none", [True, False])):
        scored = score(replace(problem, lost=lost), marked(batch, 5))
        assert scored.violated.tolist() == verdicts
        assert (scored.robustness < 0.0).tolist() == verdicts


def test_the_answer_says_what_it_would_be_otherwise_and_what_may_be_decided():
    counted = pemviz.run(experiment("raises", final_rollouts=400, lost="violation"))
    text = pemviz.summary_text(counted)
    low, high = counted.lost.ends(counted.estimate.probability)
    assert high == counted.estimate.probability
    assert f"count as violations; if they did not, these rollouts would say {low:.2g}" in text
    (row,) = [one for one in uncertainty_budget(counted) if one.kind == "lost"]
    assert (row.low, row.high) == (low, high)
    assert decide_run(counted, limit=0.9).outcome == "passed"
    left_out = pemviz.run(experiment("raises", final_rollouts=400, lost="none"))
    low, high = left_out.lost.ends(left_out.estimate.probability)
    assert (low, high) == pytest.approx(counted.lost.ends(counted.estimate.probability))
    assert f"had they violated, the answer would be {high:.2g}" in pemviz.summary_text(left_out)
    assert decide_run(left_out, limit=0.9).outcome == "undecided"


def test_several_rules_are_all_broken_by_what_counts_as_a_violation():
    rules = (
        pemviz.config.Rule("near", f"always[0,{STATES - 1}] (gap >= 0)"),
        pemviz.config.Rule("far", f"always[0,{STATES - 1}] (gap >= -4)"),
    )
    config = experiment("holds").config.with_rules({one.name: one.formula for one in rules})
    for lost, violate in (("violation", True), ("none", False)):
        found = pemviz.run(
            pemviz.build_experiment(
                replace(config, lost=lost, simulator="vectorized", final_rollouts=2000),
                simulator=FragileWalk("raises"),
                pem=experiment("holds").pem,
            )
        )
        near, far = found.rules
        want = exact(lost_violate=violate)
        assert abs(near.estimate.probability - want) < WITHIN_ERRORS * near.estimate.std_error
        least = found.lost.count if violate else 0
        assert far.estimate.failures >= least
        assert far.estimate.probability < near.estimate.probability


@pytest.mark.parametrize("lost", ["violation", "none"])
def test_rollouts_say_which_of_their_states_were_not_reached(lost):
    stages = []

    class Keep:
        def notify(self, event):
            if isinstance(event, StageDone):
                stages.append(event.stage.scored)

    pemviz.run(experiment("raises", lost=lost, method="mixture", stages=1), observers=[Keep()])
    for scored in stages:
        rollouts = scored.rollouts
        lost_ones = np.array([breaks(row) for row in rollouts.detected])
        assert np.array_equal(lost_rows(rollouts), lost_ones)
        assert (lost_at(rollouts)[lost_ones] == 3).all()
        assert not rollouts.memory[LOST][:, :4].any()
        assert rollouts.memory[LOST][lost_ones, 4:].all()
        assert (scored.violated[lost_ones] == (lost == "violation")).all()
        below = scored.robustness < 0.0
        assert np.array_equal(below, scored.violated)
        # what comes after leaves the weights as they are
        after = rollouts.log_p[lost_ones, 4:] - rollouts.log_q[lost_ones, 4:]
        assert not after.any()


@pytest.mark.parametrize("method", ["splitting", "subset"])
def test_methods_that_go_on_from_states_refuse(method):
    with pytest.raises(
        pemviz.InputError, match=rf"lost = 'none': method {method} goes on from its"
    ):
        experiment("holds", method=method, lost="none")


def test_an_error_model_that_raises_ends_the_run_all_the_same():
    class Raises:
        def logit(self, salient):
            if salient.shape[0] > 4 and (salient < 0.0).any():
                raise ValueError("no weights")
            return np.zeros(salient.shape[:-1])

    config = replace(experiment("holds").config, lost="violation", simulator="vectorized")
    with pytest.raises(pemviz.RunError, match="logit raises ValueError"):
        pemviz.run(pemviz.build_experiment(config, simulator=FragileWalk("holds"), pem=Raises()))
