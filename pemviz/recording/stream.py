"""One recording being written, and made compact: a layer over rerun that knows the timelines."""

import socket
import threading
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import OptimizationProfile, RrdReader

from pemviz.arrays import AnyArray
from pemviz.errors import RunError
from pemviz.recording import paths

APPLICATION = "pemviz"
FLUSH_TIMEOUT_S = 10.0
BROKEN_TIMEOUT_S = 2.0
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class StepTimes:
    """The rows of a rollout: steps 0 to ``count`` - 1 of ``dt_s`` seconds each, in one stage."""

    stage: int
    count: int
    dt_s: float

    def columns(self) -> list[rr.TimeColumn]:
        """One column for each timeline."""
        steps = np.arange(self.count)
        return [
            rr.TimeColumn(paths.STAGE, sequence=np.full(self.count, self.stage)),
            rr.TimeColumn(paths.STEP, sequence=steps),
            rr.TimeColumn(paths.SIM_TIME, duration=steps * self.dt_s),
        ]


class RecordingFile:
    """A recording that is written to a file and, on request, served to a live viewer.

    ``logged`` are the entity paths written so far.
    """

    def __init__(self, path: Path, *, name: str, layout: str, live_port: int | None = None) -> None:
        """Open the file.

        Args:
            path: Where; overwritten if it exists.
            name: The recording's name in the viewer.
            layout: Recordings that share a layout share a blueprint in the viewer.
            live_port: Port on the loopback interface where a live viewer can connect.

        Raises:
            RunError: The file cannot be opened, or the port is taken.
        """
        self.path = path
        self.logged: set[str] = set()
        self._last = dict[str, Any]()
        self._broken = False
        # a random identifier: a viewer merges recordings that have the same one
        self._stream = rr.RecordingStream(
            f"{APPLICATION}_{layout}", recording_id=f"{name}-{uuid.uuid4().hex[:12]}"
        )
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        sinks: list[Any] = []
        if live_port is not None:
            _check_port(live_port)
        try:
            sinks.append(rr.FileSink(path))
            if live_port is not None:
                sinks.append(rr.GrpcServerSink(bind_ip=LOOPBACK, port=live_port))
            self._stream.set_sinks(*sinks)
        except (OSError, RuntimeError, ValueError) as error:
            raise RunError(_cannot_write(path, error)) from error
        self._stream.send_recording_name(name)

    def markdown(self, path: str, text: str) -> None:
        """Replace a text that shows on every timeline."""
        self.static(path, rr.TextDocument(text, media_type="text/markdown"))

    def static(self, path: str, *archetypes: Any) -> None:
        """Log something that does not change with time."""
        if self._is_news(path, archetypes):
            self._stream.log(path, *archetypes, static=True)
            self.logged.add(path)

    def at_stage(self, path: str, *archetypes: Any, stage: int) -> None:
        """Log something that belongs to a stage and those after it; it shows on every timeline."""
        if self._is_news(path, archetypes):
            self._stream.set_time(paths.STEP, sequence=0)
            self._stream.set_time(paths.SIM_TIME, duration=0.0)
            self.on_stage_only(path, *archetypes, stage=stage)

    def on_stage_only(self, path: str, *archetypes: Any, stage: int) -> None:
        """Log a value whose horizontal axis is the stage."""
        self._stream.set_time(paths.STAGE, sequence=stage)
        self._stream.log(path, *archetypes)
        self._stream.reset_time()
        self.logged.add(path)

    def _is_news(self, path: str, archetypes: Sequence[Any]) -> bool:
        """Whether that is not what was logged there last: a viewer shows that until it changes."""
        new = [
            (batch.component_descriptor(), batch.as_arrow_array())
            for archetype in archetypes
            for batch in archetype.as_component_batches()
        ]
        same, self._last[path] = self._last.get(path) == new, new
        return not same

    def along(self, path: str, columns: Iterable[Any], *, times: StepTimes) -> None:
        """Log one row for each step."""
        self._stream.send_columns(path, indexes=times.columns(), columns=columns)
        self.logged.add(path)

    def series(self, path: str, values: AnyArray, *, times: StepTimes) -> None:
        """Log N curves in one entity: ``values`` ``[N, count]``, one row of N for each step."""
        by_step = np.ascontiguousarray(values.T, dtype=np.float64)
        columns = rr.Scalars.columns(scalars=by_step.ravel())
        self.along(path, columns.partition([values.shape[0]] * times.count), times=times)

    def style(
        self,
        path: str,
        *,
        names: Sequence[str],
        colors: Sequence[Any],
        widths: Sequence[float],
    ) -> None:
        """Names, colours and widths of the N curves of an entity."""
        self.static(path, rr.SeriesLines(names=names, colors=colors, widths=widths))

    def blueprint(self, blueprint: rrb.Blueprint) -> None:
        """Set how the viewer lays the recording out."""
        self._stream.send_blueprint(blueprint, make_active=True, make_default=True)

    def flush(self) -> None:
        """Make what was logged readable in the file, even if the process is killed next.

        Raises:
            RunError: It cannot be written.
        """
        if self._broken:
            raise RunError(_cannot_write(self.path, OSError("writing failed before")))
        try:
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
        except (OSError, RuntimeError, ValueError) as error:
            self._broken = True
            raise RunError(_cannot_write(self.path, error)) from error

    def close(self) -> None:
        """Write the footer.

        Raises:
            RunError: It cannot be written.
        """
        try:
            self.flush()
        finally:
            if not self._broken:
                self._stream.disconnect()
            else:
                # the stream may never answer again, and at the process's end rerun would wait
                rr.unregister_shutdown()
                ending = threading.Thread(target=self._stream.disconnect, daemon=True)
                ending.start()
                ending.join(BROKEN_TIMEOUT_S)


def blueprint_of(root: rrb.Container, time_panel: rrb.TimePanel) -> rrb.Blueprint:
    """These views alone: the viewer's other panels are hidden."""
    return rrb.Blueprint(
        root,
        time_panel,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _cannot_write(path: Path, error: Exception) -> str:
    return f"recording {path}: cannot be written ({' '.join(str(error).split())})"


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            message = f"live port {port}: cannot be used ({error.strerror or error})"
            raise RunError(message) from error


def compact(path: Path, *, blueprint: rrb.Blueprint) -> None:
    """Rewrite a recording with its chunks joined and one blueprint.

    A recording that is written while a run goes on has many small chunks, whose headers take
    more space than their data, and every layout that it ever had.

    Raises:
        RunError: It cannot be read or written; it is as it was.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        reader = RrdReader(path)
        (entry,) = reader.recordings()
        store = reader.stream(store=entry).collect(optimize=OptimizationProfile.OBJECT_STORE)
        stream = rr.RecordingStream(entry.application_id, recording_id=entry.recording_id)
        stream.set_sinks(rr.FileSink(partial))
        stream.send_blueprint(blueprint, make_active=True, make_default=True)
        stream.flush()  # it comes first: a viewer that still reads would show a layout of its own
        stream.send_chunks(store)
        stream.flush()
        stream.disconnect()
        partial.replace(path)
    except (OSError, ValueError, RuntimeError) as error:
        message = f"recording {path}: cannot be compacted ({' '.join(str(error).split())})"
        raise RunError(message) from error
    finally:
        partial.unlink(missing_ok=True)
