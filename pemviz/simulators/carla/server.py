"""A CARLA server that is there, of the client's version, and driven by nobody else.

The client is imported when it is first needed: it is an extra, and takes half a second.
"""

import socket
from collections.abc import Generator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from pemviz.errors import ConfigError, RunError

if TYPE_CHECKING:
    import carla

INSTALL = "pip install 'pemviz[carla]'"
CONNECT_S = 5.0
ANSWER_S = 60.0
"""For making a world, which takes a server longest."""


def check_installed() -> None:
    """Refuse CARLA where its client is not there.

    Raises:
        ConfigError: Says how to install it.
    """
    if find_spec("carla") is None:
        message = f"simulator = 'carla': needs CARLA's client; install it with {INSTALL}"
        raise ConfigError(message)


def connected(host: str, port: int, *, connect_s: float = CONNECT_S) -> "carla.Client":
    """The client of a server that answers.

    Args:
        host: Where the server is.
        port: Its first port; it also uses the next one.
        connect_s: How long to wait for an answer.

    Raises:
        ConfigError: Nothing listens there, what does is no CARLA server, or one of another version.
    """
    check_installed()
    where = f"carla = '{host}:{port}'"
    try:
        socket.create_connection((host, port), timeout=connect_s).close()
    except OSError as error:
        why = error.strerror or str(error) or type(error).__name__
        message = f"{where}: nothing to connect to ({why}); is the server running there?"
        raise ConfigError(message) from None
    import carla  # noqa: PLC0415  an extra

    client = carla.Client(host, port)
    client.set_timeout(connect_s)
    try:
        server = client.get_server_version()
    except RuntimeError as error:
        message = f"{where}: something listens, but not as a CARLA server ({_one_line(error)})"
        raise ConfigError(message) from None
    check_version(where, client=client.get_client_version(), server=server)
    client.set_timeout(ANSWER_S)
    return client


def check_version(where: str, *, client: str, server: str) -> None:
    """Refuse a server of another version than the client's, as CARLA itself advises against.

    A server built from sources tells its commit behind the version.

    Raises:
        ConfigError: It is one.
    """
    if server.partition("-")[0] != client.partition("-")[0]:
        message = f"{where}: the server is CARLA {server}, the client {client}: must be the same"
        raise ConfigError(message)


def check_free(where: str, settings: "carla.WorldSettings") -> None:
    """Refuse a server that another client drives: both would tick it.

    Raises:
        ConfigError: It is synchronous already.
    """
    if settings.synchronous_mode:
        message = (
            f"{where}: the server is driven by another client already (synchronous mode); "
            "wait for it, or start the server anew"
        )
        raise ConfigError(message)


@contextmanager
def answering(where: str) -> Generator[None, None, None]:
    """What a server is asked meanwhile.

    Raises:
        RunError: It does not answer, or refuses.
    """
    try:
        yield
    except RuntimeError as error:
        message = f"{where}: the server is lost, or refuses: {_one_line(error)}"
        raise RunError(message) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
