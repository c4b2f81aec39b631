"""Who carries a sweep's runs out: what is asked of workers, and a few processes of this machine."""

import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from pemviz.errors import RunError
from pemviz.processes import DIED, ProcessPool
from pemviz.sweep.run_task import RunOutcome, RunTask, carry_out

SCRATCH_PREFIX = "pemviz-sweep-"


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


class LocalWorkers:
    """Processes that are started when they are first needed, and anew if they die.

    Each is a pool of its own, so that it is known whose death failed which run.
    """

    def __init__(self, count: int) -> None:
        """Plan for ``count`` processes; none is started yet."""
        self.capacity = count
        self._idle: list[ProcessPool] = []
        self._busy: dict[Future[RunOutcome], tuple[ProcessPool, RunTask]] = {}
        self._scratch: Path | None = None

    def __enter__(self) -> Self:
        """Make a folder for what the runs need while they last."""
        try:
            self._scratch = Path(tempfile.mkdtemp(prefix=SCRATCH_PREFIX))
        except OSError as error:
            message = f"no temporary folder can be made ({error.strerror or error})"
            raise RunError(message) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Kill the processes and remove the folder."""
        for pool in [*self._idle, *(pool for pool, _ in self._busy.values())]:
            pool.close()
        self._idle, self._busy = [], {}
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def submit(self, task: RunTask) -> None:
        """Give the run to a process that has none."""
        pool = self._idle.pop() if self._idle else ProcessPool(1, scratch=self._scratch)
        self._busy[pool.submit(carry_out, task, scratch=self._scratch)] = (pool, task)

    def finished(self, *, timeout_s: float) -> Sequence[RunOutcome]:
        """The outcomes since the last call, waiting for one if need be."""
        done, _ = wait(self._busy, timeout=timeout_s, return_when=FIRST_COMPLETED)
        return [self._outcome(future) for future in done]

    def _outcome(self, future: Future[RunOutcome]) -> RunOutcome:
        pool, task = self._busy.pop(future)
        try:
            outcome = future.result()
        except BrokenExecutor:
            pool.close()
            return RunOutcome(task.name, message=f"its {DIED}")
        self._idle.append(pool)
        return outcome
