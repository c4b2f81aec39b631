"""How misses follow each other on video, and how well a fitted memory tells it; and its picture.

An error model and its memory are fitted to the same video: P(missed | state) of an observation is
that of a model which saw none of its sequence.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import expit, ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.colors import BLACK, BLUE, GREY, VERMILLION
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable, TrackTable
from pemviz.pem.fitting.fit import BOOSTED, ModelKind, fit_pem
from pemviz.pem.fitting.memory import MemoryFit, check_fittable, fit_memory, memory_surface
from pemviz.pem.fitting.varying_frailty import VaryingFit
from pemviz.pem.judging.cross_validation import score
from pemviz.pem.models import memory as memory_law
from pemviz.pem.models.cards import FLATTERY_IF, MOST_PAIRS, as_pemviz_writes, varying_words
from pemviz.pem.models.ensemble import EnsemblePem, SingleModel
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.predictive_check import DISTANCE_BANDS_M, ModelCheck, check_table
from pemviz.pem.models.protocol import COLUMN, OCCLUSION_NAMES
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.processes import map_in_processes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LAGS_S = (0.1, 0.2, 0.5, 1.0, 3.0)
LAG_TOLERANCE = 0.5
"""Of a frame: how far a pair may be from a lag."""
AHEAD_M = 1.5
AHEAD_WITHIN_M = 40.0
FEWEST_MISSES = 20
"""In a band, for a memory time of its own."""
SIMULATED = 40
LONGEST_RUN = 10
FOLDS = 5
MEASURED, FITTED, INDEPENDENT = BLACK, VERMILLION, GREY
FEWEST_RUNS = 0.3
"""Where the axis of the counts begins: what is expected less often is not seen."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class MemoryReport:
    """A fitted memory, and what its card shows beside it, as JSON values.

    Attributes:
        fit: The fitted memory.
        tables: ``correlations`` of residuals (missed - P(missed)) of one obstacle by the time
            between two observations; ``run_lengths``, how many runs of misses have 1, 2, ... and
            LONGEST_RUN or more frames, and the means of outcomes that are sampled from the fitted
            model or are independent; ``groups``, the memory time of all observations and of parts
            of them; ``plain_view``, counts of obstacles neither occluded nor truncated;
            ``closing_mps``, how fast they come closer; gaps in tracks, changes of rate, and the
            most common rate.
        surface: Log likelihood of each sequence ``[S, taus, frailties]``, which it rests on.
        varying: The other law, a time-varying frailty, where it was fitted too.
    """

    fit: MemoryFit
    tables: dict[str, Any]
    surface: FloatArray = field(compare=False, repr=False)
    varying: VaryingFit | None = None


def fit_report(
    tracks: TrackTable,
    cross_fitted: "CrossFitted",
    *,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> MemoryReport:
    """The memory of tracks, and the data beside outcomes that are sampled from the fitted model.

    ``on_progress`` is called with tracks done and tracks in all.

    Raises:
        PemError: There is nothing to fit a memory to.
    """
    check_fittable(tracks)
    logit = cross_fitted.logit
    surface = memory_surface(tracks, logit, on_progress=on_progress)
    fit = fit_memory(tracks, logit, surface=surface)
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))

    def sampled(memory: Memory) -> BoolArray:
        return sample_outcomes(tracks, logit, law=memory, samples=SIMULATED, random=random)

    def mean_runs(outcomes: BoolArray) -> list[float]:
        return np.mean([run_lengths(tracks, each) for each in outcomes], axis=0).tolist()

    remembered, independent = sampled(fit.memory), sampled(Memory())
    correlations: list[dict[str, Any]] = []
    for lag_s in LAGS_S:
        measured, pairs = residual_correlation(tracks, logit, tracks.detected, lag_s=lag_s)
        values = (residual_correlation(tracks, logit, each, lag_s=lag_s)[0] for each in remembered)
        known = [value for value in values if value is not None]
        fitted = float(np.mean(known)) if known else None
        row = {"lag_s": lag_s, "pairs": pairs, "measured": measured, "fitted": fitted}
        correlations.append(row)
    rates, counts = np.unique(tracks.rate_hz, return_counts=True)
    tables = {
        "correlations": correlations,
        "run_lengths": run_lengths(tracks, tracks.detected).tolist(),
        "expected_run_lengths": mean_runs(remembered),
        "independent_run_lengths": mean_runs(independent),
        "groups": [_group(tracks, logit, *part) for part in _parts(tracks)],
        "plain_view": plain_view(tracks),
        "closing_mps": closing_speed_mps(tracks),
        "gaps": tracks.gaps,
        "rate_changes": tracks.rate_changes,
        "rate_hz": float(rates[np.argmax(counts)]),
    }
    return MemoryReport(fit, tables, surface)


