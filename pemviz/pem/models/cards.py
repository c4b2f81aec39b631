"""A model's provenance in its file: what it was trained on, how, how good it is, on which terms.

A card is JSON, read back with suspicion, and shown as markdown. Beside the card of an error model
stands that of a model of position errors.
"""

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any

from pemviz.errors import PemError
from pemviz.pem.models.memory import FRAILTY_MEANS, TAU_MEANS, Memory
from pemviz.pem.models.predictive_check import (
    CHECK_MEANS,
    check_from_mapping,
    check_rows,
    verdict_lines,
)
from pemviz.pem.models.varying_frailty import VaryingFrailty

Json = Mapping[str, Any]

KITTI_LICENCE = "CC BY-NC-SA 3.0 (KITTI, on which the model was trained; non-commercial)"
UNKNOWN_LICENCE = "not stated (if trained on KITTI: CC BY-NC-SA 3.0, non-commercial)"
UNKNOWN_ERRORS_LICENCE = "not stated (if made from nuScenes or KITTI: CC BY-NC-SA, non-commercial)"

CLEAR_ERRORS = 2.0
"""Standard errors from which on one law is said to be the likelier."""
SINGLE_OBSTACLES = (
    "Scores are of single obstacles; consecutive misses of one obstacle are not modelled as "
    "dependent."
)
REMEMBERED = (
    "Scores are of single observations; how misses of one obstacle follow each other stands above."
)
LIMITS = """\
## Limits

- Fitted once with the seed above and taken as it came, not chosen for the failure probability
  that it leads to. Fits that differ in the seed alone can put that probability orders of
  magnitude apart: quote it with the interval over an ensemble.
- It answers everywhere, also where no training obstacle lies near; {nearness}.
- {dependence}
- Obstacles of one drive, and of one image, resemble each other: cross-validated scores over
  obstacles are better than scores on a new drive would be.{counts}"""
NEARNESS = "the support check says where"
NEARNESS_OF_RANGES = (
    "a run says where its scenario leaves the range of a feature,\n"
    "  not where it leaves what features were seen together"
)
COUNTS = """
- The file's metadata holds counts of training obstacles and misses by class, occlusion, place and
  distance, under the same terms as the model."""
FLATTERY_IF = (
    "If the detector was trained on these drives or on ones like them, its misses close by are "
    "fewer than on new roads. How misses follow each other close by rests on the misses counted "
    "under 'plain view'."
)
CAUTION = (
    "What P(missed | state) leaves out and what lasts from frame to frame passes for memory: "
    "another model of it gives another memory time, a shorter or a longer one."
)
MOST_PAIRS = 0.95
"""Of pairs of neighbouring frames of tracks: the share that close more slowly than is told."""
CLEARLY = 0.05
"""Difference of correlations that a card speaks of."""

AXIS_WORDS = {
    "range": "along the line of sight",
    "cross_range": "across the line of sight",
    "speed": "of speed",
}
AXIS_UNITS = {"range": "m", "cross_range": "m", "speed": "m/s"}
INDEPENDENCE_ASSUMED = (
    "The table has no tracks: that an obstacle's errors are independent from step to step is an "
    "assumption, and a favourable one."
)


@dataclass(frozen=True)
class PemCard:
    """Provenance of a perception error model."""

    name: str
    model: str
    """Kind of model: guess-mu, lr, ml-nn, b-nn, gb-paper, gb-raw, or another's own."""
    data: str = "not stated"
    """What it was trained on, in words."""
    data_digest: str = ""
    """SHA-256 of the training table; empty if unknown."""
    licence: str = UNKNOWN_LICENCE
    recipe: str = "not stated"
    """How it was trained, in words."""
    seed: int = 0
    scores: Mapping[str, float] = field(default_factory=dict[str, float])
    support: Json = field(default_factory=dict[str, Any])
    """Counts of training obstacles and misses by distance; see pemviz.pem.data.support."""
    memory: Json = field(default_factory=dict[str, Any])
    """How misses hang together, if fitted to video; see :class:`FittedMemory`."""
    check: Json = field(default_factory=dict[str, Any])
    """What predictive checks found of it; a ``ModelCheck`` as JSON values."""


