"""Perception error models: P(detected) as a function of an obstacle's salient variables.

Running a model needs numpy and scipy; torch and scikit-learn are imported when one is fitted.
"""

from pemviz.pem.card import PemCard
from pemviz.pem.ensemble import EnsemblePem
from pemviz.pem.errors import PemError
from pemviz.pem.files import save_pem
from pemviz.pem.fit import KITTI_YOLOV3, Provenance, fit_ensemble, fit_pem
from pemviz.pem.load import ensemble_of, load_ensemble, load_pem, shipped_pems
from pemviz.pem.own import DetectorModel, as_pem
from pemviz.pem.protocol import (
    CLASS_NAMES,
    OCCLUSION_NAMES,
    SALIENT_COLUMNS,
    Pem,
    PemEnsemble,
)
from pemviz.pem.reweight import compare_pems, pem_interval, reweight
from pemviz.pem.support import SupportSummary, support_from_json, support_of
from pemviz.pem.support_check import SupportReport, data_bound_pem, support_check
from pemviz.pem.table import SalientTable, load_table, save_table

__all__ = [
    "CLASS_NAMES",
    "KITTI_YOLOV3",
    "OCCLUSION_NAMES",
    "SALIENT_COLUMNS",
    "DetectorModel",
    "EnsemblePem",
    "Pem",
    "PemCard",
    "PemEnsemble",
    "PemError",
    "Provenance",
    "SalientTable",
    "SupportReport",
    "SupportSummary",
    "as_pem",
    "compare_pems",
    "data_bound_pem",
    "ensemble_of",
    "fit_ensemble",
    "fit_pem",
    "load_ensemble",
    "load_pem",
    "load_table",
    "pem_interval",
    "reweight",
    "save_pem",
    "save_table",
    "shipped_pems",
    "support_check",
    "support_from_json",
    "support_of",
]
