"""One run of one program on one problem, a line of JSON; read and written without pemviz."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

RUNS = "runs.jsonl"
DONE = "done"
"""A budget: until the method says that it is done, with its own settings."""
ENDLESS = "took longer than"


def as_took(method: str) -> str:
    """A budget: on each problem as many calls as ``method`` took until it was done."""
    return f"as {method} took"


@dataclass(frozen=True, kw_only=True)
class Run:
    """What one run said.

    Attributes:
        problem: The problem's name.
        method: Whose method, and what was set of it.
        budget: What was asked for: a number of calls, :data:`DONE`, or :func:`as_took`.
        seed: Its seed.
        estimate: The probability; ``None`` where the run failed.
        low: Lower end of its 95 % interval; ``None`` where the method gives none.
        high: Upper end, likewise.
        warned: Why it says itself that the interval is not to be relied on; empty: it says nothing.
        calls: Rollouts simulated, or evaluations of g.
        seconds: CPU time of this process, user and system [s].
    """

    problem: str
    method: str
    budget: str
    seed: int
    estimate: float | None
    low: float | None = None
    high: float | None = None
    warned: tuple[str, ...] = ()
    calls: int = 0
    seconds: float = 0.0

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What tells a run from others."""
        return self.problem, self.method, self.budget, self.seed

    @property
    def is_endless(self) -> bool:
        """Whether it was ended because it took too long."""
        return any(reason.startswith(ENDLESS) for reason in self.warned)


def add_run(path: Path, run: Run) -> None:
    """Add a line for a run."""
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(run)) + "\n")


def read_runs(path: Path) -> Mapping[tuple[str, str, str, int], Run]:
    """Runs by what tells them apart; a line that was not finished counts as none."""
    runs: dict[tuple[str, str, str, int], Run] = {}
    if not path.exists():
        return runs
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            fields: dict[str, Any] = json.loads(line)
            fields["warned"] = tuple(fields["warned"])
            run = Run(**fields)
        except (ValueError, KeyError, TypeError):
            continue
        runs[run.key] = run
    return runs
