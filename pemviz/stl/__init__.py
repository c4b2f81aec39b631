"""Signal Temporal Logic over batches of rollouts: language, three metrics, the verdict."""

from pemviz.stl.agm import SCENARIO_BOUNDS, Agm
from pemviz.stl.builder import TRUE, always, eventually, maximum, minimum, signal, until
from pemviz.stl.checks import check_horizon
from pemviz.stl.classical import Classical
from pemviz.stl.errors import FormulaError
from pemviz.stl.evaluation import (
    Metric,
    SubformulaTrace,
    robustness,
    robustness_trace,
    subformula_traces,
)
from pemviz.stl.expressions import Expression
from pemviz.stl.formulas import Formula
from pemviz.stl.parsing import parse
from pemviz.stl.smooth_cumulative import SmoothCumulative
from pemviz.stl.verdict import ties_hold, violated

__all__ = [
    "SCENARIO_BOUNDS",
    "TRUE",
    "Agm",
    "Classical",
    "Expression",
    "Formula",
    "FormulaError",
    "Metric",
    "SmoothCumulative",
    "SubformulaTrace",
    "always",
    "check_horizon",
    "eventually",
    "maximum",
    "minimum",
    "parse",
    "robustness",
    "robustness_trace",
    "signal",
    "subformula_traces",
    "ties_hold",
    "until",
    "violated",
]
