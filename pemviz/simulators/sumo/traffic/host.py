"""A process that has libsumo and makes processes of it, one for each episode at a time.

``python -m pemviz.simulators.sumo.traffic.host FD`` reads sockets from its own one, FD, and forks a
process that serves each. It has no threads and nothing of pemviz's but this package: a fork is
safe, and costs a millisecond where an import of libsumo costs most of a second. What SUMO prints
stays in the process; it ends when the other end of its socket is closed.
"""

import array
import json
import os
import signal
import socket
import struct
import sys
import tempfile
from typing import Any, BinaryIO

from pemviz.simulators.sumo.traffic.episode import Episode
from pemviz.simulators.sumo.traffic.facts import TrafficSettings
from pemviz.simulators.sumo.traffic.pipe import Pipe

RESET, STEP = b"r", b"s"
RUNNING, ENDED, WRONG = b"v", b"e", b"!"


def main() -> None:
    """Serve until the other end is closed."""
    own = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent alone acts on Ctrl-C
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that end
    library = _imported()
    while True:
        message, given, _, _ = socket.recv_fds(own, 1, 1)
        if not message:
            return
        if os.fork() == 0:
            own.close()
            _serve(Pipe(socket.socket(fileno=given[0])), library)
            os._exit(0)
        os.close(given[0])


def _imported() -> Any:
    os.environ["LIBSUMO_AS_TRACI"] = "quiet"
    import libsumo  # noqa: PLC0415  an extra

    return libsumo


def _serve(pipe: Pipe, library: Any) -> None:
    """Answer until the pipe is closed."""
    with tempfile.TemporaryFile() as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        try:
            episode = Episode(library, TrafficSettings(**json.loads(pipe.receive())))
            while True:
                pipe.send(_answer(episode, pipe.receive(), printed))
        except (EOFError, OSError):
            pass


def _answer(episode: Episode, asked: bytes, printed: BinaryIO) -> bytes:
    """The answer to a request; what goes wrong is an answer too."""
    try:
        if asked[:1] == RESET:
            return (
                RUNNING + array.array("d", episode.reset(*struct.unpack("q", asked[1:]))).tobytes()
            )
        values, ended = episode.step(*struct.unpack("d", asked[1:]))
        return (ENDED if ended else RUNNING) + array.array("d", values).tobytes()
    except LookupError as error:
        return WRONG + str(error.args[0]).encode()
    except Exception as error:
        return WRONG + _words(error, printed).encode()


def _words(error: Exception, printed: BinaryIO) -> str:
    """What SUMO printed of its errors, else what the exception says, in one line."""
    printed.seek(0)
    lines = printed.read().decode(errors="replace").splitlines()
    told = [line.removeprefix("Error:").strip() for line in lines if line.startswith("Error:")]
    return " ".join(" ".join(told or [str(error) or type(error).__name__]).split())


if __name__ == "__main__":
    main()
