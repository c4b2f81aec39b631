"""The gate, case by case, against the table that CONTRIBUTING shows."""

import re
import sys
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import get_args

import pytest

import pemviz
from pemviz.config import METHODS
from pemviz.config.rule_words import Bound, GateLimits
from pemviz.reports.gate import (
    EXIT_CODES,
    decide_gate,
    decide_limits,
    decide_run,
    raise_if_undecided,
)
from pemviz.runs.result import MeasuredAnswer, RuleAnswer, RunMemory
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.estimates.diagnostics import (
    AGREEMENT_ERRORS,
    FEW_FAILURES,
    LARGE_SHARE,
    RELIABLE_PARETO_K,
    SMALL_ESS,
    IntervalBasis,
)
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.particles.estimate import (
    FEW_RUNS,
    LARGE_COMMON_ANCESTRY,
    LARGE_MEAN_ERROR,
    LARGE_SPREAD,
    WIDE_FACTOR,
    largest_spread,
)
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Diagnostic, DiagnosticKind
from tests.reports.runs import estimate, result

CONTRIBUTING = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"
BASES = (*get_args(IntervalBasis), "no interval")
"""What a method's interval rests on; the last: its description says that it is none."""
KINDS = (None, *get_args(DiagnosticKind))
LIMIT = 1e-9
UPPER = {"not above": LIMIT, "above": 1.001 * LIMIT, "unknown": None}


def table():
    """Header and rows of the table under 'The gate'."""
    section = CONTRIBUTING.read_text(encoding="utf-8").split("\n## The gate\n")[1]
    section = section.split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return header, rows


def basis_of(method):
    described = by_name(method)
    return "no interval" if described.interval_caveat else described.interval_basis


def methods_of(basis):
    return [name for name in METHODS.names() if basis_of(name) == basis]


def wrong(*kinds):
    """Diagnostics of these kinds; ``None`` is nothing wrong."""
    return tuple(Diagnostic(kind, 1.0, 2.0, f"{kind}!") for kind in kinds if kind is not None)


def test_contributing_shows_every_decision():
    """What stands there is the exit code where the upper bound is not above the limit."""
    header, rows = table()
    shown = {
        (basis, None if kind == "none" else kind.strip("`")): int(code)
        for kind, _, *codes in rows
        for basis, code in zip(BASES, codes, strict=True)
    }
    assert set(shown) == set(product(BASES, KINDS))
    for method, kind in product(METHODS.names(), KINDS):
        one = estimate(method=method, ci_high=LIMIT, diagnostics=wrong(kind))
        assert decide_gate(one, limit=LIMIT).exit_code == shown[basis_of(method), kind]
    for basis, column in zip(BASES, header[2:], strict=True):
        assert column.startswith(basis)
        assert sorted(re.findall(r"`([\w-]+)`", column)) == sorted(methods_of(basis))


def test_contributing_states_the_limits():
    _, rows = table()
    words = {kind.strip("`"): what for kind, what, *_ in rows}
    assert f"below {SMALL_ESS:g}" in words["few-effective-samples"]
    assert f"above {RELIABLE_PARETO_K:g}" in words["heavy-tail"]
    assert f"over {100 * LARGE_SHARE:g} %" in words["large-weight"]
    assert f"below {sys.float_info.min:.2g}" in words["below-doubles"]
    assert f"above {LARGE_SPREAD:g}" in words["runs-differ"]
    assert f"{100 * LARGE_MEAN_ERROR:g} %" in words["runs-differ"]
    assert f"{largest_spread(5):.2f} with five" in words["runs-differ"]
    assert f"{largest_spread(10):.2f} with ten" in words["runs-differ"]
    assert f"over {100 * LARGE_COMMON_ANCESTRY:g} %" in words["few-ancestors"]
    assert f"factor of {WIDE_FACTOR:g}" in words["wide-interval"]
    assert (FEW_FAILURES, FEW_RUNS, AGREEMENT_ERRORS) == (10, 5, 3.0)  # in words there


