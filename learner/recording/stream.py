"""The address of a recording's live stream."""

from farm.errors import ConfigError
from farm.net.sockets import free_port


def stream_port(host: str, port: int) -> int:
    """The port, or a free one for 0; Rerun itself only prints a line when it cannot listen.

    Raises:
      ConfigError: it is in use, or the host is not this machine.
    """
    try:
        return free_port(host, port)
    except OSError as error:
        raise ConfigError(
            f"cannot serve the recording at {host}:{port}: {error}; choose another"
        ) from error
