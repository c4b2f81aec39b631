"""A risk budget held against its run folders: factors from their answers, and whether it is met.

P(violation | encounter) is a run's answer as the first screen has it. Its range to act on
(:class:`pemviz.runs.answers.OpenRange`) bounds it at either end; where the sampling reaches
farthest, the end is that of the sampling's distribution. Sources that are ranges over models or
memories are no distributions: they are ends, and nothing is averaged over them. An answer whose
interval is none, or of which nobody looked how far it is open, is not known, and neither is the
budget then.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pemviz.analysis.risk import FactorEffect, HazardFactors, Risk, combine, effects
from pemviz.analysis.risk_factors import (
    HIGH,
    LOW,
    AnyFactor,
    CurveHarm,
    Distribution,
    Draws,
    Exact,
    Factor,
    FactorKind,
    ImpactSpeeds,
    InjuryCurve,
    counted_probability,
    counted_rate,
    impact_speeds,
    stated,
)
from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.config.risk_budget import (
    ANY_RULE,
    PER_MPS,
    EncounterRate,
    Hazard,
    RiskBudget,
    StatedProbability,
    load_budget,
)
from pemviz.errors import ConfigError, InputError
from pemviz.files.array_files import map_arrays
from pemviz.files.atomic import file_digest
from pemviz.runs.answers import Answer, answers
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import BROKEN, COLUMN, ROLLOUTS_FILE, log_weights
from pemviz.sampling.registry import by_name
from pemviz.simulators.braking.contact import first_contact
from pemviz.types import Estimate

Outcome = Literal["met", "not met", "not known"]
IMPACT_SPEED, COLLIDED, GAP = "impact_speed_mps", "collided", "gap_m"
LOG_WEIGHT = f"{COLUMN}log_weight"
ENDS = np.array([LOW, HIGH])
CONFIDENCE = 0.95
LEAST_IMPACTS, FEW_IMPACTS = 1.5, 10.0
"""Independent violations, by weight: below these nothing, or little, tells how impacts vary."""


@dataclass(frozen=True)
class EvidenceRun:
    """A run behind a hazard.

    Attributes:
        folder: Where it is.
        result: What it says.
        answer: To the hazard's rule; ``None`` where it has none.
        unknown: Why P(violation) is not known by it; empty where it is.
    """

    folder: Path
    result: RunResult
    answer: Answer | None
    unknown: str

    @property
    def name(self) -> str:
        """The folder's."""
        return self.folder.resolve().name


@dataclass(frozen=True)
class JudgedHazard:
    """A hazard with what its runs say.

    Attributes:
        hazard: As the budget states it.
        runs: Those that it names.
        factors: ``None`` where P(violation), or what harm is read from, is not known.
        unknown: Why, in words.
    """

    hazard: Hazard
    runs: tuple[EvidenceRun, ...]
    factors: HazardFactors | None
    unknown: str = ""


@dataclass(frozen=True)
class JudgedBudget:
    """A budget, and whether it is met.

    Attributes:
        path: Its file.
        digest: SHA-256 of the file.
        budget: What it states.
        hazards: In its order.
        risk: What the hazards that are known add up to; ``None`` where none is.
        effects: What knowing each of their factors would do, the one that decides first.
        cautions: What a reader must not miss.
    """

    path: Path
    digest: str
    budget: RiskBudget
    hazards: tuple[JudgedHazard, ...]
    risk: Risk | None
    effects: tuple[FactorEffect, ...]
    cautions: tuple[str, ...]

    @property
    def outcome(self) -> Outcome:
        """Not met as soon as what is known reaches too high, else only known if all of it is."""
        accepted = self.budget.accepted_harm_per_hour
        if self.risk is not None and self.risk.harm_per_hour.high > accepted:
            return "not met"
        is_known = all(one.factors is not None for one in self.hazards)
        return "met" if is_known and self.risk is not None else "not known"


def judge_budget(path: Path) -> JudgedBudget:
    """Read a budget and its run folders, which are seen from its own folder.

    Raises:
        InputError: It cannot be read, or a run that it names cannot be, or does not fit it.
    """
    budget = load_budget(path)
    read: dict[Path, RunResult] = {}
    hazards = tuple(
        _judged(one, where=f"budget {path}: hazards[{place}]", beside=path.parent, read=read)
        for place, one in enumerate(budget.hazards)
    )
    known = [one.factors for one in hazards if one.factors is not None]
    draws = Draws()
    return JudgedBudget(
        path=path,
        digest=file_digest(path),
        budget=budget,
        hazards=hazards,
        risk=combine(known, draws) if known else None,
        effects=effects(known, draws),
        cautions=tuple(_cautions(hazards)),
    )


