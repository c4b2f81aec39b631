"""Pictures of a recording's tabs, in the dark theme and in the light one.

    python tools/recording_pictures.py RUN.rrd --out FOLDER [--tabs scene] [--step 60]

Rerun's viewer takes the theme of its system, and without a display that is the dark one; it needs a
Vulkan driver (without a graphics card Debian's mesa-vulkan-drivers). In the light theme the viewer
runs in Chromium (``apt-get install chromium``, and playwright), which is slow without a graphics
card. Prints each picture's path and, of the dark ones, any complaint of the views.
"""

import argparse
import base64
import io
import re
import sys
import tempfile
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import PIL.Image
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from panel_timings import ARGUMENTS, WAIT_MS
from playwright.sync_api import Page, sync_playwright
from rerun.experimental import ViewerClient

from pemviz.recording import paths
from pemviz.recording.open import (
    LOOPBACK,
    free_port,
    viewer_process,
    wait_for_port,
    web_viewer,
)

ATTEMPTS = 6
COLORS = 128
SETTLE_S = 4.0
BROWSER_FACTOR = 3.0
"""How much longer a browser takes that draws by software."""
MOST_WAITS, FRAME_MS = 20, 100
ACTIVE, CONTENTS = "ContainerBlueprint:active_tab", "ContainerBlueprint:contents"
NAMES = ("ContainerBlueprint:display_name", "ViewBlueprint:display_name")
RESTING_PLACES = ((240, 12), (241, 12))
"""Of the mouse, where nothing answers to it [pixels]."""
TIME_AXIS = (337, 107, 14)
"""From the page's left edge, its right one and its lower one [pixels]."""
SEND = """text => {
  const channel = `layout-${performance.now()}`;
  _handle.open_channel(channel, channel);
  _handle.send_rrd_to_channel(channel, Uint8Array.from(atob(text), sign => sign.charCodeAt(0)));
  _handle.close_channel(channel);
}"""


def main() -> int:
    """Make the pictures; exit code 1 if a view complains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--theme", choices=("dark", "light"), nargs="+", default=["dark", "light"])
    parser.add_argument("--tabs", nargs="+", help="of those whose name has one of these words")
    parser.add_argument("--step", type=int, default=60, help="where in the rollouts to look")
    parser.add_argument("--size", default="1280x800", help="of the pictures [pixels]")
    parser.add_argument("--settle", type=float, default=SETTLE_S, help="seconds before a picture")
    parser.add_argument("--browser", default="/usr/bin/chromium", help="Chromium's program")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    application, chunks = last_layout(arguments.recording)
    tabs = {
        name: active
        for name, active in tab_paths({chunk.entity_path: _fields(chunk) for chunk in chunks})
        if not arguments.tabs or any(word in name for word in arguments.tabs)
    }
    complaints: list[str] = []
    if "dark" in arguments.theme:
        complaints = dark_pictures(tabs, arguments)
    if "light" in arguments.theme:
        with tempfile.TemporaryDirectory() as folder:
            layouts = dict[str, bytes]()
            for name, active in tabs.items():
                path = Path(folder) / f"{name}.rbl"
                Layout([_with_active(one, active) for one in chunks]).save(application, path)
                layouts[name] = path.read_bytes()
        light_pictures(layouts, arguments)
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


def dark_pictures(
    tabs: Mapping[str, Mapping[str, str]], arguments: argparse.Namespace
) -> list[str]:
    """A picture of each of the open tabs; returns what views complain of."""
    complaints: list[str] = []
    with headless_viewer(arguments.size) as viewer:
        viewer.open(str(arguments.recording.resolve()))
        time.sleep(arguments.settle)
        layout = viewer.get_blueprint("recording").blueprint
        if layout["/time_panel"]["TimePanelBlueprint"].get("timeline") == paths.STEP:
            viewer.set_time(paths.STEP, sequence=arguments.step, play_state="paused")
        for name, active in tabs.items():
            for container, tab in active.items():
                layout[container]["ContainerBlueprint"]["active_tab"] = tab
            viewer.set_blueprint(layout, "recording")
            time.sleep(arguments.settle)
            keep(screenshot(viewer), arguments.out / f"{name}-dark.png")
            complaints += [
                f"{name}: {view.name}: {report.severity}: {report.summary}"
                for view in viewer.get_state().views
                for report in view.reports
            ]
    return sorted(set(complaints))


def light_pictures(layouts: Mapping[str, bytes], arguments: argparse.Namespace) -> None:
    """A picture of each layout, of the viewer in a browser."""
    width, height = map(int, arguments.size.split("x"))
    settle_s = BROWSER_FACTOR * arguments.settle
    with sync_playwright() as playwright, web_viewer(arguments.recording, port=0) as address:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
        page.set_default_timeout(WAIT_MS)
        with page.expect_response(lambda answer: answer.url.endswith("run.rrd")) as answer:
            page.goto(f"{address}&persist=0&hide_welcome_screen=1")
        answer.value.finished()
        settled(page, settle_s)
        left, right = TIME_AXIS[0], width - TIME_AXIS[1]
        share = min(arguments.step / last_step(arguments.recording), 1.0)
        page.mouse.click(left + share * (right - left), height - TIME_AXIS[2])
        for name, layout in layouts.items():
            page.evaluate(SEND, base64.b64encode(layout).decode())
            keep(settled(page, settle_s), arguments.out / f"{name}-light.png")
        browser.close()


def settled(page: Page, settle_s: float) -> bytes:
    """A picture of the page once it does not change any more."""
    before = b""
    for _ in range(MOST_WAITS):
        end = time.monotonic() + settle_s
        while time.monotonic() < end:  # the viewer draws, and reads on, when the mouse moves
            for place in RESTING_PLACES:
                page.mouse.move(*place)
                page.wait_for_timeout(FRAME_MS)
        picture = page.screenshot(timeout=WAIT_MS)
        if picture == before:
            break
        before = picture
    return before


def keep(picture: bytes, path: Path) -> None:
    """Keep a picture in few colours, which a README loads quickly."""
    shown = PIL.Image.open(io.BytesIO(picture)).convert("RGB")
    shown.quantize(COLORS, dither=PIL.Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)


def last_layout(recording: Path) -> tuple[str, list[Any]]:
    """The application that a recording's layouts are of, and the chunks of the newest."""
    reader = rr.chunk.RrdReader(recording)
    layouts = [(one.application_id, list(reader.stream(store=one))) for one in reader.blueprints()]
    return max(layouts, key=lambda layout: max(str(chunk.id) for chunk in layout[1]))


