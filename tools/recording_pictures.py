"""Pictures of a recording's tabs, made without a display.

    python tools/recording_pictures.py RUN.rrd --out FOLDER [--step 60]

Needs a Vulkan driver; on a machine without a graphics card that is Debian's
mesa-vulkan-drivers. Prints each picture's path and any complaint of the views.
"""

import argparse
import io
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import PIL.Image
from rerun.experimental import ViewerClient

from pemviz.recording import paths
from pemviz.recording.open import LOOPBACK, free_port, viewer_process, wait_for_port

ATTEMPTS = 6
COLORS = 128
SETTLE_S = 4.0


def main() -> int:
    """Make the pictures; exit code 1 if a view complains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--step", type=int, default=60, help="where in the rollouts to look")
    parser.add_argument("--size", default="1280x800", help="of the pictures [pixels]")
    parser.add_argument("--settle", type=float, default=SETTLE_S, help="seconds before a picture")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with headless_viewer(arguments.size) as viewer:
        complaints = take_pictures(
            viewer,
            arguments.recording,
            out=arguments.out,
            step=arguments.step,
            settle_s=arguments.settle,
        )
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


def take_pictures(
    viewer: ViewerClient, recording: Path, *, out: Path, step: int, settle_s: float
) -> list[str]:
    """One picture of each tab, inner tabs of Learning included; returns what views complain of."""
    complaints: list[str] = []
    viewer.open(str(recording.resolve()))
    time.sleep(settle_s)
    layout = viewer.get_blueprint("recording").blueprint
    if layout["/time_panel"]["TimePanelBlueprint"].get("timeline") == paths.STEP:
        viewer.set_time(paths.STEP, sequence=step, play_state="paused")
    for name, active in tab_paths(layout):
        for container, tab in active.items():
            layout[container]["ContainerBlueprint"]["active_tab"] = tab
        viewer.set_blueprint(layout, "recording")
        time.sleep(settle_s)
        keep(screenshot(viewer), out / f"{name}.png")
        complaints += [
            f"{name}: {view.name}: {report.severity}: {report.summary}"
            for view in viewer.get_state().views
            for report in view.reports
        ]
    return sorted(set(complaints))


def keep(picture: bytes, path: Path) -> None:
    """Keep a picture in few colours, which a README loads quickly."""
    shown = PIL.Image.open(io.BytesIO(picture)).convert("RGB")
    shown.quantize(COLORS, dither=PIL.Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def tab_paths(layout: dict[str, Any]) -> Iterator[tuple[str, dict[str, str]]]:
    """Name and active tabs (by container) of each picture."""
    root = _root(layout)
    for number, tab in enumerate(_contents(layout, root), start=1):
        name = f"{number}-{_slug(_title(layout, tab))}"
        if _title(layout, tab) == "Learning" and _kind(layout, tab) == "Tabs":
            for below in _contents(layout, tab):
                yield f"{name}-{_slug(_title(layout, below))}", {root: tab, tab: below}
        else:
            yield name, {root: tab}


def _root(layout: dict[str, Any]) -> str:
    containers = [path for path, parts in layout.items() if "ContainerBlueprint" in parts]
    inside = {part for path in containers for part in _contents(layout, path)}
    tabs = [path for path in containers if path not in inside and _kind(layout, path) == "Tabs"]
    return tabs[0]


def _contents(layout: dict[str, Any], path: str) -> list[str]:
    """Paths of what a container holds; the viewer gives a single one as such, not in a list."""
    contents: str | list[str] = layout[path]["ContainerBlueprint"]["contents"]
    parts = [contents] if isinstance(contents, str) else contents
    return [f"/{part.lstrip('/')}" for part in parts]


def _kind(layout: dict[str, Any], part: str) -> str:
    return layout.get(part, {}).get("ContainerBlueprint", {}).get("container_kind", "")


def _title(layout: dict[str, Any], part: str) -> str:
    parts = layout[part]
    kind = "ContainerBlueprint" if "ContainerBlueprint" in parts else "ViewBlueprint"
    return parts[kind].get("display_name", "")


def _slug(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


@contextmanager
def headless_viewer(size: str) -> Iterator[ViewerClient]:
    """A viewer without a window, on the loopback interface, ended on leaving."""
    port = free_port()
    arguments = ["--headless", "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    arguments += ["--window-size", size]
    with viewer_process(arguments) as process:
        wait_for_port(port, process)
        yield ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")


def screenshot(viewer: ViewerClient) -> bytes:
    """A picture of the whole viewer; a software renderer may need more than one attempt."""
    for _ in range(ATTEMPTS - 1):
        with suppress(TimeoutError):
            return viewer.take_screenshot()
    return viewer.take_screenshot()


if __name__ == "__main__":
    sys.exit(main())
