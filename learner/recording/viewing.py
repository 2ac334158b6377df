"""The table of recordings in a running viewer, and a catalog of recordings."""

import logging
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

from rerun.experimental import ViewerClient, ViewerState
from rerun.server import Server

from farm.errors import ConfigError
from farm.net import sockets

log = logging.getLogger(__name__)

_LOADING: Final = 60.0  # [s]
_PERIOD: Final = 0.2  # [s] between two requests to a viewer that starts


def free_port(rather: int = 0) -> int:
    """A free port on this machine; `rather` is preferred."""
    try:
        return sockets.free_port(port=rather)
    except OSError:
        return sockets.free_port()


def listens(port: int, ended: Callable[[], bool]) -> bool:
    """Wait until a program listens on a port of this machine; false if the viewer ends before."""
    until = time.monotonic() + _LOADING
    while time.monotonic() < until and not ended():
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(_PERIOD)
    return False


def show_table(viewer: ViewerClient, state: ViewerState) -> None:
    """Switch from the recordings to the table of all of them: in the viewer's catalog, under their
    application's id.
    """
    (application,) = parse_qs(urlsplit(state.location).query)["app_id"]
    viewer.set_location(f"{state.catalog_url}/entry/{application}")


def once_loaded(
    port: int, ended: Callable[[], bool], act: Callable[[ViewerClient, ViewerState], None]
) -> bool:
    """Call a function with the viewer on this port as soon as its recordings are loaded; return
    whether it was done.
    """
    until = time.monotonic() + _LOADING
    while time.monotonic() < until and not ended():
        try:
            viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = viewer.get_state()
            if state.catalog_url and not state.loading and state.active_recording:
                act(viewer, state)
                return True
        # Not listening yet, or a viewer of the user's that cannot be asked
        except Exception as error:
            log.debug("not yet: %s", error)
        time.sleep(_PERIOD)
    return False


@contextmanager
def catalog(name: str, files: Sequence[Path], port: int) -> Iterator[str]:
    """Serve recordings on this machine as one data set of Rerun's catalog; gives its address.

    Raises:
      ConfigError: the port is in use.
    """
    try:
        server = Server(host="127.0.0.1", port=port, datasets={name: files})
    except ValueError as error:
        raise ConfigError(f"{error}: take another port") from None
    with server:
        yield server.url()