def _judged(
    hazard: Hazard, *, where: str, beside: Path, read: dict[Path, RunResult]
) -> JudgedHazard:
    runs = tuple(_evidence(beside / name, hazard, where=where, read=read) for name in hazard.runs)
    unknown = "; ".join(f"run {one.name}: {one.unknown}" for one in runs if one.unknown)
    if unknown:
        return JudgedHazard(hazard, runs, None, unknown)
    violation = _violation(hazard, runs)
    harm = _harm(hazard, runs, where=where)
    if isinstance(harm, str):
        return JudgedHazard(hazard, runs, None, harm)
    factors = HazardFactors(hazard.name, _encounters(hazard.encounters), violation, harm)
    return JudgedHazard(hazard, runs, factors)


def _evidence(
    folder: Path, hazard: Hazard, *, where: str, read: dict[Path, RunResult]
) -> EvidenceRun:
    if not folder.is_dir():
        message = f"{where}.runs: {folder}: there is no such folder"
        raise InputError(message)
    if folder not in read:
        read[folder] = read_whole_run(folder)
    result = read[folder]
    if result.driven is not None:
        message = (
            f"{where}.runs: {folder}: a rollout there is {result.driven.mean_km:.3g} km of "
            "traffic, no encounter; state violation instead"
        )
        raise ConfigError(message)
    answer = _answer(result, hazard.rule, where=f"{where}.rule")
    return EvidenceRun(folder, result, answer, _unknown(result, answer, hazard))


def _answer(result: RunResult, rule: str | None, *, where: str) -> Answer | None:
    """The run's answer to a rule.

    Raises:
        ConfigError: It has no such rule, or several and none is named.
    """
    names = [one.name for one in result.config.rules]
    if rule is None and len(names) > 1:
        message = f"{where}: is missing: run {result.run_id} has {', '.join(names)}, {ANY_RULE}"
        raise ConfigError(message)
    if rule not in (None, ANY_RULE, *names):
        allowed = ", ".join((*names, ANY_RULE)) if names else f"{ANY_RULE}, or left out"
        message = f"{where} = {rule!r}: run {result.run_id} has {allowed}"
        raise ConfigError(message)
    found = answers(result)
    of_rule = [one for one in found if one.rule is not None and one.rule.name == rule]
    return next(iter(of_rule), found[-1] if found else None)


def _unknown(result: RunResult, answer: Answer | None, hazard: Hazard) -> str:
    """Why an answer bounds nothing; empty where it does."""
    if result.status != "done" or answer is None:
        return f"the run {result.status}" if result.status != "done" else "it has no estimate"
    estimate, source = answer.estimate, answer.open.decided_by
    why = ""
    if answer.impossible:
        why = "nothing that it simulates can break the rule, so it says nothing of it"
    elif answer.caveats:
        why = f"the sampling does not hold: {answer.caveats[0]}"
    elif estimate.ci_high is None:
        why = "it has no upper end"
    elif estimate.confidence != CONFIDENCE:
        why = f"its interval is a {estimate.confidence:.0%} one, a budget takes 95 %"
    elif hazard.uncertainty == "all" and answer.open.high is None:
        why = f"how high is not known: {source.name}, not looked at ({source.narrowed_by})"
    return why


def _violation(hazard: Hazard, runs: Sequence[EvidenceRun]) -> Factor:
    """P(violation): of several runs the highest upper end and the lowest lower one."""
    if hazard.violation is not None:
        return _probability(hazard.violation, kind="violation")
    found = [_of_run(one, hazard) for one in runs]
    highest = max(found, key=lambda one: float(one.upper.at(ENDS)[1]))
    lowest = min(found, key=lambda one: float(one.lower.at(ENDS)[0]))
    if len(found) == 1:
        return found[0]
    source = "; ".join(dict.fromkeys(one.source for one in found))
    drawn_with = " ".join(one.drawn_with for one in found)
    return replace(highest, lower=lowest.lower, source=source, count=None, drawn_with=drawn_with)


def _of_run(run: EvidenceRun, hazard: Hazard) -> Factor:
    answer = run.answer
    assert answer is not None  # noqa: S101  looked at before
    sampled = replace(
        _sampled(answer.estimate, run), drawn_with=f"rollouts of {run.folder.resolve()}"
    )
    if hazard.uncertainty == "sampling":
        return sampled
    low, high = answer.open.low or 0.0, min(answer.open.high or 1.0, 1.0)
    lower: Distribution = sampled.lower
    upper: Distribution = sampled.upper
    if low < (answer.estimate.ci_low or 0.0):
        lower = Exact(low)
    if high > (answer.estimate.ci_high or 0.0):
        upper = Exact(high)
    count = sampled.count if upper is sampled.upper else None
    return replace(sampled, lower=lower, upper=upper, count=count)