@dataclass(frozen=True)
class PositionErrorCard:
    """Provenance of a model of position errors; as a :class:`PemCard`.

    Attributes:
        report: Sizes, scores, tails and calibration, as
            ``pemviz.pem.judging.position_error_report`` writes them; empty if not fitted.
    """

    name: str = "not stated"
    data: str = "not stated"
    data_digest: str = ""
    licence: str = UNKNOWN_ERRORS_LICENCE
    recipe: str = "not stated"
    report: Json = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class FittedMemory:
    """What a model's card says of its memory.

    Attributes:
        tau_interval_s: Of the memory time [s].
        frailty_interval: Of the frailty; ``None`` where it was not fitted.
        confidence: Of each interval.
        sequences: Independent sequences it rests on.
        observations: Outcomes it rests on.
        rate_hz: Frames a second of the video.
        varying: The other law, by which the visibility comes and goes; ``None`` where it was not
            fitted.
        closing_mps: Closing speed that :data:`MOST_PAIRS` of the pairs of neighbouring frames
            stayed below; ``None`` where that is not known.
    """

    memory: Memory
    tau_interval_s: tuple[float, float]
    frailty_interval: tuple[float, float] | None
    confidence: float
    sequences: int
    observations: int
    rate_hz: float
    varying: VaryingFrailty | None = None
    closing_mps: float | None = None


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

    @property
    def varying_frailty(self) -> VaryingFrailty | None:
        """How visibility comes and goes, as fitted to video; None without.

        Raises:
            PemError: As of :attr:`memory`.
        """
        fitted = fitted_memory(self.card.memory, where=self.card.name)
        return None if fitted is None else fitted.varying


def memory_of(pem: object) -> Memory | None:
    """The memory that a model carries; ``None`` if it has none.

    A model of one's own carries one as its attribute ``memory``.

    Raises:
        PemError: Its attribute ``memory`` is neither ``None`` nor a :class:`Memory`.
    """
    memory: object = getattr(pem, "memory", None)
    if memory is None or isinstance(memory, Memory):
        return memory
    name = getattr(pem, "name", type(pem).__name__)
    raise PemError(f"{name}: its memory is a {type(memory).__name__}, must be a Memory")


def card_from_mapping(values: Json, *, where: str) -> PemCard:
    """Read a card back from parsed JSON; ``where`` names the file.

    Raises:
        PemError: a field is missing, unknown or of the wrong type.
    """
    _check_fields(values, PemCard, needed={"name", "model", "data", "licence"}, where=where)
    fitted_memory(values.get("memory", {}), where=where)
    check_from_mapping(values.get("check", {}), where=where)
    seed = values.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise PemError(f"{where}: metadata field 'seed' must be a whole number")
    scores: Mapping[str, object] = values.get("scores", {})
    for name, score in scores.items():
        if isinstance(score, bool) or not isinstance(score, int | float):
            raise PemError(f"{where}: metadata field 'scores' must hold numbers, not {name!r}")
    return PemCard(**values)


def position_card_from_mapping(values: Json, *, where: str) -> PositionErrorCard:
    """Read a card of position errors back from parsed JSON; ``where`` names the file.

    Raises:
        PemError: A field is missing, unknown, or not as pemviz writes it.
    """
    everything = {item.name for item in fields(PositionErrorCard)}
    _check_fields(values, PositionErrorCard, needed=everything, where=where)
    card = PositionErrorCard(**values)
    position_report_markdown(card.report, where=where)
    return card


def _check_fields(values: Json, card: type[Any], *, needed: set[str], where: str) -> None:
    """Whether fields are there, known, and text or tables."""
    types = {item.name: item.type for item in fields(card)}
    unknown, missing = set(values) - set(types), needed - set(values)
    if unknown or missing:
        raise PemError(f"{where}: metadata has unknown {sorted(unknown)}, lacks {sorted(missing)}")
    for name, value in values.items():
        if types[name] is str and not isinstance(value, str):
            raise PemError(f"{where}: metadata field {name!r} must be text")
        if types[name] not in (str, int) and not isinstance(value, dict):
            raise PemError(f"{where}: metadata field {name!r} must be a table")


def varying_frailty_of(pem: object) -> VaryingFrailty | None:
    """How the visibility that a model carries comes and goes; ``None`` if it does not say so.

    A model of one's own carries it as its attribute ``varying_frailty``.

    Raises:
        PemError: That is neither ``None`` nor a :class:`VaryingFrailty`.
    """
    law: object = getattr(pem, "varying_frailty", None)
    if law is None or isinstance(law, VaryingFrailty):
        return law
    name = getattr(pem, "name", type(pem).__name__)
    raise PemError(f"{name}: its varying_frailty is a {type(law).__name__}")