def sample_outcomes(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    law: Memory | VaryingFrailty,
    samples: int,
    random: np.random.Generator,
) -> BoolArray:
    """Outcomes ``[samples, n]`` (true: detected) of the same tracks, drawn from the model.

    The law is of either kind. A sample is the same however many others are drawn after it.
    """
    if isinstance(law, VaryingFrailty):
        return _with_visibility(tracks, logit, law=law, samples=samples, random=random)
    obstacles, frailty = int(tracks.track.max()) + 1, law.frailty
    # the law of P(missed), not of its logit: nothing here needs its small digits
    quantile = memory_law.miss_quantile(logit) * np.sqrt(1.0 + frailty**2)
    own = np.empty((samples, len(tracks)))
    uniforms = np.empty_like(own)
    for sample in range(samples):
        visibility = random.standard_normal(obstacles)[tracks.track]
        own[sample] = ndtr(quantile + frailty * visibility) if frailty else expit(-logit)
        uniforms[sample] = random.random(len(tracks))
    if law.tau_s == 0.0:
        return uniforms < 1.0 - own
    rho = memory_law.persistence(tracks.since_s, law.tau_s)
    detected = np.empty(own.shape, dtype=np.bool_)
    for place, rows in enumerate(tracks.by_place):
        fresh = own[:, rows]
        before = np.zeros(fresh.shape, dtype=np.bool_) if place == 0 else ~detected[:, rows - 1]
        missed = fresh + (before - fresh) * rho[rows]
        detected[:, rows] = uniforms[:, rows] < 1.0 - missed
    return detected


def _with_visibility(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    law: VaryingFrailty,
    samples: int,
    random: np.random.Generator,
) -> BoolArray:
    """The same, with the latents of :mod:`pemviz.pem.models.varying_frailty` sampled themselves."""
    obstacles = int(tracks.track.max()) + 1
    lasting = np.empty((samples, len(tracks)))
    steps, white = np.empty_like(lasting), np.empty_like(lasting)
    for sample in range(samples):
        lasting[sample] = random.standard_normal(obstacles)[tracks.track]
        steps[sample], white[sample] = random.standard_normal((2, len(tracks)))
    varying = np.empty_like(lasting)
    rho = memory_law.persistence(tracks.since_s, law.varying_s)
    for place, rows in enumerate(tracks.by_place):
        before = varying[:, rows - 1] if place else 0.0
        varying[:, rows] = rho[rows] * before + np.sqrt(1.0 - rho[rows] ** 2) * steps[:, rows]
    middle = memory_law.miss_quantile(logit) * law.scale
    return white >= middle + law.frailty * lasting + law.varying * varying


def residual_correlation(
    tracks: TrackTable, logit: FloatArray, detected: BoolArray, *, lag_s: float
) -> tuple[float | None, int]:
    """Correlation of residuals of one obstacle ``lag_s`` apart, and the number of pairs."""
    steps = np.where(tracks.follows, tracks.since_s, 0.0)
    time_s = np.cumsum(steps)
    # tracks are moved apart so that one sorted list of times serves all
    apart = (float(time_s[-1]) + 10.0 * lag_s) * tracks.track + time_s
    wanted, tolerance = apart + lag_s, LAG_TOLERANCE / tracks.rate_hz
    second = np.minimum(np.searchsorted(apart, wanted - tolerance), len(tracks) - 1)
    close = np.abs(apart[second] - wanted) < tolerance
    first = np.flatnonzero(close & (tracks.track[second] == tracks.track))
    second = second[first]
    if first.size == 0:
        return None, 0
    residual = (~detected) - expit(-logit)
    spread = np.sqrt(np.mean(residual[first] ** 2) * np.mean(residual[second] ** 2))
    if spread == 0.0:
        return None, int(first.size)
    return float(np.mean(residual[first] * residual[second]) / spread), int(first.size)


def run_lengths(tracks: TrackTable, detected: BoolArray) -> IntArray:
    """Numbers of runs of 1, 2, ..., LONGEST_RUN or more misses in neighbouring frames."""
    next_frame = tracks.follows & (np.diff(tracks.frame, prepend=-2) == 1)
    missed = ~detected
    begins = missed & ~(next_frame & np.roll(missed, 1))
    run = np.cumsum(begins)[missed]
    sizes = np.bincount(run)[1:] if run.size else np.zeros(0, dtype=np.int64)
    return np.bincount(np.minimum(sizes, LONGEST_RUN), minlength=LONGEST_RUN + 1)[1:]


