"""Perception error models: P(detected) as a function of an obstacle's salient variables.

Running a model needs numpy and scipy; torch and scikit-learn are imported when one is fitted.
"""

from pemviz.errors import PemError
from pemviz.pem.data.support import (
    SupportReport,
    SupportSummary,
    data_bound_pem,
    support_check,
    support_from_json,
    support_of,
)
from pemviz.pem.data.table import SalientTable, load_table, save_table
from pemviz.pem.fitting.fit import KITTI_YOLOV3, Provenance, fit_ensemble, fit_pem
from pemviz.pem.judging.reweight import compare_pems, pem_interval, reweight
from pemviz.pem.model_files import (
    ensemble_of,
    load_ensemble,
    load_pem,
    load_position_errors,
    save_pem,
    save_position_errors,
    shipped_pems,
    shipped_position_errors,
)
from pemviz.pem.models.cards import PemCard, memory_of
from pemviz.pem.models.ensemble import EnsemblePem
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.own_features import Feature, OwnFeatures, own_features_of
from pemviz.pem.models.position_errors import NoiseMemory, PositionErrorModel, constant_errors
from pemviz.pem.models.protocol import (
    CLASS_NAMES,
    COLUMN,
    OCCLUSION_NAMES,
    SALIENT_COLUMNS,
    DetectorModel,
    Pem,
    PemEnsemble,
    as_pem,
)

__all__ = [
    "CLASS_NAMES",
    "COLUMN",
    "KITTI_YOLOV3",
    "OCCLUSION_NAMES",
    "SALIENT_COLUMNS",
    "DetectorModel",
    "EnsemblePem",
    "Feature",
    "Memory",
    "NoiseMemory",
    "OwnFeatures",
    "Pem",
    "PemCard",
    "PemEnsemble",
    "PemError",
    "PositionErrorModel",
    "Provenance",
    "SalientTable",
    "SupportReport",
    "SupportSummary",
    "as_pem",
    "compare_pems",
    "constant_errors",
    "data_bound_pem",
    "ensemble_of",
    "fit_ensemble",
    "fit_pem",
    "load_ensemble",
    "load_pem",
    "load_position_errors",
    "load_table",
    "memory_of",
    "own_features_of",
    "pem_interval",
    "reweight",
    "save_pem",
    "save_position_errors",
    "save_table",
    "shipped_pems",
    "shipped_position_errors",
    "support_check",
    "support_from_json",
    "support_of",
]