def test_the_codes_are_those_of_the_contract():
    assert EXIT_CODES == {"passed": 0, "tripped": 1, "undecided": 4}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", METHODS.names())
def test_every_method_with_every_diagnostic(method, kind):
    """A bound above the limit trips; it passes only if it is a 95 % bound, and there is one."""
    for bound, upper in UPPER.items():
        one = estimate(method=method, ci_high=upper, diagnostics=wrong(kind))
        caveats, found = interval_caveats(one), decide_gate(one, limit=LIMIT)
        expected = {"above": "tripped", "unknown": "undecided"}.get(
            bound, "undecided" if caveats else "passed"
        )
        assert found.outcome == expected
        assert found.exit_code == EXIT_CODES[found.outcome]
        if bound == "above":
            assert found.reason == f"{bound_words(upper, caveats)} is above {LIMIT:g}"
        elif expected == "passed":
            assert found.reason == f"{bound_words(upper, caveats)} is not above {LIMIT:g}"
        else:
            assert found.reason.endswith("; ".join(caveats) or "there is no upper bound")


def bound_words(upper, caveats):
    """A bound is never called a 95 % bound that is none."""
    if not caveats:
        return f"the upper 95 % bound {upper:.3g}"
    return f"the upper bound {upper:.3g} (not a 95 % bound: {'; '.join(caveats)})"


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_of_several_diagnostics_the_least_favourable_decides(first, second):
    for method, upper in product(("monte-carlo", "mixture", "splitting", "subset"), UPPER.values()):
        alone = [
            decide_gate(
                estimate(method=method, ci_high=upper, diagnostics=wrong(kind)), limit=LIMIT
            ).exit_code
            for kind in (first, second)
        ]
        both = estimate(method=method, ci_high=upper, diagnostics=wrong(first, second))
        assert decide_gate(both, limit=LIMIT).exit_code == max(alone)


def test_a_description_that_says_nothing_is_judged_by_the_strictest_column():
    """What another package's method does not say to be exact is not taken for exact."""
    (basis,) = (f.default for f in fields(MethodDescription) if f.name == "interval_basis")
    for kind in KINDS:
        codes = {
            one: decide_gate(
                estimate(method=methods_of(one)[0], ci_high=LIMIT, diagnostics=wrong(kind)),
                limit=LIMIT,
            ).exit_code
            for one in (basis, "counts")
        }
        assert codes[basis] == max(codes.values())


def test_an_interval_that_is_called_none_never_passes():
    """The paper's method by itself: 6.8e-20 at a truth of 8.7e-15, with good diagnostics."""
    one = estimate(method="adaptive", ci_high=1e-19)
    found = decide_gate(one, limit=1e-17)
    assert (found.outcome, found.exit_code) == ("undecided", 4)
    assert "a quarter to a third" in found.reason


@pytest.mark.parametrize("status", ["stopped", "failed"])
def test_a_run_that_did_not_finish_decides_nothing(status):
    found = decide_run(result(status=status, message="the disk is full"), limit=1.0)
    assert (found.outcome, found.exit_code) == ("undecided", 3)
    assert "the disk is full" in found.sentence


def test_a_run_without_an_estimate_decides_nothing():
    found = decide_run(replace(result(), estimate=None), limit=1.0)
    assert (found.outcome, found.exit_code) == ("undecided", 4)


def test_an_estimate_that_the_reference_contradicts_decides_nothing():
    """2e-15 +- 1e-15, up to 5e-15: six errors from the one reference, within one of the other."""
    far = Reference(probability=8e-15, std_error=0.0, log10_probability=-14.1)
    near = Reference(probability=3e-15, std_error=0.0, log10_probability=-14.5)
    one = estimate(method="mixture")
    contradicted = decide_run(result(one, reference=far), limit=LIMIT)
    assert (contradicted.outcome, contradicted.exit_code) == ("undecided", 4)
    assert "trust the reference" in contradicted.reason
    assert decide_run(result(one, reference=near), limit=LIMIT).exit_code == 0
    assert decide_run(result(one, reference=None), limit=LIMIT).exit_code == 0
    assert decide_run(result(one, reference=far), limit=4e-15).exit_code == 1


