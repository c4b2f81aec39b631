"""Is the run of a folder the one that is asked for? The one answer, for all who ask.

Asked before a run goes on, before a sweep takes a run for done, before the panel shows one.
"""

from collections.abc import Mapping
from typing import Any, cast

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import every_setting
from pemviz.runs.result import RunResult

DIGITS = 12
"""Of a digest; enough to tell two apart."""


def run_differs(
    result: RunResult,
    *,
    config: ExperimentConfig,
    pem_digest: str | None = None,
    position_digest: str | None = None,
) -> str | None:
    """How the run of a result differs from the one asked for, in words; ``None``: not at all.

    Args:
        result: What the folder holds.
        config: What is asked for.
        pem_digest: SHA-256 of the error model that is asked for; ``None``: any of its name.
        position_digest: The same of the position errors.
    """
    settings = setting_differences(result.config, config)
    if settings:
        name, (begun, asked) = next(iter(settings.items()))
        return f"settings other than those of its config.toml ({name} = {begun!r}, not {asked!r})"
    if pem_digest is not None and result.pem.digest != pem_digest:
        return (
            f"another error model of the name {config.pem!r} (digest "
            f"{result.pem.digest[:DIGITS]}, now {pem_digest[:DIGITS]})"
        )
    errors = result.position_errors
    if position_digest is not None and errors is not None and errors.digest != position_digest:
        return (
            f"other position errors of the name {config.position_errors!r} (digest "
            f"{errors.digest[:DIGITS]}, now {position_digest[:DIGITS]})"
        )
    return None


def setting_differences(
    first: ExperimentConfig, second: ExperimentConfig
) -> dict[str, tuple[Any, Any]]:
    """The settings in which two configurations differ, by dotted name, with both values."""
    one, other = flat_settings(every_setting(first)), flat_settings(every_setting(second))
    names = [*one, *(name for name in other if name not in one)]
    return {n: (one.get(n), other.get(n)) for n in names if one.get(n) != other.get(n)}


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings with dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found |= flat_settings(cast(Mapping[str, Any], value), f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found