def _sampled(estimate: Estimate, run: EvidenceRun) -> Factor:
    """By the sampling alone: the exact interval of a count, else what the interval says."""
    answer = run.answer
    rule = "" if answer is None or answer.rule is None else f", rule {answer.rule.name}"
    source = f"run {run.name}{rule} ({run.result.pem.digest[:8]}, {run.folder.resolve()})"
    failures, rollouts = estimate.failures, estimate.rollouts_in_estimate
    counted = by_name(estimate.method).interval_basis == "counts" and rollouts > 0
    if counted and abs(failures / rollouts - estimate.probability) <= 1e-9:
        return counted_probability(failures, rollouts, kind="violation", source=source)
    low, high = estimate.ci_low or 0.0, min(estimate.ci_high or 1.0, 1.0)
    value = min(estimate.probability, high)
    if low <= 0.0 or value <= 0.0:
        return Factor("violation", value, Exact(low), Exact(high), source)
    return stated(value, low, high, kind="violation", source=source, most=1.0)


def _encounters(rate: EncounterRate) -> Factor:
    if rate.events is not None and rate.hours is not None:
        return counted_rate(rate.events, rate.hours, source=rate.source)
    assert rate.median and rate.low and rate.high  # noqa: S101, PT018  checked when it was read
    return stated(rate.median, rate.low, rate.high, kind="encounters", source=rate.source)


def _probability(given: StatedProbability, *, kind: FactorKind) -> Factor:
    if given.events is not None and given.trials is not None:
        return counted_probability(given.events, given.trials, kind=kind, source=given.source)
    assert given.median and given.low and given.high  # noqa: S101, PT018  checked when it was read
    return stated(given.median, given.low, given.high, kind=kind, source=given.source, most=1.0)


def _harm(hazard: Hazard, runs: Sequence[EvidenceRun], *, where: str) -> AnyFactor | str:
    """P(harm | violation), or why it is not known."""
    harm = hazard.harm
    if harm.intercept is None or harm.slope is None:
        return _probability(harm, kind="harm")
    per_mps = PER_MPS[harm.speed_unit]
    of_closing = harm.share * per_mps
    curve = InjuryCurve(
        intercept=harm.intercept,
        slope=harm.slope * of_closing,
        intercept_std_error=harm.intercept_std_error,
        slope_std_error=harm.slope_std_error * of_closing,
        correlation=harm.correlation,
        source=harm.source,
    )
    if harm.impact_speed is not None:
        speeds = ImpactSpeeds((harm.impact_speed / of_closing,), (1.0,), (0.0,), (True,))
        return CurveHarm(curve, speeds, harm.source)
    return _harm_at_impacts(curve, hazard, runs, where=f"{where}.harm.impact_speed")


def _harm_at_impacts(
    curve: InjuryCurve, hazard: Hazard, runs: Sequence[EvidenceRun], *, where: str
) -> CurveHarm | str:
    """By the runs' impact speeds: of several the highest upper end and the lowest lower one."""
    found = list[CurveHarm]()
    for run in runs:
        speeds = run_impact_speeds(run, hazard.rule, where=where)
        if speeds is None:
            return f"run {run.name}: no rollout was kept that violates, so no impact speed is known"
        if speeds.hit_share == 0.0:
            return f"run {run.name}: none of its violations hits anything, which bounds no P(harm)"
        if speeds.independent < LEAST_IMPACTS:
            return (
                f"run {run.name}: its impact speeds are those of one violation by weight, or of "
                "one run of particles: how they vary, and so P(harm), is not known"
            )
        found.append(CurveHarm(curve, speeds, curve.source))
    if len(found) == 1:
        return found[0]
    ends = [one.ends(draws) for draws in (Draws(),) for one in found]
    highest = max(range(len(found)), key=lambda place: ends[place][1])
    lowest = min(range(len(found)), key=lambda place: ends[place][0])
    return replace(found[highest], lower=found[lowest].speeds)


def run_impact_speeds(run: EvidenceRun, rule: str | None, *, where: str) -> ImpactSpeeds | None:
    """Of the rollouts that violate, with their part of the estimate; ``None`` where none is kept.

    Raises:
        InputError: Rollouts were not kept, are damaged, or tell no speed of an impact.
    """
    path = run.folder / ROLLOUTS_FILE
    if not path.is_file():
        message = f"{where}: is missing: run {run.name} kept no {ROLLOUTS_FILE}"
        raise ConfigError(message)
    arrays = map_arrays(path)
    config = run.result.config
    is_braking = config.is_braking_scenario and GAP in arrays
    if IMPACT_SPEED not in arrays and not is_braking:
        message = f"{where}: is missing: rollouts of run {run.name} tell no speed of an impact"
        raise ConfigError(message)
    try:
        broken = arrays.get(f"{BROKEN}{rule}", arrays["violated"])
        rows, weight, of_run = _weights(arrays, broken, rule, run.result)
        if rows.size == 0:
            return None
        if IMPACT_SPEED in arrays:
            speed = np.array([np.max(arrays[IMPACT_SPEED][row]) for row in rows.tolist()])
            hit = speed > 0.0
        else:
            found = [first_contact(arrays[GAP][row], dt_s=config.dt_s) for row in rows.tolist()]
            speed = np.array([0.0 if one is None else one.impact_speed_mps for one in found])
            hit = np.array([one is not None for one in found])
        return impact_speeds(speed, hit=hit, weight=weight, run=of_run)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        message = f"rollouts {path}: do not fit together ({error})"
        raise InputError(message) from error


