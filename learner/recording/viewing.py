"""The viewer's program, and the table of recordings in a running viewer."""

import logging
import socket
import time
from collections.abc import Callable
from typing import Final
from urllib.parse import parse_qs, urlsplit

from rerun.experimental import ViewerClient

log = logging.getLogger(__name__)

_LOADING: Final = 60.0  # [s]
_PERIOD: Final = 0.2  # [s] between two questions to a viewer that starts


def free_port(rather: int = 0) -> int:
    """A free port on this machine: `rather` if it is free."""
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", rather))
        except OSError:
            probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def show_table(port: int, gone: Callable[[], bool]) -> bool:
    """Go from the recordings that the viewer on this port loads to the table of them all.

    Returns:
      whether it is shown; where not, the recordings are there all the same.
    """
    until = time.monotonic() + _LOADING
    while time.monotonic() < until and not gone():
        try:
            viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = viewer.get_state()
            if state.catalog_url and not state.loading and state.active_recording:
                viewer.set_location(_table(state.catalog_url, state.location))
                return True
        except Exception as error:  # not listening yet, or a viewer of the user's that knows no tables
            log.debug("no table yet: %s", error)
        time.sleep(_PERIOD)
    return False


def _table(catalog: str, recording: str) -> str:
    """Where the viewer's catalog has the table that a recording is in: under its application's id."""
    (application,) = parse_qs(urlsplit(recording).query)["app_id"]
    return f"{catalog}/entry/{application}"
