"""A page and its scene without a browser, for many at once: it asks, hears, and draws nothing."""

import json
import random
import threading
import time
import uuid

import msgspec.msgpack
import viser
import websockets.sync.client
from websockets.exceptions import ConnectionClosed

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 0.7,
    "near": 0.1,
    "far": 1000.0,
    "image_height": 800,
    "image_width": 780,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
PAGES = ("uncertainty", "learning", "weights", "why", "metrics", "next", "record", "nonsense")
NONSENSE = (None, -1, 1e9, "../../etc/passwd", "", [], {"a": 1}, "\u2212\u00b5<b>")


class LightClient:
    """Connects a page and a scene, asks at random, leaves."""

    def __init__(self, port: int, *, seed: int) -> None:
        self._random = random.Random(seed)  # noqa: S311  not for secrets
        self._port, self._number = port, 0
        token = str(uuid.uuid4())
        self._talk, self._scene = self._connect("/talk"), self._connect(f"/scene/{token}")
        self.state, self.runs, self.unhappy = {}, [], 0
        self._answers = {}
        self._changed = threading.Condition()
        self._readers = [
            threading.Thread(target=work, daemon=True) for work in (self._read, self._drain)
        ]
        for reader in self._readers:
            reader.start()
        self._talk.send(json.dumps({"token": token}))
        self._scene.send(msgspec.msgpack.encode(CAMERA))

    def _connect(self, path: str):
        return websockets.sync.client.connect(
            f"ws://127.0.0.1:{self._port}{path}", origin=f"http://127.0.0.1:{self._port}",
            subprotocols=[f"viser-v{viser.__version__}"] if path != "/talk" else None,
            max_size=None, compression=None, proxy=None,
        )  # fmt: skip

    def ask(self, name: str, *, timeout_s: float = 120.0, **arguments):
        """What the server answers."""
        self._number += 1
        self._talk.send(json.dumps({"id": self._number, "ask": name, "with": arguments}))
        with self._changed:
            assert self._changed.wait_for(lambda: self._number in self._answers, timeout_s), name
            return self._answers.pop(self._number)

    def wait_until_idle(self, *, timeout_s: float = 60.0) -> None:
        """Wait for a state in which nothing runs."""
        with self._changed:
            idle = self._changed.wait_for(lambda: self.state.get("running") is False, timeout_s)
        if not idle:
            raise TimeoutError(self.state)

    def act(self) -> None:
        """Ask for something a person would, or for nonsense."""
        chance, run = self._random, self._random.choice([*self.runs, self.state.get("run")])
        choice = {"run": run, "among": chance.choice(["all", "carrying"])}
        asks = (
            ("ranking", {**choice, "start": chance.randint(0, 50)}),
            ("rollout", {**choice, "rank": chance.randint(1, 99), "width": 500, "step": -1}),
            ("step", {"step": chance.randint(0, 99), "follow": True}),
            ("look", {"move": True, "view": "from above", "dark": chance.random() < 0.5}),
            ("page", {"run": run, "page": chance.choice(PAGES)}),
            ("check", {"preset": "paper", "values": {"sigma": str(chance.uniform(-1, 2))}}),
            ("runs", {}),
            (chance.choice(["open", "rollout", "pick", "note"]), {"run": chance.choice(NONSENSE)}),
        )
        name, arguments = chance.choice(asks)
        answer = self.ask(name, **arguments)
        if name == "runs":
            self.runs = [row["name"] for row in answer["answer"]["rows"]]
        self.unhappy += "wrong" in answer

    def close(self) -> None:
        """Leave."""
        self._talk.close()
        self._scene.close()
        for reader in self._readers:
            reader.join(10.0)

    def _read(self) -> None:
        try:
            for raw in self._talk:
                message = json.loads(raw)
                with self._changed:
                    if "state" in message:
                        self.state = message["state"]
                    else:
                        self._answers[message["id"]] = message
                    self._changed.notify_all()
        except ConnectionClosed:
            pass

    def _drain(self) -> None:
        try:
            for _ in self._scene:
                time.sleep(0)
        except ConnectionClosed:
            pass
