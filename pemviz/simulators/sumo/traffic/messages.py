"""What SUMO's process and the simulator around it tell each other, without libsumo or numpy."""

import socket
import struct
import weakref
from dataclasses import dataclass

SLOTS = ("first", "second", "third")
OTHERS = ("other1", "other2", "other3", "other4")
"""Cars that perception is not about: for pictures."""
OF_SLOT = ("gap", "aside", "speed", "heading")
OF_OTHER = ("gap", "aside", "speed")
OF_EGO = (
    "distance",
    "ego_speed",
    "ego_acceleration",
    "wanted_speed",
    "clearance",
    "safe_distance",
    "needless_deceleration",
    "collided",
)
NOBODY_M = 500.0
"""Gap, clearance and margin where there is nobody."""
NAMES = (
    *OF_EGO,
    *(f"{what}_{slot}" for slot in SLOTS for what in OF_SLOT),
    *(f"{what}_{other}" for other in OTHERS for what in OF_OTHER),
)
"""Of all signals, in the order in which SUMO's process tells them."""
RESET, STEP = b"r", b"s"
RUNNING, ENDED, WRONG = b"v", b"e", b"!"
"""First byte of a request, and of an answer."""
HEAD = struct.Struct("<I")


@dataclass(frozen=True)
class TrafficSettings:
    """What SUMO's process is given once.

    Attributes:
        config: Path of the ``.sumocfg``.
        ego: The ego's id in it.
        warm_up_s: For how long SUMO drives the ego, which has entered, before the rollout [s].
        step_s: Of a step [s], whole milliseconds.
    """

    config: str
    ego: str
    warm_up_s: float
    step_s: float


class Pipe:
    """One end; messages are bytes of any length."""

    def __init__(self, end: socket.socket) -> None:
        """Take over a connected socket, which is closed when nobody has this end any more."""
        self._end = end
        weakref.finalize(self, end.close)

    def send(self, message: bytes) -> None:
        """Send a message.

        Raises:
            OSError: The other end is gone.
        """
        self._end.sendall(HEAD.pack(len(message)) + message)

    def receive(self) -> bytes:
        """The next message.

        Raises:
            EOFError: The other end was closed.
            OSError: It is gone.
        """
        return self._exactly(*HEAD.unpack(self._exactly(HEAD.size)))

    def close(self) -> None:
        """Close this end, which ends the process at the other."""
        self._end.close()

    def _exactly(self, size: int) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            part = self._end.recv(size - len(parts))
            if not part:
                raise EOFError
            parts += part
        return bytes(parts)
