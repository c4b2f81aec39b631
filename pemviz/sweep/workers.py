"""What a sweep asks of those who carry its runs out: this machine's processes or a cluster."""

from collections.abc import Sequence
from types import TracebackType
from typing import Protocol, Self

from pemviz.sweep.runs import RunOutcome, RunTask


class Workers(Protocol):
    """Take runs and hand back outcomes, in any order; leaving the context ends what is running."""

    def __enter__(self) -> Self:
        """Make ready."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End whatever is running, and leave nothing behind."""
        ...

    @property
    def capacity(self) -> int:
        """How many runs it makes sense to have handed in at a time; at least 1."""
        ...

    def submit(self, task: RunTask) -> None:
        """Take a run."""
        ...

    def finished(self, *, timeout_s: float) -> Sequence[RunOutcome]:
        """The outcomes since the last call, waiting for one if need be.

        Raises:
            RunError: No more outcomes can come.
        """
        ...
