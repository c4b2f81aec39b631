"""What an estimate rests on beside the runs' probabilities, as a run folder keeps it."""

from collections.abc import Sequence

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.sampling.kept import EVERY, FIGURES, KeptRepetition, Recounted
from pemviz.sampling.splitting.estimate import estimate_of_runs
from pemviz.sampling.splitting.run import RunFigures, SplittingRun

SHARED = ("least_variance", "common_ancestry", "simulated", "levels")
"""Fields of a run that all of its particles have alike."""
UNKNOWN = {"least_variance": 1.0, "common_ancestry": 0.0, "simulated": 0, "levels": 1}
"""In place of them where nothing violates, or they were not kept."""


def columns_of(runs: Sequence[SplittingRun]) -> dict[str, AnyArray]:
    """Of each particle ``[N]``: what its run's are alike in, common ancestry by each rule too."""
    counts = [run.scored.rollouts.count for run in runs]
    values = {name: [getattr(run, name) for run in runs] for name in SHARED}
    for rule in runs[0].rule_ancestry:
        values[f"common_ancestry.{rule}"] = [run.rule_ancestry[rule] for run in runs]
    return {name: np.repeat(each, counts) for name, each in values.items()}


def recounted(kept: KeptRepetition) -> Recounted:
    """The mean over the runs; no error where a run's figures were not kept."""
    runs = [_run(kept, stage) for stage in range(len(kept.stages))]
    found = estimate_of_runs(runs, method=kept.method)
    is_whole = all(kept.column(name) is not None for name in SHARED)
    return Recounted(found, EVERY if is_whole else FIGURES)


def _run(kept: KeptRepetition, number: int) -> RunFigures:
    stage, own = kept.stages[number], kept.stage == number
    shared: dict[str, float] = dict(UNKNOWN)
    for name in SHARED:
        values = kept.column(name)
        if values is not None and own.any():
            shared[name] = values[own][0].item()
    run = RunFigures(
        log_probability=stage.log_probability,
        least_variance=shared["least_variance"],
        common_ancestry=shared["common_ancestry"],
        simulated=int(shared["simulated"]),
        levels=int(shared["levels"]),
        count=stage.rollouts,
        log_p=kept.log_p[own],
    )
    if kept.rule is None or not stage.failures:
        return run
    share = np.count_nonzero(own) / stage.rollouts
    return run.of_share(share, before=stage.failures / stage.rollouts)
