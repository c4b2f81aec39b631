"""A real Chromium, the panel in this process, and a screenshot of every flow."""

import os
import re
import shutil
import threading
from pathlib import Path

import pytest

from pemviz.panel.app import App, show_something
from pemviz.panel.controller import Controller
from pemviz.panel.hub import Hub
from pemviz.panel.loading import load_run
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.runs.events import StageDone
from tests.panel.conftest import SMALL, wait_until

ARGUMENTS = [
    "--no-sandbox",  # CI runs as root; only this machine's own page is opened
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",  # Debian's Chromium asks for it; without a GPU it is slow
]
LIGHTER_PICTURES = """
const soon = window.requestAnimationFrame.bind(window);
const asked = new Map();
let count = 0, waiting = false;
const drawAll = (now) => {
  const due = [...asked.values()];
  asked.clear();
  setTimeout(() => { waiting = false; if (asked.size) ask(); }, 400);
  due.forEach((draw) => draw(now));
};
const ask = () => { if (!waiting) { waiting = true; soon(drawAll); } };
window.requestAnimationFrame = (draw) => { asked.set(++count, draw); ask(); return count; };
const contextOf = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, how) {
  return contextOf.call(this, kind, kind.startsWith("webgl") ? { ...how, antialias: false } : how);
};
window.cancelAnimationFrame = (which) => { asked.delete(which); };
"""
"""Without a GPU a smoothed picture takes seconds of a core: pages draw unsmoothed, twice a second.

What they draw, and when they ask for it, is theirs.
"""
VIEWPORT = {"width": 1280, "height": 720}
WAIT_MS = 120_000
VISERS_OWN = re.compile(r"THREE|WebGL|viser|Connect|chrome version|ViewerCamera", re.IGNORECASE)
"""What viser's page says on its console, of software rendering and of servers that go."""


def absent(reason: str):
    """Skip on a user's machine; fail where a browser must be."""
    if os.environ.get("PEMVIZ_REQUIRE_BROWSER") == "1":
        pytest.fail(f"a browser must be here: {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="module")
def chromium():
    try:
        from playwright.sync_api import expect, sync_playwright  # noqa: PLC0415  may be absent
    except ImportError:
        absent("playwright is not installed (pip install playwright)")
    expect.set_options(timeout=WAIT_MS)  # a machine that is busy is slow, not wrong
    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        names = ("chromium", "chromium-browser", "google-chrome")
        program = own if Path(own).exists() else next(filter(None, map(shutil.which, names)), None)
        if program is None:
            absent("no Chromium (apt-get install chromium, or playwright install chromium)")
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def shots(tmp_path_factory) -> Path:
    """Where screenshots go; ``PEMVIZ_SCREENSHOTS`` names another folder."""
    named = os.environ.get("PEMVIZ_SCREENSHOTS")
    folder = Path(named) if named else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def first_run(tmp_path_factory) -> Path:
    """A small adaptive run in a recordings folder."""
    root = tmp_path_factory.mktemp("first")
    controller = Controller(root)
    controller.start(SMALL)
    state = wait_until(controller)
    controller.close()
    assert state.run is not None
    assert state.run.folder is not None
    return state.run.folder


class Gate:
    """Observer that holds a run after each stage while it is shut."""

    def __init__(self) -> None:
        self._open = threading.Event()
        self.open()

    def open(self) -> None:
        self._open.set()

    def shut(self) -> None:
        self._open.clear()

    def notify(self, event) -> None:
        if isinstance(event, StageDone):
            self._open.wait(WAIT_MS / 1000)


class Panel:
    """The panel under test."""

    def __init__(self, root: Path, *, port: int = 0, open_recording=None) -> None:
        self.root = root
        self.gate = Gate()
        self.controller = Controller(root, observers=lambda folder: [self.gate])
        recordings = RecordingsFolder(root)
        hub = Hub(self.controller, recordings, open_recording=open_recording)
        self.app = App(hub, host="127.0.0.1", port=port)
        show_something(self.controller, recordings)
        for name in recordings.names()[:1]:  # rather than the shipped sample
            self.controller.show(load_run(root / name))
        self.pages = f"http://127.0.0.1:{self.app.port}"

    def close(self) -> None:
        self.gate.open()
        self.controller.close()
        self.app.stop()


@pytest.fixture
def panel(tmp_path, first_run):
    root = tmp_path / "recordings"
    shutil.copytree(first_run, root / first_run.name)
    made = Panel(root)
    yield made
    made.close()


def complaint(message) -> list[str]:
    """What the console tells of trouble that is ours."""
    ours = message.type in ("error", "warning") and not VISERS_OWN.search(message.text)
    return [message.text] if ours else []


@pytest.fixture
def open_page(chromium, panel):
    """Opens a place of the panel, if any, in a new browser context; its console must stay clean."""
    contexts, complaints = [], []

    def open_one(place):
        context = chromium.new_context(viewport=VIEWPORT)
        contexts.append(context)
        context.add_init_script(LIGHTER_PICTURES)
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda message: complaints.extend(complaint(message)))
        if place is not None:
            page.goto(f"{panel.pages}/#/{place}")
            page.locator(".values" if place.startswith("run/") else "main").wait_for()
        return page

    yield open_one
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def page(open_page):
    """A page that shows nothing yet."""
    return open_page(None)
