"""The exact failure probability, which the paper lacked."""

from dataclasses import replace

from pemviz.config import ExperimentConfig
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.value_twisted.reference import Reference, reference


def exact_reference(config: ExperimentConfig, rollouts: int) -> Reference:
    """The exact probability of ``config``'s experiment, to a fraction of a per cent.

    Raises:
        InputError: Single states do not decide the specification, or the simulator has no twin.
    """
    experiment = build_experiment(replace(config, reference=True))
    assert experiment.twin is not None  # noqa: S101  else no reference could be asked for
    return reference(experiment.problem, twin=experiment.twin, rollouts=rollouts)
