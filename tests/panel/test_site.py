"""What the pages of our own and the server say to each other, over a real websocket."""

import json
import math
import threading

import pytest
import websockets.sync.client
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus

from pemviz.errors import InputError
from pemviz.panel.arguments import Arguments
from pemviz.panel.server import guarded_server
from pemviz.panel.site import OwnPages, dumps


class Shared:
    """A state that all pages are told of."""

    def __init__(self) -> None:
        self.version = 0


def refuse(page, asked):
    message = "wrong\nin two lines"
    raise InputError(message)


@pytest.fixture(scope="module")
def served():
    shared, block = Shared(), threading.Event()
    requests = {
        "echo": lambda page, asked: asked.text("words"),
        "refuse": refuse,
        "fail": lambda page, asked: 1 / 0,
        "wait": lambda page, asked: block.wait(30),
        "numbers": lambda page, asked: {"a": math.nan, "b": [math.inf, 1.5], "c": (1, None)},
    }
    pages = OwnPages(
        requests,
        version=lambda: shared.version,
        state=lambda: {"version": shared.version},
        download=lambda address: (f"{address}\r\nx", b"content"),
    )
    server = guarded_server(host="127.0.0.1", port=0, site=pages)
    yield server.get_port(), shared, block
    block.set()
    server.stop()


def connected(port, *, path="/talk", origin=None):
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{port}{path}", origin=origin or f"http://127.0.0.1:{port}", proxy=None
    )


def answer(socket, number):
    while True:
        message = json.loads(socket.recv(timeout=20))
        if "id" in message and message["id"] == number:
            return message


def talk(port):
    socket = connected(port)
    socket.send(json.dumps({"token": "t"}))
    return socket


def test_a_page_is_answered_and_what_is_wrong_is_one_line(served):
    with talk(served[0]) as socket:
        socket.send(json.dumps({"id": 1, "ask": "echo", "with": {"words": "\u00fc"}}))
        assert answer(socket, 1) == {"id": 1, "answer": "\u00fc"}
        socket.send(json.dumps({"id": 2, "ask": "refuse"}))
        assert answer(socket, 2) == {"id": 2, "wrong": "wrong in two lines"}
        socket.send(json.dumps({"id": 3, "ask": "fail"}))
        assert "division" in answer(socket, 3)["wrong"]
        socket.send(json.dumps({"id": 4, "ask": "numbers"}))
        assert answer(socket, 4)["answer"] == {"a": None, "b": [None, 1.5], "c": [1, None]}


@pytest.mark.parametrize("nonsense", ["", "{", "[]", "3", '{"id":1}', '{"id":1,"ask":"no"}',
    '{"id":1,"ask":"echo","with":3}', '{"id":1,"ask":["echo"]}'])  # fmt: skip
def test_nonsense_is_refused_and_the_conversation_goes_on(served, nonsense):
    with talk(served[0]) as socket:
        socket.send(nonsense)
        assert "not understood" in answer(socket, None)["wrong"]
        socket.send(json.dumps({"id": 5, "ask": "echo", "with": {"words": "on"}}))
        assert answer(socket, 5)["answer"] == "on"


@pytest.mark.parametrize("first", ["", "3", "[]", "{}", '{"token": 3}'])
def test_a_page_without_a_token_is_not_talked_to(served, first):
    with connected(served[0]) as socket:
        socket.send(first)
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=20)


def test_foreign_pages_and_other_addresses_get_no_websocket(served):
    port = served[0]
    for path, origin, status in (("/talk", "http://evil.example", 403), ("/other", None, 404)):
        with pytest.raises(InvalidStatus) as caught:
            connected(port, path=path, origin=origin)
        assert caught.value.response.status_code == status


def test_every_page_is_told_of_a_change(served):
    port, shared, _ = served
    with talk(port) as one, talk(port) as other:
        shared.version += 1
        for socket in (one, other):
            while json.loads(socket.recv(timeout=20))["state"]["version"] != shared.version:
                pass


def test_a_request_that_takes_long_keeps_no_other_waiting(served):
    port, _, block = served
    with talk(port) as socket:
        socket.send(json.dumps({"id": 1, "ask": "wait"}))
        socket.send(json.dumps({"id": 2, "ask": "echo", "with": {"words": "now"}}))
        assert answer(socket, 2)["answer"] == "now"
        block.set()
        assert answer(socket, 1)["answer"] is True


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(json_values)
def test_whatever_is_said_is_json_that_browsers_read(value):
    def refused(word):
        raise AssertionError(word)

    json.loads(dumps(value), parse_constant=refused)


@given(json_values)
def test_arguments_are_of_their_kind_or_refused(value):
    asked = Arguments({"x": value})
    for read, holds in (
        (lambda: asked.text("x"), lambda v: isinstance(v, str)),
        (lambda: asked.choice("x", ("a", "b")), lambda v: v in ("a", "b")),
        (lambda: asked.number("x", -2, 3), lambda v: -2 <= v <= 3),
        (lambda: asked.whole("x", 0, 9), lambda v: isinstance(v, int) and 0 <= v <= 9),
        (lambda: asked.flag("x"), lambda v: v is True or v is False),
        (lambda: asked.texts("x", 2), lambda v: len(v) <= 2 and all(type(t) is str for t in v)),
    ):
        try:
            found = read()
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert holds(found)
