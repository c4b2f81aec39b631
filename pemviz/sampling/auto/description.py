"""What method ``auto`` is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.sampling.description import (
    Budget,
    MethodDescription,
    counted,
    learning_budget,
    with_learning_budget,
)

if TYPE_CHECKING:
    from pemviz.sampling.auto.method import AutoSampling
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.kept import KeptRepetition, Recounted

PLAIN_SHARE = 0.2
"""Plain rollouts of the first stage, beside those that proposals begin with."""
LOOKED_AT = 2
"""Times those that proposals begin with: plain rollouts at most until a way is chosen."""
PLAIN_PAYS, PLAIN_PAYS_SLOWLY = 20, 2
"""Times likewise, up to which plain rollouts are no dearer than proposals: fitting takes as long as
so many, but where rollouts are slow."""
FAST_BATCH = 100
MOST_TIMES = 10
"""Times likewise, up to which proposals go on."""
OWN_STAGES = 5
"""One in so many of the stages that learn, two at least, is what proposals begin with on the
simulator itself, where they have been learned on a surrogate."""


def _begins_with(config: ExperimentConfig) -> ExperimentConfig:
    """With the stages that proposals begin with."""
    if config.surrogate is None:
        return config
    return replace(config, stages=min(max(config.stages // OWN_STAGES, 2), config.stages))


def _budget(config: ExperimentConfig) -> Budget:
    return learning_budget(_begins_with(config))


def most_rollouts(config: ExperimentConfig) -> int:
    """At most so many are sampled from proposals in a repetition."""
    if config.max_rollouts is not None:
        return config.max_rollouts // config.repetitions
    return MOST_TIMES * learning_budget(config).rollouts


def _with_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    return replace(with_learning_budget(config, rollouts), max_rollouts=rollouts)


def _most_s(config: ExperimentConfig) -> float:
    """Seconds that each repetition may take."""
    minutes = math.inf if config.max_minutes is None else config.max_minutes
    return 60.0 * minutes / config.repetitions


def _build(config: ExperimentConfig, back_end: BackEnd) -> AutoSampling:
    from pemviz.sampling.auto.method import AutoSampling, Limits  # noqa: PLC0415  slow to import
    from pemviz.sampling.mixture.build import mixture_of  # noqa: PLC0415  as above
    from pemviz.simulators.episodic import episodic  # noqa: PLC0415  slow to import

    budget, most = learning_budget(config).rollouts, most_rollouts(config)
    mixture, begins_with = mixture_of(config, back_end), _budget(config).rollouts
    in_all = math.inf if config.max_rollouts is None else most
    if most < budget:
        times = f" in {config.repetitions} repetitions" * (config.repetitions > 1)
        message = (
            f"max_rollouts = {config.max_rollouts}: must be at least the "
            f"{budget * config.repetitions} that stages, rollouts and final_rollouts come to"
            f"{times}; or lower these"
        )
        raise ConfigError(message)
    is_slow = episodic(back_end.simulator) is not None or back_end.batch_rollouts < FAST_BATCH
    return AutoSampling(
        mixture=replace(mixture, learning_stages=_begins_with(config).stages),
        first=max(int(PLAIN_SHARE * begins_with), 2),
        most_looked_at=LOOKED_AT * budget,
        most_plain=(PLAIN_PAYS_SLOWLY if is_slow else PLAIN_PAYS) * budget,
        limits=Limits(config.precision, most, _most_s(config), in_all),
    )


def _recounted(kept: KeptRepetition) -> Recounted:
    """As the method that was chosen has it: a count learns nothing."""
    from pemviz.sampling.mixture import estimate  # noqa: PLC0415  slow to import

    if any(stage.kind == "learn" for stage in kept.stages):
        return estimate.recounted(replace(kept, method="mixture"))
    return counted(replace(kept, method="monte-carlo"))


AUTO = MethodDescription(
    name="auto",
    summary="plain rollouts for as long as they pay, then mixture until the answer is precise",
    build=_build,
    recount=_recounted,
    remedy="a larger --max-rollouts, or --max-minutes",
    is_checked=True,
    narrows="half the --precision",
    settings=frozenset(
        {
            "alpha",
            "chains",
            "final_rollouts",
            "max_minutes",
            "max_rollouts",
            "precision",
            "rollouts",
            "sigma",
            "stages",
            "surrogate",
        }
    ),
    budget=_budget,
    with_budget=_with_budget,
    most=most_rollouts,
)