def _weights(
    arrays: Mapping[str, AnyArray], broken: AnyArray, rule: str | None, result: RunResult
) -> tuple[IntArray, FloatArray, IntArray | None]:
    """The violating rollouts that carry the estimate, and their parts of it up to a constant.

    Of particles also the run of each.
    """
    estimate = result.estimate
    assert estimate is not None  # noqa: S101  looked at before
    every = np.flatnonzero(broken)
    stages = {(one.repetition, one.stage): one for one in result.stages}
    places = list(
        zip(arrays["repetition"][every].tolist(), arrays["stage"][every].tolist(), strict=True)
    )
    if by_name(estimate.method).interval_basis == "runs":  # particles of a run have equal parts
        number = {place: n for n, place in enumerate(dict.fromkeys(places))}
        run = np.array([number[place] for place in places], dtype=np.int64)
        of_run = np.array([stages[place].probability for place in number])
        return every, (of_run / np.bincount(run, minlength=len(number)))[run], run
    own = arrays.get(f"{LOG_WEIGHT}.{rule}", arrays.get(LOG_WEIGHT))
    if own is not None:
        log_weight = np.asarray(own[every])
    else:
        final = np.array([stages[place].kind == "final" for place in places], dtype=np.bool_)
        every = every[final] if final.any() else every
        names = ["detected", "log_p", "log_q", *(n for n in arrays if n.startswith("latents."))]
        log_weight = log_weights({name: np.asarray(arrays[name][every]) for name in names})
    held = np.isfinite(log_weight)
    every, log_weight = every[held], log_weight[held]
    top = float(np.max(log_weight, initial=-np.inf))
    return every, np.exp(log_weight - top) if every.size else log_weight, None


def _curve_cautions(name: str, curve: InjuryCurve) -> Iterator[str]:
    """What is unlikely to be meant by an injury-risk curve."""
    if curve.slope < 0.0:
        yield f"{name}: the injury curve's slope is below 0: faster impacts would harm less"
    if curve.intercept_std_error == 0.0 and curve.slope_std_error == 0.0:
        yield f"{name}: the injury curve is taken as known exactly: it states no standard errors"


def _cautions(hazards: Sequence[JudgedHazard]) -> Iterator[str]:
    """What the sum takes for granted though the runs say otherwise."""
    folders: dict[Path, list[str]] = {}
    models = dict[str, str]()
    for one in hazards:
        name = one.hazard.name
        for run in one.runs:
            folders.setdefault(run.folder.resolve(), []).append(name)
            models.setdefault(run.result.pem.digest, run.result.pem.name)
            own = run.result.config.encounters_per_hour
            if own is not None and one.factors is not None:
                low, high = one.factors.encounters.ends(Draws())
                if not low <= own <= high:
                    yield (
                        f"{name}: run {run.name} was made for {own:g} encounters an hour, which is "
                        f"outside of the budget's {low:.3g} to {high:.3g}"
                    )
        if isinstance(harm := (one.factors and one.factors.harm), CurveHarm):
            yield from _curve_cautions(name, harm.curve)
            share, worth = harm.speeds.hit_share, harm.speeds.independent
            if worth < FEW_IMPACTS:
                yield (
                    f"{name}: P(harm) is that of few violations, as good as {worth:.1f} "
                    "independent ones: its interval may be too narrow"
                )
            if share < 0.995:
                yield (
                    f"{name}: {1.0 - share:.0%} of the violations hit nothing, and count as "
                    "without harm"
                )
        if one.hazard.uncertainty == "sampling" and one.runs:
            yield (
                f"{name}: by the sampling alone; that the error model is right, and misses hang "
                "together as assumed, is taken for granted"
            )
    for folder, names in folders.items():
        if len(names) > 1:
            yield (
                f"{' and '.join(names)} count violations of the same run {folder.name}: a rollout "
                "that breaks several rules counts several times"
            )
    if len(models) > 1:
        yield f"the hazards rest on different error models: {', '.join(models.values())}"
