"""Logical scenarios side by side: what a detector's memory and a tracker are worth in each.

Every logical scenario of :mod:`pemviz.simulators.encounters` is run with every memory time of the
detector's misses and every tracker. A cell, that is one logical scenario, memory time and tracker,
is answered twice: by ``mixture`` and by plain Monte Carlo.
:mod:`pemviz.reproduce.scenarios.answers` says which of the two counts, rule by rule, and
:mod:`pemviz.reproduce.scenarios.page` shows it.
"""

from pemviz.reproduce.scenarios.carry_out import ScenarioStudy, study_scenarios
from pemviz.reproduce.scenarios.settings import ScenarioStudySettings

__all__ = ["ScenarioStudy", "ScenarioStudySettings", "study_scenarios"]
