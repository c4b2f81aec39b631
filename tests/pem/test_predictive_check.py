"""Predictive checks: quantities and p-values against independent answers, false alarms, power."""

import itertools
import json
import math
from dataclasses import asdict, replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save_file
from scipy.special import logit
from scipy.stats import kstest

from pemviz.pem import Memory, PemError, load_pem
from pemviz.pem.fitting.memory import (
    FRAILTY_GRID,
    TAU_GRID_S,
    Surface,
    memory_surface,
    nested_memories,
)
from pemviz.pem.judging.memory_report import cross_fit, sample_outcomes
from pemviz.pem.judging.predictive_check import (
    APPROACH_M,
    TrackQuantities,
    check_held_out,
    check_model,
    check_tracks,
    holm,
    p_value,
)
from pemviz.pem.model_files import METADATA_KEY, read_tensors, save_pem
from pemviz.pem.models.cards import card_markdown
from pemviz.pem.models.predictive_check import (
    CLOSE_M,
    FAMILY_WISE,
    QUANTITIES,
    CheckedQuantity,
    CheckedVariant,
    ModelCheck,
    check_from_mapping,
    check_line,
    check_table,
    verdict_lines,
    wrong_words,
)
from pemviz.pem.models.varying_frailty import VaryingFrailty
from tests.pem.helpers import shipped_file
from tests.pem.synthetic_tracks import tracks_of

Z_M = 9
"""Column of the distance ahead."""


def approaching(*, tracks, frames, sequences=1, seed=0, keep=1.0, rate_hz=10.0):
    """Tracks that come nearer by 1 to 2 m a frame from 20 to 70 m, and P(missed) in each state."""
    random = np.random.default_rng(seed)
    track = np.repeat(np.arange(tracks), frames)
    frame = np.tile(np.arange(frames), tracks)
    start_m, step_m = random.uniform(20.0, 70.0, tracks), random.uniform(1.0, 2.0, tracks)
    salient = np.zeros((track.size, 11))
    salient[:, Z_M] = np.maximum(start_m[track] - step_m[track] * frame, 3.0)
    kept = random.random(track.size) < keep
    table = tracks_of(
        np.ones(int(kept.sum())),
        sequence=track[kept] % sequences,
        track=track[kept],
        frame=frame[kept],
        rate_hz=rate_hz,
        salient=salient[kept],
    )
    return table, 3.5 - 0.05 * table.obstacles.salient[:, Z_M]


def with_outcomes(table, detected):
    return replace(table, obstacles=replace(table.obstacles, detected=detected))


def shorter_runs(n, p, k):
    """P(no k misses in a row among n), by the recursion over the first hit (Feller, XIII.7)."""
    none = [1.0] * k
    for length in range(k, n + 1):
        none.append(sum(p**j * (1 - p) * none[length - 1 - j] for j in range(k)))
    return none[n]


@pytest.mark.parametrize("p_miss", [0.1, 0.5, 0.8])
def test_longest_runs_of_all_outcomes_have_the_probabilities_of_the_recursion(p_miss):
    """A chain of 11 frames without memory: every outcome with its weight, exactly."""
    n = 11
    table = tracks_of(np.ones(n), sequence=np.zeros(n), track=np.zeros(n), frame=np.arange(n))
    outcomes = np.array(list(itertools.product((False, True), repeat=n)))
    runs = np.round(10.0 * TrackQuantities(table).longest_runs_s(outcomes)[:, 0])
    misses = np.count_nonzero(~outcomes, axis=1)
    weight = p_miss**misses * (1.0 - p_miss) ** (n - misses)
    for k in range(1, n + 1):
        assert weight[runs < k].sum() == pytest.approx(shorter_runs(n, p_miss, k), abs=1e-13)


def test_drawn_longest_runs_follow_the_recursion():
    """40,000 draws of 50 frames at P(missed) 0.3 and tau 0; 4.5 standard errors, 2e-5 of cases."""
    n, draws = 50, 40_000
    table = tracks_of(np.ones(n), sequence=np.zeros(n), track=np.zeros(n), frame=np.arange(n))
    random = np.random.default_rng(11)
    drawn = sample_outcomes(
        table, np.full(n, logit(0.7)), law=Memory(), samples=draws, random=random
    )
    runs_s = TrackQuantities(table).longest_runs_s(drawn)[:, 0]
    for k in (2, 3, 4, 6):
        expected = shorter_runs(n, 0.3, k)
        share = np.mean(runs_s < k / 10.0 - 1e-9)
        assert abs(share - expected) < 4.5 * math.sqrt(expected * (1 - expected) / draws)


