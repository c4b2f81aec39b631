"""The paper's tables and figures, computed anew and set beside the published numbers."""

from pemviz.reproduce.carry_out import Reproduction, reproduce
from pemviz.reproduce.experiments import PARTS, Part, Settings

__all__ = ["PARTS", "Part", "Reproduction", "Settings", "reproduce"]