def test_a_rule_of_a_run_that_the_reference_contradicts_never_passes():
    far = Reference(probability=8e-15, std_error=0.0, log10_probability=-14.1)
    one, limits = estimate(method="mixture"), GateLimits(None, {"gap": LIMIT})
    rules = (RuleAnswer(name="gap", formula="always (gap >= 2)", estimate=one),)
    for reference, code in ((None, 0), (far, 4)):
        run = replace(result(one, reference=reference), rules=rules)
        assert decide_limits(run, limits=limits).exit_code == code
    tripped = GateLimits(None, {"gap": 4e-15})
    assert decide_limits(run, limits=tripped).exit_code == 1


def test_a_program_is_ended_with_the_reason_where_nothing_may_be_decided():
    raise_if_undecided(result(estimate(method="mixture", ci_high=2e-6)))
    spoiled = estimate(method="mixture", ci_high=2e-6, diagnostics=wrong("heavy-tail"))
    rule = RuleAnswer("gap", "always (gap >= 2)", spoiled)
    for one, words in (
        (result(spoiled), "Pareto k-hat"),
        (result(estimate(method="mixture", ci_high=None)), "no upper bound"),
        (replace(result(), estimate=None), "no estimate"),
        (result(estimate(method="mixture", ci_high=2e-6), status="failed"), "the run failed"),
        (result(estimate(method="mixture", ci_high=2e-6), rules=(rule,)), "rule gap: "),
    ):
        with pytest.raises(pemviz.UndecidedError, match=words):
            raise_if_undecided(one)


def measured(high):
    return MeasuredAnswer("RRC", CurvePoint(0.25, 1e-14, low=2e-15, high=high, ess=400.0))


def without_other_doubts(run):
    return replace(run, data_bound=None, pem_interval=None, model_classes=(), reference=None)


def remembering(*, high, **changes):
    """A sound answer of independent misses whose memory of misses, as measured, is looked at."""
    memory = RunMemory(tau_s=0.0, measured=(measured(high),))
    return result(estimate(method="mixture"), memory=memory, **changes)


@pytest.mark.parametrize(
    ("run", "limit", "codes", "words"),
    [
        (remembering(high=2e-10), LIMIT, (0, 0), "not above"),
        (remembering(high=2e-8), LIMIT, (0, 1), "at most 2.0e-08"),
        (remembering(high=2e-8), 1e-15, (1, 1), "is above"),
        (result(estimate(method="mixture"), memory=None), LIMIT, (0, 4), "not known"),
        (result(estimate(method="adaptive")), LIMIT, (4, 4), "a quarter to a third"),
        (remembering(high=2e-10, status="failed"), LIMIT, (3, 3), "the run failed"),
    ],
)
def test_a_gate_judges_all_that_leaves_the_answer_open_if_asked(run, limit, codes, words):
    run = without_other_doubts(run)
    on_sampling, on_all = (
        decide_limits(run, limits=GateLimits(limit, bound=bound)) for bound in get_args(Bound)
    )
    assert (on_sampling.exit_code, on_all.exit_code) == codes
    assert words in on_all.reason
    differ = codes[0] == 0 != codes[1]
    assert ("but to act on" in on_sampling.reason) == differ  # a pass never hides it


def test_a_rule_is_judged_by_its_own_upper_end():
    run = remembering(high=2e-8)
    one = RuleAnswer(
        "gap", "always (gap >= 2)", estimate(method="mixture"), measured=(measured(2e-10),)
    )
    run = replace(without_other_doubts(run), rules=(one,))
    for limits, code in (({"gap": LIMIT}, 0), ({"gap": 1e-10}, 1)):
        decided = decide_limits(run, limits=GateLimits(None, limits, "act-on"))
        assert decided.exit_code == code
        assert decided.reason.startswith("rule gap: to act on: at most 2.0e-10")