def last_step(recording: Path) -> int:
    """The last step that rollouts have."""
    batches = (
        chunk.to_record_batch()
        for chunk in rr.chunk.RrdReader(recording).stream()
        if chunk.entity_path.startswith(paths.plan(1)) and not chunk.is_static
    )
    return max((batch[paths.STEP].to_pylist()[-1] for batch in batches), default=1)


class Layout(rrb.Blueprint):
    """A layout as a recording holds it."""

    def __init__(self, chunks: list[Any]) -> None:
        self._chunks = chunks

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        stream.send_chunks(self._chunks)


def _fields(chunk: Any) -> dict[str, Any]:
    batch = chunk.to_record_batch()
    return {name: batch[name].to_pylist()[-1] for name in batch.schema.names}


def _with_active(chunk: Any, active: Mapping[str, str]) -> Any:
    if chunk.entity_path not in active:
        return chunk
    batch = chunk.to_record_batch()
    place = batch.schema.get_field_index(ACTIVE)
    tab = active[chunk.entity_path].lstrip("/")
    columns = list(batch.columns)
    columns[place] = pa.array([[tab]], type=batch.schema.field(place).type)
    changed = pa.RecordBatch.from_arrays(columns, schema=batch.schema)
    return rr.chunk.Chunk.from_record_batch(changed)[0]


def tab_paths(layout: Mapping[str, dict[str, Any]]) -> Iterator[tuple[str, dict[str, str]]]:
    """Name and open tabs (by container) of each picture: tabs within tabs too, the first and last.

    Of the many that are alike, as stages are, both ends tell what there is to see.
    """
    tabs = {path for path, fields in layout.items() if fields.get(ACTIVE)}
    held = {part for path in layout for part in _contents(layout, path)}
    (root,) = tabs - held
    for number, tab in enumerate(_contents(layout, root), start=1):
        name, inner = f"{number}-{_slug(layout[tab])}", next(_within(layout, tab, tabs), None)
        yield name, {root: tab}
        if inner is not None:
            ends = _contents(layout, inner)[1:2] + _contents(layout, inner)[-1:]
            for below in dict.fromkeys(ends):
                yield f"{name}-{_slug(layout[below])}", {root: tab, inner: below}


def _within(layout: Mapping[str, dict[str, Any]], path: str, tabs: set[str]) -> Iterator[str]:
    if path in tabs:
        yield path
    for part in _contents(layout, path):
        yield from _within(layout, part, tabs)


def _contents(layout: Mapping[str, dict[str, Any]], path: str) -> list[str]:
    return [f"/{part.lstrip('/')}" for part in layout.get(path, {}).get(CONTENTS) or []]


def _slug(fields: Mapping[str, Any]) -> str:
    title = next(fields[name][0] for name in NAMES if fields.get(name))
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


@contextmanager
def headless_viewer(size: str) -> Generator[ViewerClient, None, None]:
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
