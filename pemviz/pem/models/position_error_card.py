"""What a model of position errors rests on: its card, and the card as markdown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from pemviz.errors import PemError

UNKNOWN_LICENCE = "not stated (if made from nuScenes or KITTI: CC BY-NC-SA, non-commercial)"
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
class PositionErrorCard:
    """Provenance of a model of position errors.

    Attributes:
        name: Short name.
        data: What it is made from, in words.
        data_digest: SHA-256 of the training table; empty if unknown.
        licence: Terms of use.
        recipe: How it is made, in words.
        report: Sizes, scores, tails and calibration, as
            ``pemviz.pem.judging.position_error_report`` writes them; empty if not fitted.
    """

    name: str = "not stated"
    data: str = "not stated"
    data_digest: str = ""
    licence: str = UNKNOWN_LICENCE
    recipe: str = "not stated"
    report: Mapping[str, Any] = field(default_factory=dict[str, Any])


def position_card_from_mapping(values: Mapping[str, Any], *, where: str) -> PositionErrorCard:
    """Read a card back.

    Args:
        values: Parsed JSON.
        where: The file, for the message.

    Raises:
        PemError: A field is missing, unknown, or not as pemviz writes it.
    """
    names = {item.name for item in fields(PositionErrorCard)}
    if set(values) != names:
        raise PemError(
            f"{where}: metadata has unknown {sorted(set(values) - names)}, "
            f"lacks {sorted(names - set(values))}"
        )
    for name in names - {"report"}:
        if not isinstance(values[name], str):
            raise PemError(f"{where}: metadata field {name!r} must be text")
    if not isinstance(values["report"], dict):
        raise PemError(f"{where}: metadata field 'report' must be a table")
    card = PositionErrorCard(**values)
    position_report_markdown(card.report, where=where)
    return card


def position_card_markdown(card: PositionErrorCard, *, digest: str) -> str:
    """The card as a page of markdown.

    Args:
        card: The model's provenance.
        digest: SHA-256 of its parameters.

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
    body = "\n".join(f"| {left} | {right} |" for left, right in rows)
    head = f"# Position errors `{card.name}`\n\n| | |\n|---|---|\n{body}\n"
    return f"{head}\n{position_report_markdown(card.report, where=card.name)}"


def position_report_markdown(report: Mapping[str, Any], *, where: str) -> str:
    """Sizes, scores, tails and calibration as markdown; empty where nothing was fitted.

    Args:
        report: A card's report.
        where: Whose it is, for the message.

    Raises:
        PemError: It is not as ``pemviz.pem.judging.position_error_report`` writes it.
    """
    if not report:
        return ""
    try:
        parts = [_facts(report)]
        for axis in report["axes"]:
            title = f"## Errors {AXIS_WORDS[axis['name']]} [{AXIS_UNITS[axis['name']]}]"
            tables = (_axis_facts, _ahead_table, _distance_table, _tail_table, _lag_table)
            parts += [[title], *(table(axis) for table in tables)]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise PemError(f"{where}: its report is not as pemviz writes it") from error
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def _facts(report: Mapping[str, Any]) -> list[str]:
    near, far = report["distance_m"]
    left, right = (math.degrees(end) for end in report["bearing_rad"])
    pairs = [
        f"{one['name']} and {other['name']} {report['correlation'][i][j]:.3f}"
        for i, one in enumerate(report["axes"])
        for j, other in enumerate(report["axes"])
        if i < j
    ]
    note = [f"- {report['note']}"] if report["note"] else []
    return [
        f"- {report['rows']:,} errors of detected obstacles, {report['groups']:,} "
        f"{report['grouped_by']} taken as independent; {near:.1f} to {far:.1f} m away, bearings "
        f"{left:.0f} to {right:.0f} degrees; held beyond these at what they are there.",
        "- Error: reported minus true. Scores, tails and calibration are held out: each fifth of "
        f"the {report['grouped_by']} judged by a model of the others.",
        f"- Correlation of noises in one frame: {', '.join(pairs)}.",
        *([] if report["axes"][0]["lags"] else [f"- {INDEPENDENCE_ASSUMED}"]),
        "- Errors of missed obstacles are in no table: the model is of detected ones.",
        *note,
    ]


def _axis_facts(axis: Mapping[str, Any]) -> list[str]:
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


def _ahead_table(axis: Mapping[str, Any]) -> list[str]:
    rows = [
        [f"{row['distance_m']:g} m", *(_shown(row[key]) for key in ("mean", "sd", "half_width"))]
        for row in axis["ahead"]
    ]
    return _table(("straight ahead, from behind: fitted", "mean", "sd", "68 % within +-"), rows)


def _distance_table(axis: Mapping[str, Any]) -> list[str]:
    rows = [
        [
            f"{row['low_m']:g} to {row['high_m']:g} m",
            str(row["rows"]),
            *(_shown(row[key]) for key in
              ("mean", "fitted_mean", "sd", "fitted_sd", "half_width", "fitted_half_width")),
        ]
        for row in axis["distances"]
    ]  # fmt: skip
    header = ("distance", "n", "mean", "fitted", "sd", "fitted", "68 % within +-", "fitted")
    return _table(header, rows)


def _tail_table(axis: Mapping[str, Any]) -> list[str]:
    rows = [
        [
            f"beyond {row['beyond']:g} sd of a normal",
            f"{row['expected']:.1f}",
            f"{row['measured']} ({row['low']:.0f} to {row['high']:.0f})",
            str(row["if_gaussian"]),
        ]
        for row in axis["tails"]
    ]
    header = ("tails", "expected", "measured by this model (95 %)", "measured, were it Gaussian")
    return _table(header, rows)


def _lag_table(axis: Mapping[str, Any]) -> list[str]:
    if not axis["lags"]:
        return []
    rows = [
        [f"{row['lag_s']:g} s", str(row["pairs"]), _shown(row["measured"]), _shown(row["fitted"])]
        for row in axis["lags"]
    ]
    return _table(("time between", "pairs", "correlation of the noise", "fitted"), rows)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        f"| {' | '.join(header)} |",
        f"|{'---|' * len(header)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"
