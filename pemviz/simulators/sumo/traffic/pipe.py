"""Messages over a socket between this process and one of SUMO's."""

import socket
import struct
import weakref

HEAD = struct.Struct("<I")


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
