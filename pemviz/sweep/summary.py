"""A sweep in one page of markdown: what every setting found, over its seeds."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.fields import Setting
from pemviz.sweep.plan import Plan, value_text
from pemviz.types import Estimate

NOTHING = "-"


@dataclass(frozen=True)
class SettingSummary:
    """One setting over its seeds.

    Attributes:
        setting: The varied fields with their values.
        states: Its runs.
    """

    setting: Setting
    states: tuple[RunState, ...]

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Of its runs that are done."""
        return tuple(state.estimate for state in self.states if state.estimate is not None)


def by_setting(states: Sequence[RunState]) -> list[SettingSummary]:
    """The runs grouped by setting, in their order."""
    grouped: dict[Setting, list[RunState]] = {}
    for state in states:
        grouped.setdefault(state.planned.setting, []).append(state)
    return [SettingSummary(setting, tuple(of_it)) for setting, of_it in grouped.items()]


def summary_markdown(plan: Plan, states: Sequence[RunState]) -> str:
    """The page: counts, a table of settings, what failed."""
    count = {name: sum(s.status == name for s in states) for name in ("done", "failed", "not run")}
    parts = [
        "# Sweep",
        f"{len(states)} runs: {count['done']} done, {count['failed']} failed, "
        f"{count['not run']} not run.",
        settings_table(plan, states),
        "Probability: median over the seeds, and the least and greatest estimate. A seed whose "
        "rollouts held no violation counts as 0. Effective sample size: median; below "
        f"{SMALL_ESS:g}, do not quote an estimate. Unreliable: runs whose interval is none at its "
        "level, so that nothing may be decided by them.",
    ]
    failed = [s for s in states if s.status == "failed"]
    if failed:
        lines = [
            f"- {markdown_text(s.planned.label)}: {markdown_text(s.message or '')}" for s in failed
        ]
        parts.append("## Failed\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


def settings_table(plan: Plan, states: Sequence[RunState]) -> str:
    """One row a setting."""
    header = (
        *map(markdown_text, plan.fields),
        "runs done",
        "median probability",
        "least",
        "greatest",
        "seeds without violation",
        "effective sample size",
        "largest Pareto k-hat",
        "unreliable",
    )
    return markdown_table(header, [_row(one) for one in by_setting(states)])


def _row(one: SettingSummary) -> tuple[str, ...]:
    estimates = one.estimates
    probabilities = [e.probability for e in estimates]
    return (
        *(markdown_text(value_text(value)) for _, value in one.setting),
        f"{len(estimates)} of {len(one.states)}",
        _over(statistics.median, probabilities),
        _over(min, probabilities),
        _over(max, probabilities),
        str(sum(e.failures == 0 for e in estimates)),
        _over(statistics.median, [e.ess for e in estimates]),
        _over(max, [e.pareto_k for e in estimates]),
        f"{sum(bool(interval_caveats(e)) for e in estimates)} of {len(estimates)}",
    )


def _over(combine: Callable[[list[float]], float], values: Sequence[float | None]) -> str:
    defined = [value for value in values if value is not None]
    return f"{combine(defined):.3g}" if defined else NOTHING