def naive_quantities(table):
    """What the module says, in plain Python, row by row."""
    by_track = {}
    for row in range(len(table)):
        by_track.setdefault(int(table.track[row]), []).append(row)
    distance = np.abs(table.obstacles.salient[:, Z_M]).tolist()
    detected, frame = table.detected.tolist(), table.frame.tolist()
    longest, close, first, lasting = [], [], [], []
    after = {}
    for rows in by_track.values():
        best = run = 0.0
        before = None
        for row in rows:
            if before is None or frame[row] != frame[before] + 1:
                run = 0.0
            run = 0.0 if detected[row] else run + 1.0 / table.rate_hz[row]
            best = max(best, run)
            if before is not None:
                for low, high in ((0, 15), (15, 30), (30, 50), (50, 200)):
                    if low <= distance[row] < high:
                        name = f"after_{'hit' if detected[before] else 'miss'}_{low}_{high}"
                        after.setdefault(name, []).append(not detected[row])
            before = row
        longest.append(best)
        nearest = min(rows, key=lambda row: (distance[row], row))
        if distance[rows[0]] - distance[nearest] < APPROACH_M:
            continue
        way = [row for row in rows if row <= nearest]
        if distance[nearest] < CLOSE_M:
            close.append(sum(not detected[row] for row in way if distance[row] < CLOSE_M))
        seen = [row for row in way if detected[row]]
        first.append(distance[seen[0]] if seen else distance[nearest])
        stays = next((r for r in way if all(detected[s] for s in way if s >= r)), nearest)
        lasting.append(distance[stays])
    found = {"longest_run_s": np.mean(longest)}
    for least in (0.5, 1.0, 2.0):
        found[f"missed_{least:g}_s"] = np.mean([one >= least - 1e-9 for one in longest])
    if close:
        found["close_misses"] = np.mean(close)
    if len(close) > 1:
        found["close_misses_sd"] = np.std(close)
    if first:
        found |= {"first_m": np.mean(first), "lasting_m": np.mean(lasting)}
    return found | {name: np.mean(values) for name, values in after.items()}


@given(seed=st.integers(0, 10_000), share=st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]))
def test_quantities_are_those_of_a_naive_reference(seed, share):
    """Gaps, tracks of one frame, rates that differ between tracks, nothing or all detected."""
    random = np.random.default_rng(seed)
    table, _ = approaching(tracks=6, frames=30, seed=seed, keep=0.8)
    rows = random.random(len(table)) < random.choice([0.05, 0.5, 1.0])
    rows[0] = True
    table = table.only(rows)
    table = replace(table, rate_hz=np.array([2.0, 10.0, 12.5])[table.track % 3])
    table = with_outcomes(table, random.random(len(table)) < share)
    found = TrackQuantities(table).computed(table.detected[None]).values
    expected = naive_quantities(table)
    known = {name: value[0] for name, value in found.items() if np.isfinite(value[0])}
    assert known.keys() == expected.keys()
    for name, value in expected.items():
        assert known[name] == pytest.approx(value, abs=1e-6), name


def test_quantities_of_many_data_sets_are_those_of_each():
    table, own = approaching(tracks=8, frames=25, keep=0.9)
    drawn = sample_outcomes(table, own, law=Memory(0.2), samples=7, random=np.random.default_rng(0))
    together = TrackQuantities(table).computed(drawn)
    for row, outcomes in enumerate(drawn):
        alone = TrackQuantities(with_outcomes(table, outcomes)).computed(outcomes[None])
        for name, values in alone.values.items():
            np.testing.assert_array_equal(values[0], together.values[name][row])


def test_mid_p_values_are_those_of_all_outcomes():
    """A track of 6 frames, P(missed) 0.5: all 64 outcomes are the draws, with fractions."""
    outcomes = np.array(list(itertools.product((False, True), repeat=6)))
    runs = [
        max((len(list(g)) for k, g in itertools.groupby(o) if not k), default=0) for o in outcomes
    ]
    for observed in range(7):
        above = Fraction(sum(run > observed for run in runs), 64)
        below = Fraction(sum(run < observed for run in runs), 64)
        equal = 1 - above - below
        tail = min(above, below) + equal / 2
        expected = min(Fraction(1), 2 * (64 * tail + 1) / 65)
        assert p_value(float(observed), np.array(runs, dtype=float)) == pytest.approx(
            float(expected)
        )


