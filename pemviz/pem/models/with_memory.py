"""What an error model of single outcomes becomes once they hang together."""

from dataclasses import dataclass

from pemviz.pem.models.memory import Memory, persistence
from pemviz.pem.models.protocol import Pem


@dataclass(frozen=True, eq=False)
class PemWithMemory:
    """An error model whose outcomes hang together; name, digest and data are the model's own.

    Attributes:
        pem: The error model, for single outcomes.
        memory: How they hang together.
        dt_s: Time between two outcomes [s].
    """

    pem: Pem
    memory: Memory
    dt_s: float

    @property
    def name(self) -> str:
        """The model's name."""
        return self.pem.name

    @property
    def digest(self) -> str:
        """The model's digest."""
        return self.pem.digest

    @property
    def data(self) -> str:
        """What the model was trained on."""
        return self.pem.data

    @property
    def licence(self) -> str:
        """Terms of the model's use."""
        return self.pem.licence

    @property
    def rho(self) -> float:
        """Correlation of one outcome with the next, of one obstacle; 0 to below 1."""
        return float(persistence(self.dt_s, self.memory.tau_s))