@contextmanager
def as_pemviz_writes(what: str) -> Generator[None]:
    """For reading tables of a card: what is missing or of another type is said in one line.

    Raises:
        PemError: Something is.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise PemError(f"{what} is not as pemviz writes it") from error


def fitted_memory(card_memory: Json, *, where: str) -> FittedMemory | None:
    """The fitted memory of a card's table; ``None`` if the model has none.

    Raises:
        PemError: The table is not as ``pemviz.pem.judging.memory_report`` writes it; begins with
            ``where``.
    """
    if not card_memory:
        return None
    with as_pemviz_writes(f"{where}: metadata field 'memory'"):
        fit, memory = card_memory["fit"], card_memory["fit"]["memory"]
        frailty, closing_mps = fit["frailty_interval"], card_memory.get("closing_mps")
        return FittedMemory(
            memory=Memory(tau_s=_number(memory["tau_s"]), frailty=_number(memory["frailty"])),
            tau_interval_s=_pair(fit["tau_interval_s"]),
            frailty_interval=None if frailty is None else _pair(frailty),
            confidence=_number(fit["confidence"]),
            sequences=int(_number(fit["sequences"])),
            observations=int(_number(fit["observations"])),
            rate_hz=_number(card_memory["rate_hz"]),
            varying=_varying(card_memory.get("varying")),
            closing_mps=None if closing_mps is None else _number(closing_mps),
        )


def varying_words(varying: Json) -> str:
    """The fitted law of a time-varying frailty, and which law tells the tracks better."""
    law, better = varying["law"], _number(varying["better_by"])
    error = _number(varying["better_by_std_error"])
    likelier = "likelier" if better > 0.0 else "less likely"
    decided = "" if abs(better) >= CLEAR_ERRORS * error else ": these tracks do not decide"
    return (
        f"visibility that comes and goes: time-varying frailty {law['varying']:.2f} over "
        f"{law['varying_s']:.2f} s, lasting frailty {law['frailty']:.2f}; {varying['nats']:.3f} "
        f"nats, {likelier} than copied outcomes by {abs(better):.4f} +- {error:.4f}{decided}"
    )


def _varying(table: Json | None) -> VaryingFrailty | None:
    if table is None:
        return None
    law: Json = table["law"]
    return VaryingFrailty(**{each.name: _number(law[each.name]) for each in fields(VaryingFrailty)})


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        message = f"{value!r} is no number"
        raise ValueError(message)
    return float(value)


def _pair(value: Any) -> tuple[float, float]:
    low, high = value
    return _number(low), _number(high)


def card_markdown(card: PemCard, *, digest: str) -> str:
    """The model card as a page of markdown, with the SHA-256 of the model's weights."""
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
    limits = LIMITS.format(
        nearness=NEARNESS if card.support else NEARNESS_OF_RANGES,
        dependence=REMEMBERED if card.memory else SINGLE_OBSTACLES,
        counts=COUNTS if card.support else "",
    )
    head = _head(f"Perception error model `{card.name}`", rows)
    told = (memory_markdown(card.memory), check_markdown(card.check))
    parts = [head, *(part for part in told if part)]
    return "\n".join([*parts, f"{limits}\n"])


def position_card_markdown(card: PositionErrorCard, *, digest: str) -> str:
    """The card as a page of markdown, with the SHA-256 of the model's parameters.

    Raises:
        PemError: The report is not as pemviz writes it.
    """
    rows = [
        ("Made from", card.data),
        ("Training table", f"SHA-256 `{card.data_digest}`" if card.data_digest else "not stated"),
        ("Licence", card.licence),
        ("Recipe", card.recipe),
        ("Parameters", f"SHA-256 `{digest}`"),
    ]
    report = position_report_markdown(card.report, where=card.name)
    return f"{_head(f'Position errors `{card.name}`', rows)}\n{report}"


def _head(title: str, rows: Sequence[Sequence[str]]) -> str:
    body = "\n".join(f"| {left} | {right} |" for left, right in rows)
    return f"# {title}\n\n| | |\n|---|---|\n{body}\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a markdown table; none without rows."""
    if not rows:
        return []
    lines = [f"| {' | '.join(cells)} |" for cells in (header, *rows)]
    return [lines[0], f"|{'---|' * len(header)}", *lines[1:]]


def _shown(value: float | None, *, none: str = "") -> str:
    return none if value is None else f"{value:.3f}"


def _lags(rows: Sequence[Json], *, none: str = "") -> list[tuple[str, ...]]:
    return [
        (
            f"{row['lag_s']:g} s",
            str(row["pairs"]),
            *(_shown(row[key], none=none) for key in ("measured", "fitted")),
        )
        for row in rows
    ]