def test_drawn_mid_p_values_approach_those_of_weighted_outcomes():
    """Two tracks of 3 frames, tau 0.2 s; 20,000 draws against the law itself, 5 standard errors."""
    track = np.repeat([0, 1], 3)
    table = tracks_of(np.ones(6), sequence=np.zeros(6), track=track, frame=np.tile(np.arange(3), 2))
    rho, p = math.exp(-0.5), 0.3
    outcomes = np.array(list(itertools.product((False, True), repeat=6)))
    weight = []
    for o in outcomes:
        w = 1.0
        for row, detected in enumerate(o):
            miss = p if row % 3 == 0 else p + (float(not o[row - 1]) - p) * rho
            w *= 1.0 - miss if detected else miss
        weight.append(w)
    law = TrackQuantities(table).computed(outcomes).values["longest_run_s"]
    drawn = sample_outcomes(
        table, np.full(6, logit(1 - p)), law=Memory(0.2), samples=20_000,
        random=np.random.default_rng(5),
    )  # fmt: skip
    values = TrackQuantities(table).computed(drawn).values["longest_run_s"]
    weight = np.array(weight)
    for observed in np.unique(law):
        tails = [weight[law > observed].sum(), weight[law < observed].sum()]
        mid = min(1.0, 2.0 * (min(tails) + 0.5 * weight[law == observed].sum()))
        spread = 2.0 * math.sqrt(mid / 2.0 / 20_000)
        assert abs(p_value(float(observed), values) - mid) < 5.0 * spread + 2e-4


def test_what_nothing_was_there_for_is_never_refuted():
    nothing = np.full(999, np.nan)
    assert p_value(math.nan, nothing) == 1.0
    assert p_value(0.9, nothing) == 1.0
    assert p_value(math.nan, np.linspace(0.0, 1.0, 999)) > 0.9


@given(
    st.lists(st.sampled_from([0.0005, 0.003, 0.01, 0.02, 0.04, 0.3, 1.0]), min_size=1, max_size=9)
)
def test_holm_refuses_what_a_step_by_step_reading_does(p_values):
    refused, left = set(), sorted(range(len(p_values)), key=lambda one: p_values[one])
    while left and p_values[left[0]] <= FAMILY_WISE / len(left):
        refused.add(left.pop(0))
    assert set(np.flatnonzero(holm(np.array(p_values))).tolist()) == refused


@pytest.mark.parametrize(
    "memory", [Memory(), Memory(0.2), Memory(0.2, 0.7), VaryingFrailty(0.7, 1.2, 0.3)]
)
def test_p_values_of_data_from_the_model_itself_are_uniform(memory):
    """300 data sets of 40 tracks, each with 199 draws of its own.

    Ranks among draws, ties broken at random, are uniform exactly: Kolmogorov and Smirnov's test at
    1e-4 for each of 16 quantities, of which 0.2 % would fail by chance. The two-sided p-values,
    which leave ties as they are, are at most 0.05 in at most 5 % of cases, and Holm's procedure
    refuses anything in at most 5 %: 3.5 standard deviations of so many cases above that.
    """
    cases, draws = 300, 199
    table, own = approaching(tracks=40, frames=20, sequences=4, seed=3, keep=0.95)
    quantities, random = TrackQuantities(table), np.random.default_rng(17)
    ranks, p_values = {}, {}
    for _ in range(cases):
        drawn = sample_outcomes(table, own, law=memory, samples=draws + 1, random=random)
        for name, values in quantities.computed(drawn).values.items():
            known = np.where(np.isfinite(values), values, np.nanmean(values))
            less, equal = (known[1:] < known[0]).sum(), (known[1:] == known[0]).sum()
            ranks.setdefault(name, []).append(less + random.integers(0, equal + 1))
            p_values.setdefault(name, []).append(p_value(float(values[0]), values[1:]))
    assert len(ranks) == 16
    most = 0.05 + 3.5 * math.sqrt(0.05 * 0.95 / cases)
    for name, rank in ranks.items():
        spread = (np.array(rank) + random.random(cases)) / (draws + 1)
        assert kstest(spread, "uniform").pvalue > 1e-4, name
        assert np.mean(np.array(p_values[name]) <= 0.05) <= most, name
    refused = [holm(np.array(one)).any() for one in zip(*p_values.values(), strict=True)]
    assert np.mean(refused) <= most