def plain_view(tracks: TrackTable) -> list[dict[str, Any]]:
    """Counts of obstacles in plain view: by distance, and straight ahead."""
    if not tracks.has_state:
        return []
    salient = tracks.obstacles.salient
    plain = (salient[:, COLUMN["occlusion"]] == 0.0) & (salient[:, COLUMN["truncation"]] == 0.0)
    ahead = np.abs(salient[:, COLUMN["x_m"]]) < AHEAD_M
    ahead &= salient[:, COLUMN["z_m"]] < AHEAD_WITHIN_M
    parts = [*_bands(tracks), (f"straight ahead, nearer than {AHEAD_WITHIN_M:g} m", ahead)]
    misses = plain & ~tracks.detected
    return [
        {
            "name": name,
            "observations": int(np.count_nonzero(plain & chosen)),
            "misses": int(np.count_nonzero(misses & chosen)),
            "misses_after_miss": int(np.count_nonzero(misses & chosen & tracks.missed_before)),
        }
        for name, chosen in parts
    ]


def closing_speed_mps(tracks: TrackTable) -> float | None:
    """Closing speed that ``MOST_PAIRS`` of pairs of frames stay below; ``None``: not known."""
    if not tracks.has_state or not tracks.follows.any():
        return None
    nearer_m = -np.diff(tracks.obstacles.salient[:, COLUMN["z_m"]], prepend=0.0)[tracks.follows]
    return float(np.quantile(nearer_m / tracks.since_s[tracks.follows], MOST_PAIRS))


def _bands(tracks: TrackTable) -> list[tuple[str, BoolArray]]:
    z_m = tracks.obstacles.salient[:, COLUMN["z_m"]]
    return [
        (f"{low:g} to {high:g} m", (z_m >= low) & (z_m < high)) for low, high in DISTANCE_BANDS_M
    ]


def _parts(tracks: TrackTable) -> list[tuple[str, BoolArray]]:
    everything = ("all", np.ones(len(tracks), dtype=np.bool_))
    if not tracks.has_state:
        return [everything]
    occlusion = tracks.obstacles.salient[:, COLUMN["occlusion"]]
    levels = [
        (f"occlusion {name}", occlusion == level) for level, name in enumerate(OCCLUSION_NAMES)
    ]
    return [everything, *_bands(tracks), *levels]


def _group(tracks: TrackTable, logit: FloatArray, name: str, chosen: BoolArray) -> dict[str, Any]:
    """The memory time of a part of the observations, fitted to them alone without frailty.

    A part counts where the observation itself lies, whatever the one before was.
    """
    missed = ~tracks.detected
    misses = int(missed[chosen].sum())
    tau_s, interval = None, None
    if misses >= FEWEST_MISSES:
        try:
            fit = fit_memory(tracks, logit, with_frailty=False, chosen=chosen)
            tau_s, interval = fit.memory.tau_s, fit.tau_interval_s
        except PemError:
            pass

    def share(among: BoolArray) -> float | None:
        return float(missed[among].mean()) if among.any() else None

    return {
        "name": name,
        "observations": int(chosen.sum()),
        "misses": misses,
        "missed_after_miss": share(chosen & tracks.missed_before),
        "missed_after_hit": share(chosen & tracks.follows & ~tracks.missed_before),
        "tau_s": tau_s,
        "tau_interval_s": interval,
    }


def memory_table(report: MemoryReport, *, flattery: str = FLATTERY_IF) -> dict[str, Any]:
    """A report as JSON values for the card.

    ``flattery`` says in words what the training of the detector does to these figures.
    """
    table = {"fit": asdict(report.fit), **report.tables, "flattery": flattery}
    return table if report.varying is None else {**table, "varying": asdict(report.varying)}


def memory_line(report: MemoryReport) -> str:
    """The fitted memory in a line, and one on what its figures are."""
    fit = report.fit
    low, high = fit.tau_interval_s
    told = (
        f"memory time {fit.memory.tau_s:.3f} s ({low:.3f} to {high:.3f}), frailty "
        f"{fit.memory.frailty:.2f}; {fit.nats_independent:.3f} nats an outcome if independent, "
        f"{fit.nats:.3f} with memory\n"
        f"  memory time tau: {memory_law.TAU_MEANS}; frailty: {memory_law.FRAILTY_MEANS}, "
        "0 for not at all"
    )
    if report.varying is None:
        return told
    return f"{told}\nor {varying_words(asdict(report.varying))}"


