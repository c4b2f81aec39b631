"""Families of encounters side by side: what a detector's memory and a tracker are worth in each.

Every family of :mod:`pemviz.simulators.families` is run with every memory time of the detector's
misses and every tracker. A cell, that is one family, memory time and tracker, is answered twice:
by ``mixture`` and by plain Monte Carlo. :mod:`pemviz.reproduce.families.answers` says which of the
two counts, rule by rule, and :mod:`pemviz.reproduce.families.page` shows it.
"""

from pemviz.reproduce.families.carry_out import FamilyStudy, study_families
from pemviz.reproduce.families.settings import FamilySettings

__all__ = ["FamilySettings", "FamilyStudy", "study_families"]
