"""Foreign pages, other names of this machine, taken ports, and the share feature."""

import http.client
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import viser
import viser._messages as messages
import viser._viser as implementation
import websockets.asyncio.server
import websockets.sync.client
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request

from pemviz.errors import InputError
from pemviz.panel.server import HEADERS, allowed_hosts, guarded_server, is_loopback, refusal
from pemviz.panel.site import POLICY, OwnPages

ROOT = Path(__file__).resolve().parents[2]
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def server():
    pages = OwnPages(
        {}, version=lambda: 0, state=lambda: None, download=lambda address: (address, b"")
    )
    made = guarded_server(host="127.0.0.1", port=0, site=pages)
    yield made
    made.stop()


def request(*, headers):
    return Request("/", Headers(headers))


def get(port, *, path="/", headers=None):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", path, headers=headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def connect(port, *, origin, host=None):
    additional = None if host is None else {"Host": host}
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{port}/scene/x", origin=origin, subprotocols=[PROTOCOL],
        additional_headers=additional, max_size=None, compression=None, proxy=None,
    )  # fmt: skip


def test_own_page_and_its_websocket_are_served(server):
    port = server.get_port()
    for path in ("/", "/scene/x"):
        status, body = get(port, path=path)
        assert status == 200
        assert b"<html" in body
    for name in ("127.0.0.1", "localhost"):
        status, _ = get(port, headers={"Host": f"{name}:{port}"})
        assert status == 200
    with connect(port, origin=f"http://127.0.0.1:{port}") as socket_:
        assert socket_.recv(timeout=10)


def test_answers_tell_browsers_to_frame_nothing_and_guess_nothing(server):
    own = HEADERS | {"Content-Security-Policy": POLICY}
    for path, wanted, headers in (
        ("/", 200, own), ("/scene/x", 200, HEADERS), ("/nowhere", 404, HEADERS),
    ):  # fmt: skip
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
        connection.request("GET", path)
        answer = connection.getresponse()
        assert answer.status == wanted
        for name, value in headers.items():
            assert answer.getheader(name) == value
        connection.close()


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1",
     "http://localhost:{port}", "http://127.0.0.1:{port}.evil.example", None],
)  # fmt: skip
def test_foreign_origins_get_no_websocket(server, origin):
    port = server.get_port()
    named = None if origin is None else origin.format(port=port)
    with pytest.raises(InvalidStatus) as caught:
        connect(port, origin=named)
    assert caught.value.response.status_code == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1.nip.io:{port}"])
def test_rebound_names_get_nothing(server, host):
    port = server.get_port()
    named = host.format(port=port)
    status, body = get(port, headers={"Host": named})
    assert status == 403
    assert b"html" not in body
    # the browser of a rebound page sends matching Host and Origin
    key = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
           "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Host": named,
           "Origin": f"http://{named}"}  # fmt: skip
    status, _ = get(port, headers=key)
    assert status == 403


@pytest.mark.parametrize(
    "path", ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/setup.py", "/..%5c..%5csecret", "/assets"]
)
def test_no_file_outside_the_page_is_served(server, path):
    status, _ = get(server.get_port(), path=path)
    assert status == 404


def test_an_upgrade_in_other_letters_is_guarded_too():
    hosts = allowed_hosts("127.0.0.1", 8080)
    own = [("Host", "127.0.0.1:8080")]
    assert refusal(request(headers=own), hosts=hosts) is None
    assert refusal(request(headers=[*own, ("Upgrade", "WebSocket")]), hosts=hosts) is not None
    assert refusal(request(headers=[]), hosts=hosts) is not None
    assert refusal(request(headers=own * 2), hosts=hosts) is not None


def test_a_wide_address_answers_numbers_but_no_names():
    hosts = allowed_hosts("0.0.0.0", 8080)  # noqa: S104
    assert hosts is None
    for host, answered in (("192.168.1.5:8080", True), ("localhost:8080", True),
                           ("[fe80::1]:8080", True), ("evil.example:8080", False)):  # fmt: skip
        headers = [("Host", host), ("Upgrade", "websocket"), ("Origin", f"http://{host}")]
        assert (refusal(request(headers=headers), hosts=hosts) is None) == answered


def test_loopback_names():
    for host in ("127.0.0.1", "127.8.8.8", "localhost", "::1"):
        assert is_loopback(host)
    for host in ("::", "192.168.1.5", "example.org"):
        assert not is_loopback(host)


def test_a_taken_port_is_an_error_that_names_it(server):
    port = server.get_port()
    with pytest.raises(InputError, match=f"port = {port}: cannot be had"):
        guarded_server(host="127.0.0.1", port=port)


def test_a_foreign_address_is_an_error():
    with pytest.raises(InputError, match=r"cannot be had on|is no address"):
        guarded_server(host="192.0.2.1", port=0)
    with pytest.raises(InputError, match="is no address of this machine"):
        guarded_server(host="no.such.host.invalid", port=0)


def test_viser_listens_on_the_guarded_socket_alone(server):
    assert websockets.asyncio.server.serve.__name__ == "serve"
    with socket.socket() as probe:
        probe.settimeout(2.0)
        assert probe.connect_ex(("127.0.0.1", server.get_port())) == 0


def test_a_share_request_reaches_no_tunnel(server, monkeypatch):
    tunnels = []
    monkeypatch.setattr(implementation, "ViserTunnel", lambda *a, **o: tunnels.append(a))
    (handler,) = server._websock_server._incoming_handlers[messages.ShareUrlRequest]
    handler(0, messages.ShareUrlRequest())
    assert server.request_share_url() is None
    server._thread_executor.submit(lambda: None).result(timeout=10)
    assert server._share_tunnel is None
    assert tunnels == []


def serve(*words, timeout=60):
    return subprocess.run(
        [sys.executable, "-m", "pemviz", "serve", "--no-browser", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False,
    )  # fmt: skip


def test_serve_ends_with_code_2_on_a_taken_port(server, tmp_path):
    port = str(server.get_port())
    done = serve("--port", port, "--recordings", str(tmp_path))
    assert done.returncode == 2
    assert f"port = {port}" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("words", [("--port", "70000"), ("--port", "x"), ("--hots", "1")])
def test_serve_ends_with_code_2_on_bad_options(words, tmp_path):
    done = serve(*words, "--recordings", str(tmp_path))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1


def test_servers_that_start_at_once_are_all_guarded():
    made = []

    def start():
        made.append(guarded_server(host="127.0.0.1", port=0))

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    try:
        assert len(made) == 4
        assert [get(one.get_port())[0] for one in made] == [403] * 4
    finally:
        for one in made:
            one.stop()
