"""Violations a kilometre: the probability over the distance of a rollout, in every place."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.latents import LatentCounts
from pemviz.recording.text import answer_text
from pemviz.reports.answer_words import rate_line, rates_table
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.notebook import result_html
from pemviz.reports.safety_case import safety_case_page
from pemviz.reports.terminal import print_summary, summary_text
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.rates import distance_rates, violation_rates
from pemviz.runs.result import DrivenDistance
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.sampling.rollouts.simulate import NormalSource
from pemviz.types import Signal, StateBatch
from tests.reports.runs import estimate
from tests.reports.runs import result as made_up

KNOWN = {"probability": 0.02, "ci_low": 0.01, "ci_high": 0.04, "log10_probability": -1.69897}


def driven(std_error_km=0.0, **changes):
    one = estimate(**{"method": "mixture", "diagnostics": (), **KNOWN, **changes})
    distance = DrivenDistance(mean_km=0.2, std_error_km=std_error_km, rollouts=200)
    return replace(made_up(one), config=ExperimentConfig(), reference=None, driven=distance)


def test_a_known_distance_divides():
    (rate,) = distance_rates(driven())
    assert (rate.per_km, rate.low, rate.high) == pytest.approx((0.1, 0.05, 0.2))
    assert (rate.km_between, rate.km_low, rate.km_high) == pytest.approx((10.0, 5.0, 20.0))
    assert violation_rates(driven()) == ()
    assert rate_line(driven()) == (
        "With 0.2 km a rollout: 0.10 violations a kilometre (95 % interval 0.050 to 0.20), "
        "one in 10 kilometres of driving (5.0 to 20)"
    )


def test_what_is_not_known_of_the_distance_widens_the_interval():
    # log-normal factors: widths log 2 and 1.96 * 0.1 add up in squares
    (rate,) = distance_rates(driven(std_error_km=0.02))
    factor = np.exp(np.hypot(np.log(2.0), 0.196))
    assert (rate.per_km, rate.low, rate.high) == pytest.approx((0.1, 0.1 / factor, 0.1 * factor))


def test_without_a_violation_no_more_is_told_than_the_bound():
    unseen = {"probability": 0.0, "log10_probability": None, "failures": 0, "ci_low": 0.0}
    line = rate_line(driven(**unseen))
    assert line.endswith("no violation was seen; a kilometre brings 0 to 0.20 of them")
    assert rates_table(driven(**unseen)).rows[0][3:] == ("-", "at least 5.0")


def test_every_place_tells_it(capsys):
    result = driven()
    print_summary(result, Path("run"))
    case = CaseRun("run", result, card=None, digests={}, violations=None)
    pages = (
        capsys.readouterr().out, summary_markdown(result), answer_text(result, running=False),
        result_html(result), safety_case_page([case]), summary_text(result),
    )  # fmt: skip
    for page in pages:
        assert "0.050 to 0.20" in page
        assert "kilometre" in page
    document = json.loads(json.dumps(result_document(result)))
    assert document["per_km"][0]["km_between"] == pytest.approx(10.0)
    assert result_from_document(document).driven == result.driven


class Drive:
    """Drives 100 m to 300 m, drawn by its own generator, and is violated where it is missed."""

    name, states, dt_s, distance_signal = "drive", 3, 1.0, "way"
    signals = (
        Signal(name="way", key="way_m", unit="m", low=0.0, high=400.0),
        Signal(name="seen", key="seen", unit="", low=-1.0, high=1.0),
    )
    latents = LatentCounts(seeds=1)

    def initial(self, *, count, start):
        own = [np.random.default_rng(abs(int(z * 1e6))).uniform(50.0, 150.0) for z in start[:, 0]]
        way = np.zeros(count)
        signals = {"way": way, "seen": np.ones(count)}
        return StateBatch(step=np.array(0), signals=signals, memory={"each": np.array(own)})

    def step(self, states, detected):
        way = states.signals["way"] + states.memory["each"]
        signals = {"way": way, "seen": np.where(detected, 1.0, -1.0)}
        return StateBatch(step=states.step + 1, signals=signals, memory=states.memory)

    def salient(self, signals):
        return signals["seen"][..., None]


class Coin:
    """Misses one time in four."""

    def logit(self, salient):
        return np.full(salient.shape[:-1], np.log(3.0))


def driving(**changes):
    asked = {"rollouts": 60, "final_rollouts": 300, "stages": 2, "spec": "always[0,2] (seen >= 0)"}
    config = ExperimentConfig(**{**asked, **changes})
    return run(build_experiment(config, simulator=Drive(), pem=Coin()))


@pytest.mark.parametrize("method", ["mixture", "monte-carlo"])
def test_a_run_tells_how_far_it_drove(method):
    """P = 1 - 0.75^2 = 0.4375 in 0.2 km; ten standard errors: a false alarm in 10^20."""
    result = driving(method=method)
    distance = result.driven
    assert distance.mean_km == pytest.approx(0.2, abs=10.0 * distance.std_error_km)
    # uniform: a spread of 200 m / sqrt(12) in 200 rollouts
    assert distance.std_error_km == pytest.approx(0.2 / np.sqrt(12.0 * 200.0), rel=0.2)
    (rate,) = distance_rates(result)
    error = 10.0 * result.estimate.std_error / 0.2 + 10.0 * 0.4375 * distance.std_error_km / 0.04
    assert rate.per_km == pytest.approx(0.4375 / 0.2, abs=error)
    assert result.latents == LatentCounts(seeds=1)


def test_seeds_come_after_what_is_moved_and_are_the_same_for_any_batch():
    counts = LatentCounts(start=2, seeds=1)
    assert str(counts) == "2 at the start and 1 for seeds"
    at_once = NormalSource(np.random.SeedSequence(1), counts=counts, steps=3).draw(6)
    source = NormalSource(np.random.SeedSequence(1), counts=counts, steps=3)
    parts = [source.draw(count).start for count in (1, 2, 3)]
    assert at_once.start.shape == (6, 3)
    np.testing.assert_array_equal(np.concatenate(parts), at_once.start)