@dataclass(frozen=True)
class CrossFitted:
    """Logits ``[n]`` of models that saw none of an observation's sequence.

    Attributes:
        part: Which part of the sequences each observation is of ``[n]``, counted from 0.
        whole: The model of all sequences, where one was asked for.
    """

    logit: FloatArray
    part: IntArray
    whole: SingleModel | EnsemblePem | None = None

    @property
    def folds(self) -> int:
        """How many parts."""
        return int(self.part.max()) + 1


Fit = Callable[[SalientTable], SingleModel | EnsemblePem]


def cross_fit(
    tracks: TrackTable,
    *,
    model: ModelKind,
    folds: int = FOLDS,
    seed: int = 0,
    whole: Fit | None = None,
    workers: int = 1,
    on_progress: Progress | None = None,
) -> CrossFitted:
    """Fit a model to all but a part of the sequences, and evaluate it on that part.

    Boosted trees are calibrated, part by part, on what the other parts' models made of sequences
    that they had not seen: a calibration has two numbers, and folds within folds would take four
    times as many fits.

    Args:
        tracks: n observations.
        model: Its kind.
        folds: Parts of the sequences.
        seed: Of each fit.
        whole: Fits the model of all sequences beside them; can be pickled.
        workers: So many fits at once, each in a process if above 1; the result is the same.
        on_progress: Called with fits done and fits in all.

    Raises:
        PemError: There are fewer sequences than folds, or a part lacks an outcome.
        RunError: A process died.
    """
    from sklearn.model_selection import GroupKFold  # noqa: PLC0415  slow to import

    sequences = int(np.unique(tracks.sequence).size)
    if not 2 <= folds <= sequences:
        raise PemError(f"folds is {folds}, allowed: 2 to the number of sequences, {sequences}")
    parts = list(GroupKFold(folds).split(tracks.sequence, groups=tracks.sequence))
    for rest, _ in parts:
        if np.unique(tracks.detected[rest]).size == 1:
            tracks.obstacles.check_outcomes()
            outcome = "missed" if tracks.detected[rest[0]] else "detected"
            where = f"lies in one of {folds} parts of the sequences"
            raise PemError(
                f"all that was {outcome} {where}: there is nothing to fit the others to; collect "
                f"more sequences in which something was {outcome}"
            )
    obstacles = tracks.obstacles
    part = partial(fit_pem, model=model, seed=seed, calibrate=False)
    tasks = [_Task(part, obstacles, *rows) for rows in parts]
    if whole is not None:  # first: it is the longest, and none should wait for it alone
        tasks.insert(0, _Task(whole, obstacles, None, np.zeros(0, dtype=np.int64)))
    done = count(1)

    def tell(_: int) -> None:
        if on_progress is not None:
            on_progress(next(done), len(tasks))

    answers = map_in_processes(_Task.answer, tasks, workers=workers, on_done=tell)
    logit, part_of = np.empty(len(tracks)), np.empty(len(tracks), dtype=np.int64)
    for place, (_, of_part) in enumerate(answers[len(tasks) - folds :]):
        held_out = parts[place][1]
        logit[held_out], part_of[held_out] = of_part, place
    if model in BOOSTED:
        logit = _calibrated(logit, tracks.detected, [held_out for _, held_out in parts])
    return CrossFitted(logit, part_of, whole=None if whole is None else answers[0][0])


def _calibrated(logit: FloatArray, detected: BoolArray, parts: Sequence[IntArray]) -> FloatArray:
    """Held-out logits, those of each part by a line through all others."""
    from pemviz.pem.fitting.linear_and_trees import platt_scaling  # noqa: PLC0415  slow to import

    result = np.empty_like(logit)
    for part in parts:
        slope, intercept = platt_scaling(np.delete(logit, part), np.delete(detected, part))
        result[part] = slope * logit[part] + intercept
    return result


@dataclass(frozen=True, eq=False)
class _Task:
    """A fit that another process can do, to some rows or all, and the rows it is asked about."""

    fit: Fit
    table: SalientTable
    train: IntArray | None
    asked: IntArray

    def answer(self) -> tuple[SingleModel | EnsemblePem, FloatArray]:
        """The model, and its logits of the rows that are asked about."""
        pem = self.fit(self.table if self.train is None else self.table.take(self.train))
        return pem, pem.logit(self.table.salient[self.asked])


