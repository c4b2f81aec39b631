"""The pages of pemviz' own: their files, and what they say to the server and hear of it.

A page talks over one websocket, in JSON: ``{"id": 3, "ask": "ranking", "with": {...}}`` is answered
by ``{"id": 3, "answer": ...}`` or, where it cannot be, by ``{"id": 3, "wrong": "one line"}``.
Without being asked the server tells a page when the state that all share has changed:
``{"state": {...}}``. What a page shows is in its address, so the server keeps nothing of it but
its scene.
"""

import asyncio
import http
import json
import logging
import threading
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

import viser
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

from pemviz.errors import InputError, PemvizError
from pemviz.panel.arguments import Arguments
from pemviz.panel.page_scene import PageScene
from pemviz.reports.html import SHEET

LOG = logging.getLogger(__name__)

Json = Any
"""What JSON can say."""
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; frame-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""Nothing is fetched from elsewhere, and no text of a run can act."""
LARGEST_MESSAGE = 1_000_000
AT_ONCE = 4
"""Requests of a page that are worked on at the same time."""
LOOK_S = 0.05
"""How long after the shared state has changed a page hears of it, at most."""
PAGES = frozenset(("/", "/index.html"))


class Page:
    """An open page: its scene, and which state it has been told of."""

    def __init__(self, token: str, scene: PageScene) -> None:
        self.token = token
        self.scene = scene


Request = Callable[[Page, Arguments], Json]


class OwnPages:
    """Serves the pages' files, and answers the pages.

    Args of the constructor: what can be asked for by name; the version of the shared state and
    what it is; and where downloads come from, by the address behind ``/files/``.
    """

    def __init__(
        self,
        requests: Mapping[str, Request],
        *,
        version: Callable[[], int],
        state: Callable[[], Json],
        download: Callable[[str], tuple[str, bytes]],
    ) -> None:
        self._requests = requests
        self._version, self._state, self._download = version, state, download
        self._files = _files()
        self._scenes: dict[str, tuple[PageScene, int]] = {}
        self._lock = threading.Lock()

    def respond(self, connection: ServerConnection, path: str) -> Response:
        """A file of the pages, or one to download.

        Every place of the page is behind the number sign of its address: the path is always /.
        """
        if path.startswith("/files/"):
            return self._respond_file(connection, path.removeprefix("/files/"))
        found = self._files.get("/index.html" if path in PAGES else path)
        if found is None:
            return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no such page\n")
        kind, content = found
        return _response(content, kind, {"Cache-Control": "no-cache"})

    def _respond_file(self, connection: ServerConnection, address: str) -> Response:
        try:
            name, content = self._download(address)
        except InputError as error:
            return connection.respond(http.HTTPStatus.NOT_FOUND, f"{error}\n")
        safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in name)
        disposition = {"Content-Disposition": f'attachment; filename="{safe}"'}
        return _response(content, "application/octet-stream", disposition)

    async def talk(self, connection: ServerConnection) -> None:
        """Answer a page until it goes; the first message says which scene is its own."""
        try:
            hello = json.loads(await asyncio.wait_for(connection.recv(), 10.0))
            token = Arguments(hello).text("token")
        except (ValueError, TypeError, AttributeError, InputError, TimeoutError, ConnectionClosed):
            await connection.close(1002, "a page says its token first")
            return
        page = Page(token, self._scene(token, by=1))
        telling = asyncio.create_task(self._tell(connection))
        try:
            await self._answer_all(connection, page)
        except ConnectionClosed:
            pass
        finally:
            telling.cancel()
            self._scene(token, by=-1)

    def connect_scene(self, token: str, client: viser.ClientHandle) -> None:
        """A view of viser's within the page of a token is there."""
        self._scene(token, by=1).connect(client)

    def disconnect_scene(self, token: str, client: viser.ClientHandle) -> None:
        """It is gone."""
        scene = self._scene(token, by=-1)
        scene.disconnect(client)

    def _scene(self, token: str, *, by: int) -> PageScene:
        """The scene of a token, of page and view together; closed when both are gone."""
        with self._lock:
            scene, count = self._scenes.get(token, (None, 0))
            if scene is None:
                scene = PageScene()
            if count + by > 0:
                self._scenes[token] = (scene, count + by)
            else:
                self._scenes.pop(token, None)
                scene.close()
            return scene

    async def _answer_all(self, connection: ServerConnection, page: Page) -> None:
        free, tasks = asyncio.Semaphore(AT_ONCE), set[asyncio.Task[None]]()
        async for message in connection:
            if len(message) > LARGEST_MESSAGE:
                await connection.close(1009, "too large")
                return
            await free.acquire()
            task = asyncio.create_task(self._answer(connection, page, message))
            tasks.add(task)
            task.add_done_callback(tasks.discard)
            task.add_done_callback(lambda _: free.release())

    async def _answer(self, connection: ServerConnection, page: Page, message: str | bytes) -> None:
        reply = await asyncio.to_thread(self._reply, page, message)
        if reply is not None:
            try:
                await connection.send(reply)
            except ConnectionClosed:
                LOG.debug("a page went before it was answered")

    def _reply(self, page: Page, message: str | bytes) -> str | None:
        try:
            asked = json.loads(message)
            number, name, arguments = asked["id"], asked["ask"], asked.get("with", {})
            request = self._requests[name]
            arguments = Arguments(dict(arguments))
        except (ValueError, TypeError, KeyError, AttributeError):
            return json.dumps({"id": None, "wrong": "this request is not understood"})
        try:
            return dumps({"id": number, "answer": request(page, arguments)})
        except PemvizError as error:
            return dumps({"id": number, "wrong": " ".join(str(error).split())})
        except Exception as error:  # one request's trouble must not end the page
            LOG.exception("a page's request failed")
            return dumps({"id": number, "wrong": f"{type(error).__name__}: {error}"})

    async def _tell(self, connection: ServerConnection) -> None:
        """Tell of every change of the shared state, the newest alone."""
        told = -1
        while True:
            version = self._version()
            if version != told:
                told = version
                words = await asyncio.to_thread(lambda: dumps({"state": self._state()}))
                await connection.send(words)
            await asyncio.sleep(LOOK_S)


def dumps(value: Json) -> str:
    """JSON that every browser reads: numbers that are none become null."""
    return json.dumps(_finite(value), separators=(",", ":"), ensure_ascii=False)


def _finite(value: Json) -> Json:
    match value:
        case float():
            return value if value - value == 0.0 else None
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list() | tuple():
            return [_finite(item) for item in value]
        case _:
            return value


def _response(content: bytes, kind: str, more: Mapping[str, str]) -> Response:
    headers = Headers(
        {"Content-Type": kind, "Content-Length": str(len(content)), **more,
         "Content-Security-Policy": POLICY}
    )  # fmt: skip
    return Response(http.HTTPStatus.OK.value, http.HTTPStatus.OK.phrase, headers, content)


def _files() -> dict[str, tuple[str, bytes]]:
    """The pages' files by address, with their kinds: the few that there are, read once."""
    found: dict[str, tuple[str, bytes]] = {}
    web = files("pemviz.panel") / "web"
    for folder, address in ((web, "/"), (web / "vendor", "/vendor/")):
        for file in folder.iterdir():
            kind = KINDS.get("." + file.name.rsplit(".", 1)[-1])
            if kind is not None and file.is_file():
                found[address + file.name] = (kind, file.read_bytes())
    found["/document.css"] = (KINDS[".css"], SHEET.encode())
    return found
