"""A model's provenance: what it was trained on, how, how good it is, under which terms."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from pemviz.errors import PemError
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.memory_card import fitted_memory, memory_markdown

KITTI_LICENCE = "CC BY-NC-SA 3.0 (KITTI, on which the model was trained; non-commercial)"
UNKNOWN_LICENCE = "not stated (if trained on KITTI: CC BY-NC-SA 3.0, non-commercial)"

INDEPENDENT = (
    "Scores are of single obstacles; consecutive misses of one obstacle are not modelled as "
    "dependent."
)
REMEMBERED = "Scores are of single observations; how misses of one obstacle follow is told above."
LIMITS = """\
## Limits

- Fitted once with the seed above and taken as it came, not chosen for the failure probability
  that it leads to. Fits that differ in the seed alone can put that probability orders of
  magnitude apart: quote it with the interval over an ensemble.
- It answers everywhere, also where no training obstacle lies near; the support check tells where.
- {dependence}
- Obstacles of one drive, and of one image, resemble each other: cross-validated scores over
  obstacles are better than scores on a new drive would be.
- The file's metadata holds counts of training obstacles and misses by class, occlusion, place and
  distance, under the same terms as the model."""


@dataclass(frozen=True)
class PemCard:
    """Provenance of a perception error model."""

    name: str
    """Short name."""
    model: str
    """Kind of model: guess-mu, lr, ml-nn, b-nn, gb-paper, gb-raw, or another's own."""
    data: str = "not stated"
    """What it was trained on, in words."""
    data_digest: str = ""
    """SHA-256 of the training table; empty if unknown."""
    licence: str = UNKNOWN_LICENCE
    """Terms of use."""
    recipe: str = "not stated"
    """How it was trained, in words."""
    seed: int = 0
    """Seed of everything random in its training."""
    scores: Mapping[str, float] = field(default_factory=dict[str, float])
    """Scores by name, as measured when it was trained."""
    support: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Counts of training obstacles and misses by distance; see pemviz.pem.data.support."""
    memory: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """How misses hang together, if fitted to video; see pemviz.pem.models.memory_card."""


class Carded:
    """What a model's card says of it, as the Pem protocol asks."""

    card: PemCard

    @property
    def name(self) -> str:
        """Short name."""
        return self.card.name

    @property
    def data(self) -> str:
        """What it was trained on, or made from."""
        return self.card.data

    @property
    def licence(self) -> str:
        """Terms of use."""
        return self.card.licence

    @property
    def memory(self) -> Memory | None:
        """How misses hang together, as fitted to video; None without one.

        Raises:
            PemError: the card's table of it is not as pemviz writes it.
        """
        fitted = fitted_memory(self.card.memory, where=self.card.name)
        return None if fitted is None else fitted.memory


def card_from_mapping(values: Mapping[str, Any], *, where: str) -> PemCard:
    """Read a card back.

    Args:
        values: parsed JSON.
        where: the file, for the message.

    Raises:
        PemError: a field is missing, unknown or of the wrong type.
    """
    names = {item.name for item in fields(PemCard)}
    unknown = set(values) - names
    missing = {"name", "model", "data", "licence"} - set(values)
    if unknown or missing:
        raise PemError(f"{where}: metadata has unknown {sorted(unknown)}, lacks {sorted(missing)}")
    for name in ("name", "model", "data", "data_digest", "licence", "recipe"):
        if not isinstance(values.get(name, ""), str):
            raise PemError(f"{where}: metadata field {name!r} must be text")
    for name in ("scores", "support", "memory"):
        if not isinstance(values.get(name, {}), dict):
            raise PemError(f"{where}: metadata field {name!r} must be a table")
    fitted_memory(values.get("memory", {}), where=where)
    seed = values.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise PemError(f"{where}: metadata field 'seed' must be a whole number")
    scores: Mapping[str, object] = values.get("scores", {})
    for name, score in scores.items():
        if isinstance(score, bool) or not isinstance(score, int | float):
            raise PemError(f"{where}: metadata field 'scores' must hold numbers, not {name!r}")
    return PemCard(**values)


def card_markdown(card: PemCard, *, digest: str) -> str:
    """The model card as a page of markdown.

    Args:
        card: the model's provenance.
        digest: SHA-256 of its weights.
    """
    rows = [
        ("Model", card.model),
        ("Trained on", card.data),
        ("Training table", f"SHA-256 `{card.data_digest}`" if card.data_digest else "not stated"),
        ("Licence", card.licence),
        ("Recipe", card.recipe),
        ("Seed", str(card.seed)),
        ("Weights", f"SHA-256 `{digest}`"),
        *((f"Score: {name}", f"{value:.4f}") for name, value in card.scores.items()),
    ]
    body = "\n".join(f"| {left} | {right} |" for left, right in rows)
    limits = LIMITS.format(dependence=REMEMBERED if card.memory else INDEPENDENT)
    memory = memory_markdown(card.memory)
    head = f"# Perception error model `{card.name}`\n\n| | |\n|---|---|\n{body}\n"
    return "\n".join([head, *([memory] if memory else []), f"{limits}\n"])
