"""The paper's braking scenario, and one camera in a hundred has a dirty lens: how likely now?

Nobody tells the rollout whether its lens is dirty. What the outcomes so far tell of it is a number
of the state, and with it P(detected) depends on all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import pemviz
from pemviz import BoolArray, FloatArray, HiddenProperty, Known, Signal, StateBatch

Model = Callable[[StateBatch], FloatArray]


@dataclass(frozen=True)
class DirtyLens(HiddenProperty):
    share: float  # of all cameras
    drop: float  # what dirt takes off the logit of P(detected)
    signals: ClassVar[tuple[Signal, ...]] = (Signal("dirty", "dirty", "", -1e3, 1e3),)  # log odds

    @property
    def label(self) -> str:
        return f"{100 * self.share:g} % dirty lenses"

    def begin(self, states: StateBatch, model: Model) -> Known:
        log_odds = np.log(self.share) - np.log1p(-self.share)
        return Known({"dirty": np.full(states.shape, log_odds)})

    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: Model
    ) -> Known:
        clean = np.where(detected, 1.0, -1.0) * model(before)  # logit of what happened
        dirty = clean - np.where(detected, 1.0, -1.0) * self.drop
        told = np.logaddexp(0.0, -clean) - np.logaddexp(0.0, -dirty)
        return Known({"dirty": before.signals["dirty"] + told})

    def logit(self, shown: FloatArray, own: Callable[[], FloatArray]) -> FloatArray:
        odds, clean = shown[..., 0], own()
        dirty = clean - self.drop
        of_dirty, of_clean = -np.logaddexp(0.0, -odds), -np.logaddexp(0.0, odds)
        hit = np.logaddexp(of_dirty - np.logaddexp(0, -dirty), of_clean - np.logaddexp(0, -clean))
        miss = np.logaddexp(of_dirty - np.logaddexp(0, dirty), of_clean - np.logaddexp(0, clean))
        return hit - miss


if __name__ == "__main__":
    for method in ("mixture", "splitting"):  # the second checks the first independently
        config = pemviz.ExperimentConfig(method=method, seed=1, final_rollouts=1000)
        experiment = pemviz.build_experiment(config, hidden=[DirtyLens(share=0.01, drop=3.0)])
        worst = pemviz.LeastRobust()
        print(pemviz.summary_text(pemviz.run(experiment, observers=[worst])), worst, sep="\n")