def memory_markdown(memory: Json) -> str:
    """The card's section on memory; empty for a model without one.

    Raises:
        PemError: The table is not as ``pemviz.pem.judging.memory_report`` writes it.
    """
    if not memory:
        return ""
    with as_pemviz_writes("metadata field 'memory'"):
        lengths = memory["run_lengths"]
        names = [str(length) for length in range(1, len(lengths))] + [f"{len(lengths)} or more"]
        expected = memory["expected_run_lengths"], memory["independent_run_lengths"]
        runs = [
            (name, str(count), f"{fitted:.1f}", f"{independent:.1f}")
            for name, count, fitted, independent in zip(names, lengths, *expected, strict=True)
        ]
        counted = ("observations", "misses", "misses_after_miss")
        plain = [(row["name"], *(str(row[key]) for key in counted)) for row in memory["plain_view"]]
        parts = [
            _memory_facts(memory),
            _table(
                ("lag", "pairs", "correlation of residuals", "in the fitted model"),
                _lags(memory["correlations"]),
            ),
            _table(("misses in a row", "runs", "in the fitted model", "if independent"), runs),
            _table(
                ("observations", "n", "missed", "after a miss", "after a hit", "tau alone"),
                [_group_cells(row) for row in memory["groups"]],
            ),
            _table(
                ("plain view: not occluded, not truncated", "n", "missed", "of them after a miss"),
                plain,
            ),
        ]
    return "\n\n".join(["## Memory of misses", *("\n".join(part) for part in parts if part)]) + "\n"


def check_markdown(check: Json) -> str:
    """The card's section on predictive checks; empty for a model without.

    Raises:
        PemError: The table is not as pemviz writes it.
    """
    found = check_from_mapping(check, where="card")
    if found is None:
        return ""
    facts = "\n".join(f"- {line}" for line in (*verdict_lines(found), CHECK_MEANS))
    table = "\n".join(_table(*check_rows(found)))
    return f"## Predictive checks\n\n{facts}\n\n{table}\n"


def _memory_facts(memory: Json) -> list[str]:
    fit: Json = memory["fit"]
    low, high = fit["tau_interval_s"]
    frailty = "not fitted"
    if fit["frailty_interval"] is not None:
        least, most = fit["frailty_interval"]
        frailty = f"{fit['memory']['frailty']:.2f} ({least:.2f} to {most:.2f})"
    lags = [
        f"{row['lag_s']:g} s"
        for row in memory["correlations"]
        if None not in (row["measured"], row["fitted"])
        and row["measured"] > row["fitted"] + CLEARLY
    ]
    misfit = (
        f"- At {', '.join(lags)} residuals hang together more than in the fitted model (below): "
        "one memory time and one frailty do not tell all, and bursts may last longer than they say."
    )
    return [
        f"- Memory time tau {fit['memory']['tau_s']:.3f} s ({low:.3f} to {high:.3f}), frailty f "
        f"{frailty}; {fit['confidence']:.0%} intervals, {fit['sequences']} "
        f"sequences taken as independent, {fit['observations']} observations at "
        f"{memory['rate_hz']:g} Hz, P(missed | state) cross-fitted by sequence.",
        *([f"- Or {varying_words(memory['varying'])}."] if "varying" in memory else []),
        f"- Memory time tau: {TAU_MEANS}. Frailty f: {FRAILTY_MEANS} (0: not at all). A burst: "
        "misses in one frame after the other.",
        f"- Negative log-likelihood of an outcome: {fit['nats_independent']:.3f} nats if misses "
        f"are independent, {fit['nats']:.3f} with this memory.",
        "- The model's own answer is P(missed | state) without this memory.",
        f"- {memory['gaps']} gaps in tracks, {memory['rate_changes']} changes of rate.",
        *_closing_lines(memory),
        *([misfit] if lags else []),
        f"- {CAUTION}",
        f"- {memory['flattery']}",
    ]


def _closing_lines(memory: Json) -> Iterator[str]:
    if (closing_mps := memory.get("closing_mps")) is not None:
        yield (
            f"- {MOST_PAIRS:.0%} of pairs of neighbouring frames close at under {closing_mps:.1f} "
            "m/s; how misses hang together where P(missed) changes faster, no track tells."
        )


def _group_cells(row: Json) -> tuple[str, ...]:
    tau = "too few misses"
    if row["tau_s"] is not None:
        low, high = row["tau_interval_s"]
        tau = f"{row['tau_s']:.2f} s ({low:.2f} to {high:.2f})"
    shares = (_shown(row[key]) for key in ("missed_after_miss", "missed_after_hit"))
    return (row["name"], str(row["observations"]), str(row["misses"]), *shares, tau)


