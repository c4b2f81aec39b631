"""The emergency braking rule: brake hard if perception detected and the gap is small.

Written for whatever compares and combines as arrays do: numpy arrays, one number.
"""

from typing import Any, TypeVar

from pemviz.config import ScenarioConfig

Values = TypeVar("Values")


def is_close(gap_m: Any, config: ScenarioConfig) -> Any:
    """Whether a detection at gaps ``[...]`` would brake: gap < ``emergency_gap_m``."""
    return gap_m < config.emergency_gap_m


def brakes(detected: Values, gap_m: Any, config: ScenarioConfig) -> Values:
    """Whether the ego brakes at ``emergency_deceleration_mps2``, elementwise ``[...]``.

    Args:
        detected: Perception's outcomes ``[...]``.
        gap_m: Gaps ``[...]`` [m].
        config: The scenario.
    """
    return detected & is_close(gap_m, config)
