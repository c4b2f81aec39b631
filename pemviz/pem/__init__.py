"""Perception error models: P(detected) as a function of an obstacle's salient variables.

Running a model needs numpy alone; torch and scikit-learn are imported when one is fitted.
"""

from pemviz.pem.card import PemCard
from pemviz.pem.errors import PemError
from pemviz.pem.files import save_network as save_pem
from pemviz.pem.fit import fit_pem
from pemviz.pem.load import load_pem, shipped_pems
from pemviz.pem.protocol import (
    CLASS_NAMES,
    OCCLUSION_NAMES,
    SALIENT_COLUMNS,
    Pem,
    PemEnsemble,
)
from pemviz.pem.table import SalientTable, load_table, save_table

__all__ = [
    "CLASS_NAMES",
    "OCCLUSION_NAMES",
    "SALIENT_COLUMNS",
    "Pem",
    "PemCard",
    "PemEnsemble",
    "PemError",
    "SalientTable",
    "fit_pem",
    "load_pem",
    "load_table",
    "save_pem",
    "save_table",
    "shipped_pems",
]
