"""A walk whose simulator breaks at known outcomes, so that all that is told of it is known exactly.

Every miss costs 1 m of a gap of 2.5 m: the third makes it negative. Where the first four outcomes
are detected, missed, missed, detected, the fourth step breaks, whoever is at it.
"""

import itertools
import os
import time
from dataclasses import dataclass

import numpy as np

import pemviz
from pemviz.types import Signal, StateBatch

STATES, MISS = 9, 0.3
BREAKS_AT = (True, False, False, True)
SPEC = f"always[0,{STATES - 1}] (gap >= 0)"


def throw():
    raise ValueError("wheel fell off")


def stall():
    time.sleep(600.0)


HOW = {"aborts": os.abort, "raises": throw, "stalls": stall}


@dataclass(frozen=True)
class FragileWalk:
    """Attributes: how it breaks; ``holds``: it does not, ``drifts``: but is another system."""

    how: str = "aborts"
    states: int = STATES
    dt_s: float = 0.1
    name: str = "fragile-walk"

    @property
    def signals(self):
        return (Signal(name="gap", key="gap_m", unit="m", low=-7.0, high=3.0),)

    def initial(self, *, count):
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={"gap": np.full(count, 2.5)},
            memory={"as": np.ones(count, dtype=np.bool_)},
        )

    def step(self, states, detected):
        step, alike = int(states.step), states.memory["as"]
        if step < len(BREAKS_AT):
            alike = alike & (detected == BREAKS_AT[step])
            if step == len(BREAKS_AT) - 1 and alike.any() and self.how in HOW:
                HOW[self.how]()
        gap = states.signals["gap"] - ~detected + 0.25 * (step == 5 and self.how == "drifts")
        return StateBatch(step=states.step + 1, signals={"gap": gap}, memory={"as": alike})

    def salient(self, signals):
        return signals["gap"][..., None]


@dataclass(frozen=True)
class Constant:
    """Misses with the same probability everywhere."""

    miss: float = MISS

    def logit(self, salient):
        return np.full(salient.shape[:-1], np.log1p(-self.miss) - np.log(self.miss))


def simulator():
    """As a package registers it."""
    return FragileWalk()


PEM = Constant()


def experiment(how="aborts", batch_rollouts=None, miss=MISS, **options):
    """A run of it."""
    given = {"method": "monte-carlo", "spec": SPEC, "final_rollouts": 60, "seed": 3}
    config = pemviz.ExperimentConfig(**{**given, **options})
    return pemviz.build_experiment(
        config, simulator=FragileWalk(how), pem=Constant(miss), batch_rollouts=batch_rollouts
    )


def breaks(outcomes):
    """Whether a rollout with these outcomes does."""
    return tuple(outcomes[: len(BREAKS_AT)]) == BREAKS_AT


def exact(*, lost_violate, miss=MISS):
    """P(violation), of what breaks as asked; nothing violates before it breaks."""
    total = 0.0
    for outcomes in itertools.product((True, False), repeat=STATES - 1):
        p = np.prod([1.0 - miss if detected else miss for detected in outcomes])
        violates = lost_violate if breaks(outcomes) else sum(not o for o in outcomes) > 2
        total += p * violates
    return total
