"""Signal Temporal Logic over batches of rollouts: language, three metrics, the verdict."""

from pemviz.stl.agm import Agm
from pemviz.stl.classical import Classical
from pemviz.stl.conjuncts import conjuncts
from pemviz.stl.evaluation import robustness, robustness_trace
from pemviz.stl.formulas import Formula, FormulaError
from pemviz.stl.metric import Metric
from pemviz.stl.parsing import parse
from pemviz.stl.smooth_cumulative import SmoothCumulative
from pemviz.stl.verdict import FormulaMonitor, ties_hold, violated

__all__ = [
    "Agm",
    "Classical",
    "Formula",
    "FormulaError",
    "FormulaMonitor",
    "Metric",
    "SmoothCumulative",
    "conjuncts",
    "parse",
    "robustness",
    "robustness_trace",
    "ties_hold",
    "violated",
]
