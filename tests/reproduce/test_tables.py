import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from pemviz.reproduce.experiments import RepetitionOutcome
from pemviz.reproduce.published import ADAPTIVE, TABLE_2, TABLE_3
from pemviz.reproduce.tables import score_model, summarise, table_1, table_2, table_3
from pemviz.sampling.zero_variance.reference import Reference
from tests.conftest import shared
from tests.reports.runs import estimate

REFERENCE = Reference(probability=4e-15, std_error=1e-17, log10_probability=-14.39794)


def outcomes(*estimates):
    return [RepetitionOutcome(estimate=one, curves={}) for one in estimates]


def adaptive(*probabilities, failures=52):
    return outcomes(
        *(
            estimate(probability=p, log10_probability=math.log10(p), failures=failures)
            for p in probabilities
        )
    )


def none_failed(method, count, high):
    return estimate(
        method=method, probability=0.0, log10_probability=None, std_error=None, ci_low=0.0,
        ci_high=high, rollouts_in_estimate=count, failures=0, nll_mean=None, nll_log_mean=None,
        ess=None, pareto_k=None, max_weight_share=None,
    )  # fmt: skip


def cells(table):
    return list(csv.DictReader(io.StringIO(table.csv())))


def test_a_row_summarises_its_repetitions():
    ones = [one.estimate for one in adaptive(1e-15, 2e-15, 9e-15)]
    ones[2] = replace(ones[2], failures=40)
    row = summarise(ones)
    assert row.median == 2e-15
    assert row.pooled.probability == pytest.approx(4e-15)
    assert row.pooled.std_error == pytest.approx(np.std([1, 2, 9], ddof=1) * 1e-15 / math.sqrt(3))
    assert row.violating_share == pytest.approx(0.48)
    assert row.violating_share_std_error == pytest.approx(0.04)


def test_one_repetition_has_no_spread_of_its_share():
    assert summarise([estimate()]).violating_share_std_error is None


def test_the_papers_numbers_are_those_known_and_no_others():
    assert (ADAPTIVE.probability, ADAPTIVE.std_error) == (5.0e-15, 3.8e-15)
    assert {m: p.violation_share for m, p in TABLE_3.items()} == {
        "classical": 0.52, "agm": 0.41, "smooth-cumulative": 0.40,
    }  # fmt: skip
    assert TABLE_2["naive_100"].violation_share == 0.77
    assert TABLE_2["mc_100"].probability is None
    # published errors divide by 10 repetitions, the error of a mean by their root
    assert ADAPTIVE.usual_std_error == pytest.approx(3.8e-15 * 10 / math.sqrt(10))


def made_table_2():
    return table_2(
        {
            "mc_100": outcomes(none_failed("monte-carlo", 100, 0.036)),
            "naive_100": outcomes(estimate(method="naive", probability=1e-40, failures=99)),
            "adaptive_100": adaptive(1e-15, 2e-15, 9e-15),
        },
        REFERENCE,
    )


def test_table_2_sets_ours_beside_the_papers():
    mc, naive, ours = cells(made_table_2())
    assert [mc["method"], naive["method"], ours["method"]] == [
        "mc_100",
        "naive_100",
        "adaptive_100",
    ]
    assert mc["violating_share_paper"] == mc["probability_paper"] == ""
    assert float(naive["violating_share_paper"]) == 0.77
    assert float(ours["probability_paper"]) == 5e-15
    assert float(ours["median_over_reference"]) == pytest.approx(0.5)
    text = made_table_2().markdown()
    assert "| mc_100 | 0.0% | - | not given here |" in text
    assert text.count("\n| ") == 5


def test_table_2_says_where_and_why_it_differs():
    mc, naive, ours, accuracy = made_table_2().remarks
    assert "none of 100 rollouts violates" in mc
    assert "below 0.036" in mc
    assert "in the paper 77%" in naive
    assert "neither the lead car's braking nor the ego's limits" in naive
    assert "Many violations do not make an estimate" in naive
    assert "agree within their errors" in ours
    assert "1.2e-14" in ours
    assert "0.5 of it" in accuracy
    assert "under-reports" in accuracy


def test_without_a_reference_nothing_is_claimed_of_accuracy():
    table = table_2({"adaptive_100": adaptive(1e-15)}, None)
    assert "not known here" in table.remarks[-1]
    assert "| not known |" in table.markdown()
    assert cells(table)[0]["reference"] == ""


def test_a_clear_difference_is_called_one():
    far = table_2({"adaptive_100": adaptive(1e-9, 1.1e-9)}, None)
    assert "the two differ" in far.remarks[0]
    shares = table_3(
        {
            "classical": adaptive(1e-15, 2e-15, failures=52),
            "agm": [*adaptive(1e-15, failures=80), *adaptive(1e-15, failures=82)],
            "smooth-cumulative": [*adaptive(1e-15, failures=20), *adaptive(1e-15, failures=21)],
        },
        None,
    )
    same, more, fewer = shares.remarks[:3]
    assert "no difference beyond the spread" in same
    assert "more here" in more
    assert "fewer here" in fewer


def test_table_1_names_better_worse_and_left_out():
    table = table_1(
        {
            "guess-mu": (0.2595, 0.001, 0.5, 0.0),
            "lr": (0.2, 0.001, 0.8, 0.0),
            "ml-nn": (0.3, 0.001, 0.7, 0.0),
        }
    )
    text = "\n".join(table.remarks)
    assert "guess-mu: as in the paper" in text
    assert "lr: better here" in text
    assert "ml-nn: worse here" in text
    assert "b-nn: left out" in text


@pytest.mark.parametrize(
    ("model", "bce", "auc"), [("guess-mu", 0.2595, 0.5), ("lr", 0.2443, 0.687)]
)
def test_table_1_on_the_papers_data(model, bce, auc):
    scores = score_model(model, shared("kitti_yolov3"), 0)
    assert scores[0] == pytest.approx(bce, abs=0.001)
    assert scores[2] == pytest.approx(auc, abs=0.005)