def with_memory(
    pem: SingleModel | EnsemblePem,
    tracks: TrackTable,
    *,
    cross_fitted: CrossFitted,
    report: MemoryReport,
    check: ModelCheck,
    flattery: str = FLATTERY_IF,
) -> SingleModel | EnsemblePem:
    """The model of all tracks with their memory on its card, and scores by held-out sequences.

    ``check`` is what these sequences say of it; ``flattery`` says in words what the training of the
    detector does to its figures.
    """
    words = f"{cross_fitted.folds} folds of sequences"
    held_out = score(cross_fitted.logit, tracks.detected)
    scores = {f"bce, {words}": held_out.bce, f"brier, {words}": held_out.brier}
    if held_out.roc_auc is not None:
        scores[f"roc_auc, {words}"] = held_out.roc_auc
    table = memory_table(report, flattery=flattery)
    card = replace(pem.card, scores=scores, memory=table, check=check_table(check))
    return replace(pem, card=card)


def write_memory_picture(memory: Mapping[str, Any], path: Path, *, title: str) -> None:
    """Three charts of a card's table beside each other, as PNG.

    Raises:
        PemError: The table is not as :func:`memory_table` makes it.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    runs, lags, parts = figure.subplots(1, 3)
    with as_pemviz_writes("metadata field 'memory'"):
        _draw_runs(runs, memory)
        _draw_parts(parts, memory)
        draw_lags(lags, memory["correlations"])
        lags.set_xlabel("time between two frames of one obstacle [s]")
        lags.set_ylabel("correlation of residuals")
        lags.set_title("How long a miss is remembered")
        tau_s = float(memory["fit"]["memory"]["tau_s"])
        frailty = float(memory["fit"]["memory"]["frailty"])
    figure.suptitle(f"{title}: memory time {tau_s:.2f} s, frailty {frailty:.2f}")
    figure.savefig(path, dpi=130)


def _draw_runs(axes: "Axes", memory: Mapping[str, Any]) -> None:
    counts = np.asarray(memory["run_lengths"], dtype=np.float64)
    length = np.arange(1, counts.size + 1)
    axes.bar(length, counts, color=MEASURED, alpha=0.25, label="measured")
    for key, color, label in (
        ("expected_run_lengths", FITTED, "fitted model"),
        ("independent_run_lengths", INDEPENDENT, "if independent"),
    ):
        axes.plot(length, np.asarray(memory[key], dtype=np.float64), "o-", color=color, label=label)
    axes.set_yscale("log")
    axes.set_ylim(bottom=FEWEST_RUNS)
    axes.set_xticks(length, [*map(str, length[:-1]), f"{length[-1]}+"])
    axes.set_xlabel(f"misses in a row [frames, {float(memory['rate_hz']):g} Hz]")
    axes.set_ylabel("runs")
    axes.set_title("How long bursts last")
    axes.legend()


def draw_lags(axes: "Axes", correlations: Sequence[Mapping[str, Any]]) -> None:
    """Correlations between two observations of one obstacle, by the time between them."""
    rows = [row for row in correlations if row["measured"] is not None]
    fitted = [row for row in rows if row["fitted"] is not None]
    lag_s = [float(row["lag_s"]) for row in rows]
    axes.plot(lag_s, [float(row["measured"]) for row in rows], "s-", color=MEASURED,
              label="measured")  # fmt: skip
    axes.plot([float(row["lag_s"]) for row in fitted], [float(row["fitted"]) for row in fitted],
              "o-", color=FITTED, label="fitted model")  # fmt: skip
    axes.axhline(0.0, color=INDEPENDENT, label="if independent")
    axes.set_xscale("log")
    axes.set_xticks(lag_s, [f"{lag:g}" for lag in lag_s])
    axes.minorticks_off()
    axes.set_ylim(-0.05, 1.0)
    axes.legend()


def _draw_parts(axes: "Axes", memory: Mapping[str, Any]) -> None:
    rows = [row for row in memory["groups"] if row["tau_s"] is not None][::-1]
    place = np.arange(len(rows))
    tau_s = np.asarray([row["tau_s"] for row in rows], dtype=np.float64)
    ends = np.asarray([row["tau_interval_s"] for row in rows], dtype=np.float64).reshape(-1, 2)
    reach = np.stack([tau_s - ends[:, 0], ends[:, 1] - tau_s])
    axes.errorbar(tau_s, place, xerr=np.maximum(reach, 0.0), fmt="o", color=BLUE, capsize=3)
    names = [f"{row['name']} ({row['misses']} missed)" for row in rows]
    axes.set_yticks(place, names)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("memory time tau [s], fitted without frailty")
    axes.set_title("By distance and occlusion")
    axes.grid(axis="x", alpha=0.3)
