"""Jobs on a few processes: in any order, with progress, ending at once when asked to stop."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pemviz.errors import RunError
from pemviz.processes import map_in_processes


@dataclass(frozen=True)
class Job:
    """A call of a module's function with arguments that can be pickled.

    Attributes:
        label: For progress displays.
        function: What is called.
        arguments: With what.
    """

    label: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    def result(self) -> Any:
        """What the call returns."""
        return self.function(*self.arguments)


OnProgress = Callable[[int, int, str], None]


def no_progress(done: int, total: int, label: str) -> None:
    """Take no note of what is done."""


def run_jobs(
    jobs: Mapping[Any, Job],
    *,
    workers: int,
    on_progress: OnProgress,
    should_stop: Callable[[], bool],
    when_stopped: str = "nothing was written",
) -> dict[Any, Any]:
    """Results by the jobs' keys, whatever the number of processes.

    Raises:
        RunError: Asked to stop, or a process died.
        Exception: What a job raised.
    """
    keys = list(jobs)
    labels: list[str] = []

    def tell(index: int) -> None:
        labels.append(jobs[keys[index]].label)
        on_progress(len(labels), len(jobs), labels[-1])

    def check_stop() -> None:
        if should_stop():
            message = f"interrupted; {when_stopped}"
            raise RunError(message)

    results = map_in_processes(
        Job.result, list(jobs.values()), workers=workers, on_done=tell, check_stop=check_stop
    )
    return dict(zip(keys, results, strict=True))
