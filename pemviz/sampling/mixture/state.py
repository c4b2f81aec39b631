"""Where a repetition of method ``mixture`` stands."""

from dataclasses import dataclass

from pemviz.proposals.offset_logistic import PolynomialBasis, StateFeatures
from pemviz.sampling.mixture.balance_heuristic import Pool
from pemviz.sampling.mixture.fit import Fit


@dataclass(frozen=True)
class MixtureState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        stage: The stage that ``step`` carries out next.
        features: What proposals look at.
        basis: Monomials of it; ``None`` before the first stage.
        pool: Everything drawn so far.
        fits: What the next stage draws from beside pilots: the main proposal, those of other
            failure modes, one fitted to a level above 0; empty before the first stage.
        frozen: How many rollouts each part of the final batch has, as far as it is drawn.
        latched: Whether rollouts know when they have violated.
        turns: Outcomes of a step of the scenario.
        starts: Random values at the start of a rollout.
        rules: Names, where there are several.
        many: Whether the learning stages have more rollouts than are drawn at once.
    """

    repetition: int
    stage: int
    features: StateFeatures
    basis: PolynomialBasis | None = None
    pool: Pool | None = None
    fits: tuple[Fit, ...] = ()
    frozen: tuple[int, ...] = ()
    latched: bool = True
    turns: int = 1
    starts: int = 0
    rules: tuple[str, ...] = ()
    many: bool = False

    @property
    def final(self) -> slice:
        """Which rollouts of the pool are the final batch, as far as it is drawn."""
        drawn = 0 if self.pool is None else self.pool.drawn
        return slice(drawn - sum(self.frozen), None)