def position_report_markdown(report: Json, *, where: str) -> str:
    """Sizes, scores, tails and calibration as markdown; empty where nothing was fitted.

    Raises:
        PemError: It is not as ``pemviz.pem.judging.position_error_report`` writes it; begins with
            ``where``.
    """
    if not report:
        return ""
    with as_pemviz_writes(f"{where}: its report"):
        parts = [_position_facts(report)]
        for axis in report["axes"]:
            title = f"## Errors {AXIS_WORDS[axis['name']]} [{AXIS_UNITS[axis['name']]}]"
            parts += [[title], _axis_facts(axis), *_axis_tables(axis)]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def _position_facts(report: Json) -> list[str]:
    near, far = report["distance_m"]
    left, right = (math.degrees(end) for end in report["bearing_rad"])
    pairs = [
        f"{one['name']} and {other['name']} {report['correlation'][i][j]:.3f}"
        for i, one in enumerate(report["axes"])
        for j, other in enumerate(report["axes"])
        if i < j
    ]
    return [
        f"- {report['rows']:,} errors of detected obstacles, {report['groups']:,} "
        f"{report['grouped_by']} taken as independent; {near:.1f} to {far:.1f} m away, bearings "
        f"{left:.0f} to {right:.0f} degrees; held beyond these at what they are there.",
        "- Error: reported minus true. Scores, tails and calibration are held out: each fifth of "
        f"the {report['grouped_by']} judged by a model of the others.",
        f"- Correlation of noises in one frame: {', '.join(pairs)}.",
        *([] if report["axes"][0]["lags"] else [f"- {INDEPENDENCE_ASSUMED}"]),
        "- Errors of missed obstacles are in no table: the model is of detected ones.",
        *([f"- {report['note']}"] if report["note"] else []),
    ]


def _axis_facts(axis: Json) -> list[str]:
    unit, nats = AXIS_UNITS[axis["name"]], axis["nats"]
    freedom = axis["degrees_of_freedom"]
    family = "Gaussian" if freedom is None else f"Student's t, {freedom:.2f} degrees of freedom"
    extreme = axis["extreme"]
    lines = [
        f"- {family}. Negative log-likelihood of an error, held out [nats]: one Gaussian for all "
        f"{nats['constant']:.3f}; by distance, bearing and aspect, Gaussian "
        f"{nats['gaussian']:.3f}, Student's t {nats['student-t']:.3f}.",
        f"- The largest error in the data is {axis['largest']:.2f} {unit}. What the model says of "
        f"larger ones is its family's word: with a probability of 1e-9 above "
        f"{extreme['model']:.3g} {unit} at {extreme['distance_m']:g} m, were it Gaussian above "
        f"{extreme['gaussian']:.3g} {unit}.",
    ]
    if axis["lags"]:
        share, tau = axis["memory"]["lasting_share"], axis["memory"]["tau_s"]
        lines.append(
            f"- Over time the noise of one obstacle has the correlation c + (1 - c) exp(-h / tau): "
            f"c {share['value']:.2f} ({share['low']:.2f} to {share['high']:.2f}), tau "
            f"{tau['value']:.2f} s ({tau['low']:.2f} to {tau['high']:.2f}); 95% intervals. Nearer "
            f"in time than {axis['lags'][0]['lag_s']:g} s that is an extrapolation."
        )
    return lines


def _axis_tables(axis: Json) -> list[list[str]]:
    """By distance as fitted and as in the data, in the tails, and over time."""

    def cells(row: Json, *keys: str) -> list[str]:
        return [_shown(row[key], none="none") for key in keys]

    sizes = ("mean", "fitted_mean", "sd", "fitted_sd", "half_width", "fitted_half_width")
    return [
        _table(
            ("straight ahead, from behind: fitted", "mean", "sd", "68 % within +-"),
            [
                [f"{row['distance_m']:g} m", *cells(row, "mean", "sd", "half_width")]
                for row in axis["ahead"]
            ],
        ),
        _table(
            ("distance", "n", "mean", "fitted", "sd", "fitted", "68 % within +-", "fitted"),
            [
                [f"{row['low_m']:g} to {row['high_m']:g} m", str(row["rows"]), *cells(row, *sizes)]
                for row in axis["distances"]
            ],
        ),
        _table(
            ("tails", "expected", "measured by this model (95 %)", "measured, were it Gaussian"),
            [
                [
                    f"beyond {row['beyond']:g} sd of a normal",
                    f"{row['expected']:.1f}",
                    f"{row['measured']} ({row['low']:.0f} to {row['high']:.0f})",
                    str(row["if_gaussian"]),
                ]
                for row in axis["tails"]
            ],
        ),
        _table(
            ("time between", "pairs", "correlation of the noise", "fitted"),
            _lags(axis["lags"], none="none"),
        ),
    ]
