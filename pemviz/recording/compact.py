"""Makes a finished recording smaller; what it shows stays the same."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import OptimizationProfile, RrdReader

from pemviz.errors import RunError


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
        stream.send_chunks(store)
        stream.flush()
        stream.disconnect()
        partial.replace(path)
    except (OSError, ValueError, RuntimeError) as error:
        message = f"recording {path}: cannot be compacted ({' '.join(str(error).split())})"
        raise RunError(message) from error
    finally:
        partial.unlink(missing_ok=True)
