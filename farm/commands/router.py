"""`farm router`: a permanent router that outlives learners."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from farm import settings as arguments
from farm.commands import logs
from farm.commands.signals import stop_flag
from farm.net import keys
from farm.net.session import LISTEN, listen, router_settings
from farm.net.tls import find


@dataclass(frozen=True, kw_only=True)
class RouterCommand:
    """A permanent router that learners, workers and viewers connect to; it applies access control."""

    listen: str | None = None
    """Where it listens; by default tcp/127.0.0.1:7447, with --tls tls/127.0.0.1:7447."""
    connect: tuple[str, ...] = ()
    """Connect to another router, repeatable: for a site with its own router."""
    tls: Path | None = None
    """Folder with certificates (farm certificates makes it): the router uses the learner's bundle."""
    trust_network: bool = False
    """Listen to other machines without certificates: everyone there can read everything and pose as a worker."""
    farm: str = "farm"
    """Name of the farm that access control is for."""
    print_config: bool = False
    """Print the configuration for a zenohd of the same release, and exit."""
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""

    def __post_init__(self) -> None:
        keys.checked("farm", self.farm)


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(RouterCommand, words, "farm router")
    logs.set_up(command.log_level)
    bundle = None if command.tls is None else find(command.tls.absolute(), "learner")
    endpoint = command.listen or (LISTEN if bundle is None else LISTEN.replace("tcp/", "tls/"))
    trusted, routers = command.trust_network, command.connect
    if command.print_config:
        settings = router_settings(endpoint, command.farm, bundle, trusted=trusted, routers=routers)
        logs.say(json.dumps(_nested(settings), indent=2))
        return 0
    with stop_flag() as stop, listen(endpoint, command.farm, bundle, trusted=trusted, routers=routers):
        logs.say(f"router at {endpoint}; learners and workers connect to it with --connect")
        stop.wait()
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
