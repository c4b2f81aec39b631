"""A client that speaks viser's protocol without drawing: for many at once."""

import random
import threading
import time

import msgspec.msgpack
import viser
import websockets.sync.client
import zstandard
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
LEFT_ALONE = ("Run", "Stop", "Delete it for good")  # what changes the experiment itself


class LightClient:
    """Connects, changes controls at random, leaves."""

    def __init__(self, port: int, *, seed: int) -> None:
        self._random = random.Random(seed)  # noqa: S311  not for secrets
        self._socket = websockets.sync.client.connect(
            f"ws://127.0.0.1:{port}/scene/form", origin=f"http://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None,
            proxy=None,
        )  # fmt: skip
        self.controls: dict[str, dict] = {}
        self.commands: list[str] = []
        self.texts: dict[str, str] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._send(CAMERA)

    def wait_for(self, label: str, *, timeout_s: float = 60.0) -> str:
        """The id of a control."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            for uuid, control in list(self.controls.items()):
                if control["props"].get("label") == label:
                    return uuid
            time.sleep(0.02)
        raise TimeoutError(label)

    def wait_for_text(self, words: str, *, timeout_s: float = 60.0) -> None:
        """Wait until some element shows the words."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if any(words in text for text in list(self.texts.values())):
                return
            time.sleep(0.02)
        raise TimeoutError(words)

    def press(self, label: str) -> None:
        """Press a button."""
        self._update(self.wait_for(label), True)

    def act(self) -> None:
        """Change one control, or trigger a key, at random."""
        if self.commands and self._random.random() < 0.2:
            uuid = self._random.choice(self.commands)
            self._send({"type": "CommandTriggerMessage", "uuid": uuid})
            return
        uuid, control = self._random.choice(list(self.controls.items()))
        if control["props"].get("label") not in LEFT_ALONE:
            self._update(uuid, self._value(control))

    def close(self) -> None:
        """Leave."""
        self._socket.close()
        self._reader.join(10.0)

    def _value(self, control):
        props, kind, chance = control["props"], control["type"], self._random
        if kind in ("GuiDropdownMessage", "GuiButtonGroupMessage"):
            return chance.choice([*props["options"], "../../etc/passwd"])
        if kind == "GuiSliderMessage":
            return chance.uniform(props["min"], props["max"])
        if kind == "GuiNumberMessage":
            return chance.randint(1, 300)
        if kind == "GuiTextMessage":
            return chance.choice(["always[0,99] (gap >= 1.5)", "always[0,9", "", "gap > 1"])
        return chance.random() < 0.5

    def _update(self, uuid, value):
        self._send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def _send(self, message):
        self._socket.send(msgspec.msgpack.encode(message))

    def _read(self):
        decompressor = zstandard.ZstdDecompressor()
        try:
            for raw in self._socket:
                size = int.from_bytes(raw[8:16], "little")
                inner = msgspec.msgpack.decode(decompressor.decompress(raw[16 : 16 + size]))
                for message in inner["messages"]:
                    self._note(message)
        except ConnectionClosed:
            pass

    def _note(self, message):
        kind = message["type"]
        interactive = ("Button", "ButtonGroup", "Dropdown", "Slider", "Number", "Text", "Checkbox")
        if kind in [f"Gui{name}Message" for name in interactive]:
            self.controls[message["uuid"]] = message
        elif kind == "RegisterCommandMessage":
            self.commands.append(message["uuid"])
        elif kind == "GuiUpdateMessage" and "content" in message["updates"]:
            self.texts[message["uuid"]] = message["updates"]["content"]
