"""`farm router`: a permanent router that outlives learners."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from farm import command_line
from farm.commands import logs
from farm.commands.signals import stop_flag
from farm.errors import MessageError
from farm.link import Listening
from farm.net import keys
from farm.net.session import listen
from farm.net.zenoh_settings import router_settings

_WAIT: Final = 0.5  # [s] at most between two looks whether to stop


@dataclass(frozen=True, kw_only=True)
class RouterCommand(Listening):
    """A permanent router that learners, workers and viewers connect to.

    It applies access control.
    """

    print_config: bool = False
    """Print the configuration for a zenohd of the same release, and exit."""
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(RouterCommand, words, "farm router")
    logs.set_up(command.log_level)
    bundle, endpoint = command.bundle, command.listen or command.usual
    trusted, routers = command.trust_network, command.connect
    if command.print_config:
        settings = router_settings(endpoint, command.farm, bundle, trusted=trusted, routers=routers)
        logs.say(json.dumps(_nested(settings), indent=2))
        return 0
    with (
        stop_flag() as stop,
        listen(endpoint, command.farm, bundle, trusted=trusted, routers=routers) as session,
    ):
        session.subscribe("cut", keys.cut(command.farm, "*"))
        logs.say(f"router at {endpoint}; learners and workers connect to it with --connect")
        while not stop.is_set():
            for event in session.events.waiting(_WAIT):
                with suppress(MessageError):  # published on a pattern: nobody's name
                    session.cut(keys.run_in(event.key, keys.cut(command.farm, "")))
    return 0


def _nested(settings: dict[str, object]) -> dict[str, Any]:
    """Convert settings by path to the tree that zenohd reads."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, leaf = path.split("/")
        branch = tree
        for name in parents:
            branch = branch.setdefault(name, {})
        branch[leaf] = value
    return tree