def test_fifty_tracks_tell_a_memory_time_of_a_fifth_of_a_second_from_independence():
    """20 data sets of 50 tracks of 2 s, tau 0.2 s: all refuse independence, none the memory more
    often than 5 % of cases allow (5 of 20 or more: 2.6e-3)."""
    table, own = approaching(tracks=50, frames=20, seed=4)
    random = np.random.default_rng(23)
    refused = {"independent": 0, "memory": 0}
    for outcomes in sample_outcomes(table, own, law=Memory(0.2), samples=20, random=random):
        check = check_tracks(
            with_outcomes(table, outcomes), own, part=np.zeros(len(table), dtype=np.int64),
            laws={"independent": [Memory()], "memory": [Memory(0.2)]}, draws=999,
        ).check  # fmt: skip
        for variant in check.variants:
            refused[variant.name] += bool(variant.refuted)
    assert refused["independent"] == 20
    assert refused["memory"] < 5


def test_copied_outcomes_that_outlive_what_is_hard_to_see_are_told_from_a_visibility():
    """Cars that come close fast, P(missed) from .97 to .02 in 2 s: 10 data sets of 150 tracks of a
    visibility refute copies with its own correlations at once, and itself at a rate of 5 %
    (4 of 10 or more: 1e-3)."""
    table, own = approaching(tracks=150, frames=20, seed=5)
    law, random = VaryingFrailty(0.3, 2.0, 0.3), np.random.default_rng(29)
    refused = {"memory": 0, "visibility": 0}
    for outcomes in sample_outcomes(table, own, law=law, samples=10, random=random):
        check = check_tracks(
            with_outcomes(table, outcomes), own, part=np.zeros(len(table), dtype=np.int64),
            laws={"memory": [Memory(0.3, 0.3)], "visibility": [law]}, draws=799,
        ).check  # fmt: skip
        for variant in check.variants:
            refused[variant.name] += bool(variant.refuted)
    assert refused["memory"] == 10
    assert refused["visibility"] < 4


def test_nested_memories_are_the_peaks_of_their_part_of_the_surface():
    table, own = approaching(tracks=60, frames=25, sequences=4)
    outcomes = sample_outcomes(
        table, own, law=Memory(0.3, 0.5), samples=1, random=np.random.default_rng(1)
    )[0]
    whole = memory_surface(with_outcomes(table, outcomes), own).sum(axis=0)
    memory, frailty, both = nested_memories(whole)
    assert memory.frailty == frailty.tau_s == 0.0
    peak = Surface(whole, TAU_GRID_S, FRAILTY_GRID)
    assert (both.tau_s, both.frailty) == (peak.tau_s, peak.frailty)
    best = FRAILTY_GRID[np.argmax(whole[0])]
    assert abs(frailty.frailty - best) <= FRAILTY_GRID[1]
    nearest = TAU_GRID_S[np.argmax(whole[:, 0])]
    assert nearest / 1.3 < memory.tau_s < nearest * 1.3


def test_held_out_parts_are_checked_in_four_variants():
    table, own = approaching(tracks=96, frames=25, sequences=12)
    outcomes = sample_outcomes(
        table, own, law=Memory(0.3), samples=1, random=np.random.default_rng(2)
    )[0]
    table = with_outcomes(table, outcomes)
    held_out = cross_fit(table, model="lr", folds=4)
    told = []
    check = check_held_out(
        table, held_out, memory_surface(table, held_out.logit),
        on_progress=lambda done, total: told.append((done, total)),
    ).check  # fmt: skip
    assert [one.name for one in check.variants] == ["independent", "memory", "frailty", "both"]
    assert (check.tracks, check.sequences, check.folds) == (96, 12, 4)
    assert check.variants[0].refuted
    assert not check.variants[1].refuted  # a right kind of model, at a rate of 5 % or less
    assert told[-1][0] == told[-1][1] == len(told) == 4 * 3


def test_a_visibility_that_comes_and_goes_is_a_fifth_variant():
    table, own = approaching(tracks=40, frames=20, sequences=4)
    law, random = VaryingFrailty(0.5, 1.5, 0.4), np.random.default_rng(3)
    [outcomes] = sample_outcomes(table, own, law=law, samples=1, random=random)
    table = with_outcomes(table, outcomes)
    held_out = cross_fit(table, model="lr", folds=2)
    laws = (VaryingFrailty(0.4, 1.4, 0.4), VaryingFrailty(0.6, 1.8, 0.6))
    check = check_held_out(
        table, held_out, memory_surface(table, held_out.logit), visibilities=laws, draws=799
    ).check
    *others, own_law = check.variants
    assert (own_law.name, own_law.tau_s, own_law.frailty) == ("visibility", 0.0, 0.5)
    assert (own_law.varying, own_law.varying_s) == (pytest.approx(1.6), 0.5)
    assert not any(one.varying or one.varying_s for one in others)
    said = verdict_lines(check)[-1]
    assert said.startswith(
        "With visibility that comes and goes (time-varying frailty 1.60 over 0.50 s, lasting "
        "frailty 0.50) the model reproduces"
    )
    alone = check_held_out(table, held_out, memory_surface(table, held_out.logit), draws=799).check
    assert alone.variants == tuple(others)  # each has random numbers of its own
    assert check_from_mapping(json.loads(json.dumps(check_table(check))), where="card") == check


