"""Results made up for the reports' tests."""

import math
from dataclasses import replace

from pemviz.analysis.causes import BandMisses, Bursts, Spread
from pemviz.analysis.data_plan import DataPlan, RefitBand, SequencePlan
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.label_plan import BandPlan, LabelPlan
from pemviz.analysis.model_uncertainty import DataBound, ModelInterval
from pemviz.analysis.sensitivity import BandSensitivity, MemorySensitivity
from pemviz.config import ExperimentConfig
from pemviz.runs.result import PemInfo, RankedRollout, RunResult
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Diagnostic, Estimate

NASTY = (
    "a|b `c` ``d`` <script>alert(1)</script> & \"q\" 'r' ]]> --> **bold** _em_ [x](javascript:1) "
    "![i](http://e.x/p.png) @someone #12 $x^2$ :boom: https://e.x www.e.x \\| \\` &lt; é 漢 \n| new"
    " | row |\r\n# heading\x00\x07\x1b[31m\u202e\ud800\ufffe"
)


PLAN = DataPlan(
    labels=LabelPlan(
        target=2.5e-9,
        obstacle="Car, occlusion none, straight ahead (|x| < 1.5 m), heading away",
        confidence=0.95,
        power=0.9,
        bands=(
            BandPlan(
                low_m=5.0, high_m=7.0, obstacles=0, missed=0, model=0.012, allowed=1.0,
                required=0.058, fewest_labels=78, labels=1249, most_missed=6,
            ),
            BandPlan(
                low_m=7.0, high_m=13.0, obstacles=132, missed=0, model=0.011, allowed=0.034,
                required=0.028, fewest_labels=29, labels=717, most_missed=13,
            ),
        ),
        warning="a rough plan",
    ),
    halves=True,
    reason="none",
    refits=(
        RefitBand(low_m=7.0, high_m=13.0, spread=5.3, contribution=0.94, labels=1290),
    ),
    sequences=SequencePlan(
        example="rrc", is_own=False, tau_s=0.25, low_s=0.17, high_s=0.38, sequences=18, factor=1.2,
        wanted=85,
    ),
)  # fmt: skip


BURSTS = Bursts(
    dt_s=0.05,
    count=1.1,
    misses=16.3,
    frames=Spread(15.0, 10.0, 23.0),
    begins_s=Spread(2.05, 1.6, 2.55),
    begins_gap_m=Spread(9.0, 7.06, 11.44),
    start=0.0026,
    again=0.78,
    whole=4.7e-10,
)
EXPLANATION = Explanation(
    repetition=0,
    misses_by_distance=(BandMisses(8.0, 10.0, 4.06, 1.0),),
    miss_probability_by_step=(),
    chains=(),
    sensitivity=(BandSensitivity(None, None, 1.08, 0.024, 900.0, None, 0.011),) * 2,
    memory=MemorySensitivity(0.2, 1.94, 0.0671, 250.0, None, 0.03),
    bursts=BURSTS,
)


def estimate(**changes):
    values = {
        "method": "adaptive",
        "probability": 2e-15,
        "log10_probability": math.log10(2e-15),
        "std_error": 1e-15,
        "ci_low": 8e-16,
        "ci_high": 5e-15,
        "rollouts_simulated": 1200,
        "rollouts_in_estimate": 100,
        "failures": 52,
        "nll_mean": 33.4,
        "nll_log_mean": 31.0,
        "ess": 40.0,
        "pareto_k": 0.3,
        "max_weight_share": 0.1,
        "unbiased_probability": 2e-15,
        "unbiased_std_error": 1e-15,
        "diagnostics": (),
    }
    return Estimate(**{**values, **changes})


def warned(text, kind="few-failures", value=None):
    return Diagnostic(kind=kind, value=value, limit=None, text=text)


def result(one=None, *, repetitions=1, **changes):
    one = estimate() if one is None else one
    base = RunResult(
        run_id="20260101-000000-adaptive",
        status="done",
        config=ExperimentConfig(method=one.method, repetitions=repetitions),
        pem=PemInfo(name="ml-nn", digest="ab" * 32, data="37498 obstacles"),
        versions={"pemviz": "0.1.0", "numpy": "2.3.0"},
        assumptions=("misses are independent",),
        estimate=one,
        repetitions=(one,) * repetitions,
        least_robust=(
            RankedRollout(
                repetition=0, stage=11, rollout=7, robustness=-3.25, violated=True, nll=34.5,
                log_weight=-33.0, misses=9,
            ),
        ),
        timings_s={"total": 2.5},
        warnings=("no obstacle closer than 7 m",),
        reference=Reference(
            probability=6.69e-15, std_error=6e-18, log10_probability=math.log10(6.69e-15)
        ),
        data_bound=DataBound(probability=0.0042, rollouts=1000, failures=1, confidence=0.95),
        pem_interval=ModelInterval(
            low=1e-17, high=1e-13, median=3e-15, members=20, confidence=0.95,
            warnings=("few effective failures",),
        ),
    )  # fmt: skip
    return replace(base, **changes)


def nasty_result():
    one = estimate(diagnostics=(warned(NASTY), warned("second")))
    return result(
        one,
        config=ExperimentConfig(method="adaptive", spec=NASTY, pem=NASTY),
        run_id=NASTY,
        message=NASTY,
        status="failed",
        pem=PemInfo(name=NASTY, digest=NASTY, data=NASTY),
        versions={"pemviz": NASTY},
        assumptions=(NASTY,),
        warnings=(NASTY,),
        pem_interval=ModelInterval(
            low=None, high=1e-13, median=None, members=20, confidence=0.95, warnings=(NASTY,)
        ),
    )
