"""Which starts are dangerous: against a scenario whose answer is known in closed form."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

import pemviz
from pemviz import LatentCounts, Signal, StateBatch, figures, quantiles
from pemviz.analysis.starts import SHARES, WeightedStarts, all_starts, violating_starts
from pemviz.charts.svg import svg
from pemviz.errors import InputError
from pemviz.reports.causes_words import starts_line, starts_table
from pemviz.reports.charts import starts_chart
from pemviz.reports.html import clicks_to
from pemviz.runs.result_file import result_document, result_from_document

EDGE, MISSED = 1.0, 0.3
SPEC = "always[0,1] (left >= 0.0)"
TRUTH = MISSED * stats.norm.sf(EDGE)


@dataclass(frozen=True)
class Edge:
    """Violated if it starts beyond the edge and the one outcome is a miss."""

    name: str = "edge"
    states: int = 2
    dt_s: float = 1.0
    signals: tuple[Signal, ...] = (
        Signal(name="left", key="left_m", unit="m", low=-10.0, high=10.0),
        Signal(name="place", key="place_m", unit="m", low=-10.0, high=10.0),
        Signal(name="width", key="width_m", unit="m", low=0.0, high=10.0),
    )
    latents = LatentCounts(start=2)
    starts = (
        Signal(name="place", key="place_m", unit="m", low=-4.0, high=4.0),
        Signal(name="width", key="width_m", unit="m", low=0.0, high=10.0),
    )
    start_plane = ("place", "width")

    def start_values(self, start):
        return {
            "place": start[:, 0].copy(),
            "width": quantiles.normal(start[:, 1], mean=5.0, sd=2.0),
        }

    def initial(self, *, count, start):
        signals = {"left": np.ones(count), **self.start_values(start)}
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=signals)

    def step(self, states, detected):
        left = np.where(detected, 1.0, EDGE - states.signals["place"])
        return StateBatch(step=states.step + 1, signals={**states.signals, "left": left})

    def salient(self, signals):
        return signals["place"][..., None]


class Blind:
    def logit(self, salient):
        return np.full(salient.shape[:-1], np.log((1.0 - MISSED) / MISSED))


def run(method, *, seed=3, rules=(), **settings):
    config = pemviz.ExperimentConfig(method=method, spec=SPEC, seed=seed, **settings)
    config = config.with_rules(dict(rules))
    experiment = pemviz.build_experiment(config, simulator=Edge(), pem=Blind())
    return pemviz.run(experiment)


SIZES = {
    "monte-carlo": {"final_rollouts": 20_000},
    "naive": {"final_rollouts": 8_000},
    "mixture": {"rollouts": 400, "stages": 4, "final_rollouts": 4_000},
    "splitting": {"rollouts": 1_000, "stages": 5},
    "subset": {"rollouts": 2_000, "stages": 5},
}


@pytest.mark.parametrize("method", SIZES)
def test_starts_of_violations_are_a_truncated_normal(method):
    """Each share within 4.5 standard errors, copies counted as one: 24 comparisons, 2e-4 in all.

    Where it starts is a normal cut off at the edge; how wide, what it is for all starts.
    """
    result = run(method, **SIZES[method])
    (found,) = result.starts
    probability = 10.0**found.log10_probability
    assert probability == pytest.approx(result.estimate.probability, rel=1e-9)
    assert found.effective > 100.0
    assert found.effective <= found.violations + 1e-6
    of = (stats.truncnorm(EDGE, np.inf), stats.norm(5.0, 2.0))
    for value, truth in zip(found.values, of, strict=True):
        for share, quantile in zip(SHARES, value.violations, strict=True):
            error = np.sqrt(share * (1.0 - share) / found.effective)
            assert abs(truth.cdf(quantile.value) - share) < 4.5 * error
            assert quantile.low <= quantile.value <= quantile.high
    place, width = found.values
    assert place.shift == pytest.approx(stats.norm.ppf(1.0 - 0.5 * stats.norm.sf(EDGE)), abs=0.15)
    assert abs(width.shift) < 4.5 * 1.2533 / np.sqrt(found.effective)
    assert starts_line(found).startswith("Violations start with place 1.4")


def test_the_map_is_the_probability_given_the_start():
    """Half a reach inside of the edge it is P(missed), beyond it nothing is told.

    A cell rests on ten effective violations at least; the median of all over the plane, which hang
    together, is within 15 %: more than 4 standard errors of some hundred independent violations.
    """
    result = run("monte-carlo", final_rollouts=40_000)
    plane = result.starts[0].plane
    centres = np.linspace(plane.across_low, plane.across_high, len(plane.log10_probability[0]))
    told = np.array(
        [[np.nan if v is None else 10.0**v for v in r] for r in plane.log10_probability]
    )
    inside = told[:, centres > EDGE + plane.across_reach]
    assert np.count_nonzero(np.isfinite(inside)) > 50
    assert np.nanmedian(inside) == pytest.approx(MISSED, rel=0.15)
    assert np.nanmax(told) < 3.0 * MISSED
    assert np.isnan(told[:, centres < EDGE - plane.across_reach]).all()


def test_all_starts_are_what_the_scenario_draws():
    drawn = all_starts(Edge())
    for share in (1e-4, 0.1, 0.5, 0.9, 1.0 - 1e-4):
        expected = stats.norm.ppf(share)
        error = np.sqrt(share * (1.0 - share) / 10_000) / stats.norm.pdf(expected)
        assert drawn.quantiles("place", [share])[0] == pytest.approx(expected, abs=4.5 * error)


def test_intervals_of_quantiles_hold_in_as_many_cases_as_they_claim():
    """400 samples with uneven weights; 95 % within 4 standard errors, 6e-5."""
    generator, held = np.random.default_rng(5), 0
    for _ in range(400):
        values = generator.standard_normal(150)
        share = generator.exponential(size=150)
        low, high = WeightedStarts({"z": values}, share / share.sum()).interval("z", 0.5)
        held += low <= 0.0 <= high
    assert abs(held / 400 - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 400)


def test_copies_of_a_start_count_as_one():
    latents = np.repeat(np.random.default_rng(1).standard_normal((3, 2)), 40, axis=0)
    found = violating_starts(Edge(), latents=latents, log_share=np.zeros(120))
    assert found.effective == pytest.approx(3.0)


def test_each_rule_has_its_own_and_a_file_keeps_them():
    rules = {"left": SPEC, "wide": "always[0,1] (width <= 9.0)"}
    result = run("monte-carlo", final_rollouts=5_000, rules=rules)
    assert [found.rule for found in result.starts] == [None, "left", "wide"]
    wide = result.starts[2]
    assert wide.shifted()[0].name == "width"
    document = json.loads(json.dumps(result_document(result)))
    assert result_from_document(document).starts == result.starts
    assert svg(starts_chart(wide)).startswith("<svg")
    first = result.starts[0]
    picture = svg(starts_chart(first), act=clicks_to("number"))
    assert picture.count("data-number=") > 0.9 * len(first.points)
    assert "data-target='number'" in picture
    point = first.points[0]
    assert (point.stage, point.repetition) == (0, 0)


def test_too_few_violations_tell_nothing():
    (found,) = run("monte-carlo", final_rollouts=100).starts
    assert found.effective < 10.0
    assert found.plane is None
    assert starts_chart(found) is None
    assert "is not known from" in starts_line(found)
    assert starts_table(found).rows[0][3:] == ("-", "-", "-")
    with pytest.raises(InputError, match="starts: the run does not tell"):
        figures.starts(result=run("monte-carlo", final_rollouts=100))


def test_a_scenario_that_names_none_tells_none():
    config = pemviz.ExperimentConfig(method="naive", final_rollouts=20, measured_memory=False)
    assert "starts" not in result_document(pemviz.run_experiment(config))