def test_a_card_of_before_says_nothing_of_what_comes_and_goes():
    table = check_table(made_check(CheckedVariant("both", 0.2, 0.5, ())))
    for variant in table["variants"]:
        del variant["varying"], variant["varying_s"]
    [variant] = check_from_mapping(table, where="card").variants
    assert (variant.varying, variant.varying_s) == (0.0, 0.0)


def test_the_same_seed_gives_the_same_check():
    table, own = approaching(tracks=10, frames=20)
    settings = {"part": np.zeros(len(table), dtype=np.int64), "draws": 799}
    laws = {"independent": [Memory()], "both": [Memory(0.2, 0.5)]}
    first, again = (check_tracks(table, own, laws=laws, **settings) for _ in range(2))
    assert first.check == again.check
    alone = check_tracks(table, own, laws={"independent": [Memory()]}, **settings)
    assert alone.check.variants[0] == first.check.variants[0]


@pytest.mark.parametrize("seen", [True, False])
def test_a_table_in_which_all_or_nothing_is_detected(seen):
    """Where the model says that about half is missed each is refuted, and nothing breaks."""
    table, own = approaching(tracks=12, frames=20)
    table = with_outcomes(table, np.full(len(table), seen))
    check = check_tracks(
        table, np.zeros_like(own), part=np.zeros(len(table), dtype=np.int64),
        laws={"both": [Memory(0.2, 0.5)]},
    ).check  # fmt: skip
    by_name = {one.name: one for one in check.variants[0].quantities}
    assert by_name["longest_run_s"].refuted
    assert by_name["after_miss_15_30"].observed == (None if seen else 1.0)
    assert by_name["after_hit_15_30"].observed == (0.0 if seen else None)
    if seen:
        assert "there were none" in check_line(check)


def test_tracks_of_one_frame_without_places():
    n = 30
    table = tracks_of(
        np.arange(n) % 3 > 0, sequence=np.zeros(n), track=np.arange(n), frame=np.zeros(n)
    )
    table = replace(table, has_state=False)
    check = check_tracks(
        table, np.full(n, logit(2 / 3)), part=np.zeros(n, dtype=np.int64),
        laws={"independent": [Memory()], "both": [Memory(0.5, 0.5)]},
    ).check  # fmt: skip
    names = [one.name for one in check.variants[0].quantities]
    assert names == ["longest_run_s", "missed_0.5_s", "missed_1_s", "missed_2_s"]
    assert check.approaching == 0
    assert not check.variants[1].refuted


def test_a_model_with_a_memory_of_nothing_is_its_independent_self():
    table, own = approaching(tracks=10, frames=20)
    drawn = check_tracks(
        table, own, part=np.zeros(len(table), dtype=np.int64),
        laws={"independent": [Memory()], "both": [Memory(0.0, 0.0)]},
    ).check.variants  # fmt: skip
    for one, other in zip(drawn[0].quantities, drawn[1].quantities, strict=True):
        assert other.expected == pytest.approx(one.expected, rel=0.1, abs=0.05)


def test_too_few_draws_are_refused():
    table, own = approaching(tracks=3, frames=5)
    with pytest.raises(PemError, match="draws is 99, allowed: 799 to 100,000"):
        check_tracks(table, own, part=np.zeros(len(table), dtype=np.int64), laws={}, draws=99)


def quantity(name, observed, expected, *, refuted=True):
    return CheckedQuantity(name, observed, expected, 0.0, 1.0, 0.002, refuted)


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (
            quantity("missed_1_s", 0.06, 0.02),
            "runs of misses of 1 s or more too rare by a factor 3",
        ),
        (quantity("missed_1_s", 0.01, 0.04), "1 s or more too frequent by a factor 4"),
        (quantity("missed_2_s", 0.02, 0.0), "2 s or more too rare: it never has any"),
        (quantity("missed_2_s", 0.0, 0.02), "2 s or more too frequent: there were none"),
        (quantity("first_m", 42.0, 45.5), "distance of first detection too large by 3.5 m"),
        (
            quantity("close_misses", 2.0, 1.0),
            "misses within 40 m on approach too few by a factor 2",
        ),
    ],
)
def test_a_verdict_says_what_is_wrong_and_by_how_much(one, words):
    assert wrong_words(one).endswith(words)


