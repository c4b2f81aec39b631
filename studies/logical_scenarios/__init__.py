"""Logical scenarios side by side: what a detector's memory and a tracker change in each.

Every logical scenario of :mod:`pemviz.simulators.encounters` is run with every memory time of the
detector's misses and every tracker. A cell, that is one logical scenario, memory time and tracker,
is answered twice: by ``mixture`` and by plain Monte Carlo.
:mod:`studies.logical_scenarios.answers` says which of the two counts, rule by rule, and
:mod:`studies.logical_scenarios.page` shows it.
"""

from studies.logical_scenarios.settings import ScenarioStudySettings
from studies.logical_scenarios.study import ScenarioStudy, study_scenarios

__all__ = ["ScenarioStudy", "ScenarioStudySettings", "study_scenarios"]
