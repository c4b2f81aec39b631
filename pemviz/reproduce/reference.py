"""The exact failure probability, which the paper lacked."""

from pemviz.config import ExperimentConfig
from pemviz.experiment import build_experiment
from pemviz.sampling.value_reference import Reference, reference


def exact_reference(config: ExperimentConfig, rollouts: int) -> Reference:
    """The exact probability of ``config``'s experiment, to a fraction of a per cent.

    Raises:
        InputError: Single states do not decide the specification.
    """
    experiment = build_experiment(config)
    return reference(experiment.problem, twin=experiment.twin, rollouts=rollouts)