def made_check(*variants, **others):
    settings = {"tracks": 489, "approaching": 200, "sequences": 18, "observations": 22_179,
                "draws": 999, "folds": 5, "same_data": False}  # fmt: skip
    return ModelCheck(**settings | others, variants=variants)


def test_an_answer_says_in_a_line_what_its_model_gets_wrong():
    runs = quantity("missed_1_s", 0.06, 0.02)
    after = quantity("after_miss_0_15", 0.8, 0.1)
    far = quantity("first_m", 40.0, 44.0)
    variant = CheckedVariant("both", 0.25, 0.7, (far, after, runs))
    assert check_line(made_check(variant)) == (
        "this error model was checked on 489 tracks; with its memory time and frailty it gets runs "
        "of misses of 1 s or more too rare by a factor 3, and 2 more of 3 quantities wrong"
    )
    right = replace(variant, quantities=(replace(runs, refuted=False),))
    assert check_line(made_check(right)).endswith("frailty none of 1 quantities is refuted")
    assert "not with a memory of misses as this answer assumes" in check_line(made_check())
    assert "that it was fitted to" in check_line(made_check(right, same_data=True))


def test_a_check_stays_on_a_card_and_is_shown(tmp_path):
    check = made_check(
        CheckedVariant("independent", 0.0, 0.0, (quantity("missed_1_s", 0.06, 0.02),))
    )
    pem = load_pem("rrc")
    pem = replace(pem, card=replace(pem.card, check=check_table(check)))
    path = tmp_path / "checked.safetensors"
    save_pem(pem, path)
    again = load_pem(str(path))
    assert again.digest == load_pem("rrc").digest
    assert check_from_mapping(again.card.check, where="it") == check
    page = card_markdown(again.card, digest=again.digest)
    assert "## Predictive checks" in page
    assert "too rare by a factor 3" in page
    assert (
        "| tracks missed for 1 s or more at a time | 6 % | 2 % (0 to 100), p 0.002: refuted |"
        in page
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tracks": -1}, "metadata field check.tracks"),
        ({"variants": 3}, "metadata field check.variants"),
        ({"variants": [{"name": "other"}]}, "metadata field check.variants"),
        ({"more": 1}, "metadata field check"),
    ],
)
def test_a_damaged_check_is_refused_in_one_line(tmp_path, change, words):
    tensors, metadata = read_tensors(shipped_file("rrc"))
    header = json.loads(metadata[METADATA_KEY])
    header["card"]["check"] = asdict(made_check()) | change
    path = tmp_path / "damaged.safetensors"
    save_file(tensors, path, metadata={METADATA_KEY: json.dumps(header)})
    with pytest.raises(PemError, match=words) as caught:
        load_pem(str(path))
    assert "\n" not in str(caught.value)


def test_a_fitted_model_is_checked_with_what_its_card_knows():
    table, _ = approaching(tracks=10, frames=20)
    table = with_outcomes(table, np.arange(len(table)) % 9 > 0)
    shipped = load_pem("rrc")
    bare = replace(shipped, card=replace(shipped.card, check={}))
    found = {
        name: [one.name for one in check_model(table, pem, draws=799).check.variants]
        for name, pem in (("ml-nn", load_pem("ml-nn")), ("bare", bare), ("rrc", shipped))
    }
    assert found["ml-nn"] == ["independent"]
    assert found["bare"] == ["independent", "both"]
    assert found["rrc"] == ["independent", "memory", "frailty", "both"]
    law = VaryingFrailty(0.5, 1.5, 0.4)
    varying = {"law": asdict(law), "nats": 0.2, "better_by": 0.1, "better_by_std_error": 0.1}
    card = replace(shipped.card, memory={**shipped.card.memory, "varying": varying})
    last = check_model(table, replace(shipped, card=card), draws=799).check.variants[-1]
    assert (last.name, last.frailty, last.varying, last.varying_s) == ("visibility", 0.5, 1.5, 0.4)


def test_every_quantity_has_words():
    for one in QUANTITIES.values():
        assert one.title[0].islower()
        assert one.less != one.more
