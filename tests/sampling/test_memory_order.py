"""One memory order from drawing to files and back, and results that do not depend on it."""

import math
import pickle
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from pemviz import stl
from pemviz.analysis.explanation import explain
from pemviz.analysis.model_uncertainty import member_estimates
from pemviz.arrays import row_sums
from pemviz.config import ExperimentConfig
from pemviz.pem import ensemble_of
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.experiment import build_experiment
from pemviz.runs.rollout_files import finished_stage, part_arrays, write_part
from pemviz.sampling.method import final_stage
from pemviz.sampling.problem import sample, score
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.splitting.particles import beginning, continued, restart

HALF = ConstantProposal(detection_probability=0.5)


@pytest.fixture(scope="module")
def experiment():
    return build_experiment(ExperimentConfig(method="naive", final_rollouts=60))


@pytest.fixture(scope="module")
def scored(experiment):
    return sample(experiment.problem, proposal=HALF, count=60, seeds=np.random.SeedSequence(2))


def stage_of(scored):
    return final_stage(repetition=0, stage=0, scored=scored, sampled_from=HALF)


def is_time_major(array):
    return array.shape[0] > 1 and array.T.flags.c_contiguous


def arrays_of(rollouts):
    found = []
    rollouts.map(lambda array: found.append(array) or array)
    return found


def pooled_elsewhere(function, *arguments):
    """As a worker process gives it back."""
    future = Future()
    future.set_result(pickle.loads(pickle.dumps(function(*arguments))))  # noqa: S301  our own
    return future


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"batch_rollouts": 7},
        {"run_batches": PooledRunner(pooled_elsewhere, 3)},
    ],
    ids=["here", "batches", "workers"],
)
def test_rollouts_are_time_major_wherever_they_are_drawn(experiment, changes):
    problem = replace(experiment.problem, **changes)
    drawn = sample(problem, proposal=HALF, count=60, seeds=np.random.SeedSequence(2))
    assert all(is_time_major(array) for array in arrays_of(drawn.rollouts))


def test_what_is_made_of_rollouts_is_time_major(experiment, scored, tmp_path):
    path, signals = tmp_path / "stages" / "one.npz", experiment.problem.simulator.signals
    write_part(path, part_arrays(stage_of(scored), signals))
    again = finished_stage(path, signals)
    generator = np.random.default_rng(0)
    wanted = beginning(experiment.problem, count=6, generator=generator)
    (particles,) = continued(experiment.problem, [wanted])
    parent, cut = np.array([0, 2, 2]), np.array([3, 50, 98])
    wanted = restart(particles, parent=parent, cut=cut, generator=generator)
    first, further = continued(experiment.problem, [wanted, wanted])
    for batch in (
        again.scored.rollouts,
        scored.rollouts.take(scored.violated),
        scored.rollouts.take(np.array([5, 3])),
        type(scored).concatenate([scored.take(slice(3)), scored.take(slice(20, 30))]).rollouts,
        particles,
        first,
        further,
    ):
        assert all(is_time_major(array) for array in arrays_of(batch))
    replayed = replay(simulator=experiment.problem.simulator, detected=scored.rollouts.detected)
    assert all(is_time_major(array) for array in replayed.values())


METRICS = (
    stl.Classical(),
    stl.Agm({"gap": (-60.0, 60.0), "ego_speed": (0.0, 60.0), "lead_speed": (0.0, 60.0)}),
    stl.SmoothCumulative(),
)


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
@pytest.mark.parametrize(
    "spec",
    [
        "always[0,99] (gap >= 2.0)",
        "eventually[5,60] (gap * ego_speed < 20.0 and lead_speed >= 0.5)",
        "(ego_speed >= 1.0) until[3,70] (gap < 9.0)",
        "not (gap < 0.0) -> always[10,20] (min(gap, ego_speed) > 0.1)",
    ],
)
def test_robustness_does_not_depend_on_memory_order(scored, metric, spec):
    signals = scored.rollouts.signals
    formula = stl.parse(spec, signals=list(signals))
    expected = stl.robustness(formula, signals, metric)
    for layout in (np.ascontiguousarray, np.asfortranarray, spaced_out):
        turned = {name: layout(values) for name, values in signals.items()}
        for values in turned.values():
            values.flags.writeable = False  # nor is anything written to what it is given
        np.testing.assert_array_equal(stl.robustness(formula, turned, metric), expected)


def spaced_out(values):
    """The same numbers, neither rows nor columns in one piece."""
    room = np.full((2 * values.shape[0], 3 * values.shape[1]), np.nan)
    room[::2, ::3] = values
    return room[::2, ::3]


def test_results_do_not_depend_on_memory_order(experiment, scored):
    ensemble = ensemble_of("ml-nn")
    parts = {"features": experiment.features, "farthest_m": 20.0, "target": 1e-16, "dt_s": 0.05}
    noise = np.random.default_rng(3).normal(size=(2, *scored.rollouts.detected.shape)) / 10.0
    # of about the same weight, so that every rollout's last digit shows
    alike = replace(scored.rollouts, pem_logit=noise[0], proposal_logit=noise[0] + noise[1])
    even = replace(scored, rollouts=alike)

    def everything(layout):
        turned = even.map(layout)
        stage = replace(stage_of(turned), log10_probability=math.log10(1e-15))
        members = member_estimates(
            turned, simulator=experiment.problem.simulator, ensemble=ensemble
        )
        weights = turned.rollouts.log_weight, row_sums(turned.rollouts.log_p)
        again = score(experiment.problem, turned.rollouts)
        return explain(stage, **parts), members, weights, again.robustness

    (causes, members, weights, robustness), *others = (
        everything(layout) for layout in (np.ascontiguousarray, np.asfortranarray)
    )
    assert causes is not None
    for other_causes, other_members, other_weights, other_robustness in others:
        assert other_causes == causes
        np.testing.assert_array_equal(other_members.log_mu, members.log_mu)
        for other, own in zip(other_weights, weights, strict=True):
            np.testing.assert_array_equal(other, own)
        np.testing.assert_array_equal(other_robustness, robustness)
