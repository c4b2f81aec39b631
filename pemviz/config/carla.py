"""Where a CARLA server is."""

from pemviz.errors import ConfigError

DEFAULT_ADDRESS = "127.0.0.1:2000"
"""CARLA's own port, on this machine."""


def read_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``.

    Raises:
        ConfigError: It is none.
    """
    host, _, port = text.rpartition(":")
    is_number = port.isascii() and port.isdigit() and len(port) <= 5
    if not host or not host.isprintable() or " " in host or not is_number:
        message = f"carla = {text[:80]!r}: must be HOST:PORT, such as {DEFAULT_ADDRESS}"
        raise ConfigError(message)
    if not 1 <= int(port) <= 65535:
        message = f"carla = {text[:80]!r}: the port must be from 1 to 65535"
        raise ConfigError(message)
    return host, int(port)
