"""A viser server that binds one address, answers only its own pages, and shares nothing.

Pages of pemviz' own stand on the same port, beside viser's, which shows scenes: what a page asks
for is answered by :mod:`pemviz.panel.site`.
"""

import contextlib
import http
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Generator
from typing import Any, Protocol, cast
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from pemviz.errors import InputError

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")

HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'self'",
    "X-Frame-Options": "SAMEORIGIN",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
"""Of every response that has none of its own: no page of others may frame it."""
SCENES = "/scene/"
"""Where viser's page stands: what follows tells whose scene it is."""
TALK = "/talk"
"""Where a page of our own talks to the server."""


class Site(Protocol):
    """The pages beside viser's."""

    def respond(self, connection: ServerConnection, path: str) -> Response:
        """The file at a path without its query."""
        ...

    async def talk(self, connection: ServerConnection) -> None:
        """Answer a page until it goes."""
        ...


_PATCH = threading.Lock()
_SERVE = websockets.asyncio.server.serve


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return False


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket bound to exactly this address.

    Raises:
        InputError: The port is taken or the host is none of this machine's.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host.strip("[]"), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        message = f"host = {host!r}: is no address of this machine ({error.strerror or error})"
        raise InputError(message) from error
    listening = socket.socket(family, kind, protocol)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        listening.close()
        message = f"port = {port}: cannot be had on {host} ({error.strerror or error})"
        raise InputError(message) from error
    return listening


def allowed_hosts(host: str, port: int) -> frozenset[str] | None:
    """Values of the Host header that are answered; ``None`` if the address has many names.

    A page of another site that has its name point to this machine (DNS rebinding) still
    sends its own name as Host, and so is refused.
    """
    if is_loopback(host):
        return frozenset(f"{name}:{port}" for name in LOOPBACK_NAMES)
    if host in ("0.0.0.0", "::", "[::]"):  # noqa: S104  compared with, not bound to
        return None
    return frozenset({f"{host}:{port}"})


def refusal(request: Request, *, hosts: frozenset[str] | None) -> str | None:
    """Why a request is refused, or ``None``: a foreign Host, or a foreign Origin."""
    named = request.headers.get_all("Host")
    if len(named) != 1:
        return "exactly one Host header is wanted"
    host = named[0].lower()
    if hosts is not None and host not in hosts:
        return "this host name is not served here"
    if hosts is None and not _is_address(host):
        return "use this machine's address, not a name"
    origins = request.headers.get_all("Origin")
    upgrading = "websocket" in (request.headers.get("Upgrade") or "").lower()
    if upgrading and len(origins) != 1:
        return "a websocket must come from a page, with one Origin header"
    for origin in origins:
        parts = urlsplit(origin)
        if parts.scheme != "http" or parts.netloc.lower() != host:
            return "pages of another origin are not served here"
    return None


def _is_address(host: str) -> bool:
    """Whether a Host header names a numeric address or localhost."""
    name = urlsplit(f"//{host}").hostname or ""
    if name == "localhost":
        return True
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False


def guarded_server(*, host: str, port: int, site: Site | None = None) -> viser.ViserServer:
    """Start a viser server behind the guard.

    Args:
        host: Address to bind.
        port: Port to bind; 0 takes any free one.
        site: The pages at its addresses but those of scenes; without one every request is
            refused: for a server that only builds scenes.

    Raises:
        InputError: The address cannot be bound.
    """
    listening = bound_socket(host, port)
    bound_port = int(listening.getsockname()[1])
    hosts = frozenset[str]() if site is None else allowed_hosts(host, bound_port)
    with (
        _guarding(listening, hosts=hosts, site=site) as guarded,
        contextlib.redirect_stdout(io.StringIO()),
    ):
        server = viser.ViserServer(host=host, port=bound_port, verbose=False)
    if not guarded() or server.get_port() != bound_port:
        server.stop()
        message = "this version of viser cannot be guarded against foreign pages"
        raise InputError(message)
    # hiding the button is not enough: a crafted message would still reach the method
    server.request_share_url = _no_share  # pyright: ignore[reportAttributeAccessIssue]
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    return server


def _no_share(verbose: bool = True) -> None:
    """Take the place of viser's public tunnel."""


@contextlib.contextmanager
def _guarding(
    listening: socket.socket, *, hosts: frozenset[str] | None, site: Site | None
) -> Generator[Callable[[], bool], None, None]:
    """While a viser server starts, have it listen on our socket behind our guard.

    viser passes neither origins nor a socket on to websockets, and moves to another port
    if its own is taken.
    """
    used = threading.Event()

    def guarded_serve(ws_handler: Any, host: Any, port: Any, **options: Any) -> Any:  # noqa: ARG001
        inner = options.pop("process_request")

        def process(connection: ServerConnection, request: Request) -> Any:
            reason = refusal(request, hosts=hosts)
            if reason is not None or site is None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            path = urlsplit(request.path).path
            if "websocket" in (request.headers.get("Upgrade") or "").lower():
                known = path == TALK or path.startswith(SCENES)
                return None if known else connection.respond(http.HTTPStatus.NOT_FOUND, "\n")
            if path.startswith(SCENES):
                request.path = "/"  # viser's page is one file
                return inner(connection, request)
            return site.respond(connection, path)

        async def handle(connection: ServerConnection) -> None:
            request = connection.request
            if site is not None and request is not None and urlsplit(request.path).path == TALK:
                await site.talk(connection)
            else:
                await ws_handler(connection)

        options.update(process_request=process, process_response=add_headers)
        used.set()
        return _SERVE(handle, sock=listening, **options)

    with _PATCH:
        module = cast(Any, websockets.asyncio.server)
        module.serve = guarded_serve
        try:
            yield used.is_set
        finally:
            module.serve = _SERVE


def add_headers(connection: ServerConnection, request: Request, response: Response) -> None:  # noqa: ARG001
    """Tell the browser that no page of others may frame this one, nor guess what a file is."""
    for name, value in HEADERS.items():
        if name not in response.headers:
            response.headers[name] = value


def scene_of(server: viser.ViserServer, client: viser.ClientHandle) -> str:
    """What follows :data:`SCENES` in the address that a client of viser's connected to."""
    connections = cast(Any, server)._websock_server._live_connections
    connection = connections.get(client.client_id)
    return "" if connection is None else connection.request.path.removeprefix(SCENES)
