"""Zenoh's settings of a farm's sessions, by configuration path.

They were measured: see docs/protocol.md. Pure.
"""

import ipaddress
import re
from typing import Final

from farm.errors import ConfigError
from farm.net import keys
from farm.net.tls import Bundle, access_control

_LEASE_MS: Final = 3000  # leases under 2 s kill healthy workers on a busy machine
_PORT: Final = re.compile(r"[0-9]{1,5}")
_OPEN_S: Final = 1.0
_REQUEST: Final = 65_536  # [bytes] of a request for work
# [1/s] requests per link; one that is dropped is sent again within a second
_REQUESTS: Final = 1000.0
# [1/s] queries per link and topic; workers ask once per run, recorders some times per second
_QUERIES: Final = 20.0
LARGEST: Final = 64 * 1024 * 1024  # [bytes] of a message
RECEIVE: Final = "transport/link/rx/max_message_size"
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/link/tx/lease": _LEASE_MS,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 300_000,
    RECEIVE: LARGEST,
    "transport/shared_memory/enabled": False,
}
_ROUTER: Final = {
    "mode": "router",
    "transport/unicast/max_sessions": 4096,
    # Connections that say nothing take 10 s and some 10 kB each; while there are so many, nobody
    # else can join.
    "transport/unicast/accept_pending": 8192,
}
_RETRY: Final = {
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
}
_CLIENT: Final = {"mode": "client", "connect/timeout_ms": int(_OPEN_S * 1000), **_RETRY}


def is_port(text: str) -> bool:
    """Whether a text is a port's number."""
    return bool(_PORT.fullmatch(text)) and 0 < int(text) < 65536


def check_endpoint(endpoint: str, *, encrypted: bool = False) -> str:
    """Check an endpoint's form, and return its host (Zenoh silently accepts some malformed ones).

    Args:
      endpoint: tcp/HOST:PORT, or tls/HOST:PORT with certificates.
      encrypted: whether there are certificates.

    Raises:
      ConfigError: it is malformed, or certificates and protocol do not match.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not host or not (is_port(port) or port == "0"):
        raise ConfigError(
            f"endpoint {endpoint!r} is not of the form tcp/HOST:PORT, for example"
            " tcp/127.0.0.1:7447"
        )
    if protocol == "tls" and not encrypted:
        raise ConfigError(f"endpoint {endpoint} needs certificates: give their folder with --tls")
    if protocol == "tcp" and encrypted:
        raise ConfigError(
            f"endpoint {endpoint} is not encrypted, but --tls is given: use tls/{address}"
        )
    return host


def _reachable(host: str) -> bool:
    """Whether other machines may be able to connect to a listener on this host."""
    try:
        return not ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host != "localhost"


LISTEN: Final = "tcp/127.0.0.1:7447"
"""A learner's default endpoint."""


def router_settings(
    endpoint: str,
    farm: str,
    bundle: Bundle | None,
    *,
    trusted: bool = False,
    routers: tuple[str, ...] = (),
) -> dict[str, object]:
    """Zenoh's settings for a session that accepts connections, by configuration path.

    Args:
      endpoint: where it listens.
      farm: name of the farm, for access control.
      bundle: the learner's certificates; with them only machines on its roster are accepted.
      trusted: listen to other machines without certificates.
      routers: other routers that it connects to, and reconnects to after a loss.

    Raises:
      ConfigError: an endpoint is malformed, or open to other machines without certificates.
    """
    host, *_ = (check_endpoint(each, encrypted=bundle is not None) for each in (endpoint, *routers))
    if bundle is None and _reachable(host) and not trusted:
        raise ConfigError(
            f"{endpoint} can be reached by other machines: protect it (farm certificates, --tls),"
            " or say --trust-network if everyone on that network may read everything and pose as a"
            " worker"
        )
    secured: dict[str, object] = {}
    if bundle:
        secured = {**bundle.settings("listen"), **_limits(farm)}
        secured["access_control"] = access_control(farm, bundle.roster())
    settings = {**_COMMON, **_ROUTER, **secured, "listen/endpoints": [endpoint]}
    if routers:
        credentials = bundle.settings("connect") if bundle else {}
        settings |= {"connect/endpoints": list(routers), **_RETRY, **credentials}
    return settings


def _limits(farm: str) -> dict[str, object]:
    """Zenoh's filters of what comes in: large requests, and more of them than any farm sends over
    one link.

    A query that is dropped is unanswered at once, and asked again later.
    """
    requests, common = keys.want(farm, "**"), {"flows": ["ingress"], "messages": ["put"]}
    topics = [topic(farm, "*") for topic in (keys.spec, keys.generation, keys.status, keys.history)]
    queries = [{"key_expr": key, "freq": _QUERIES} for key in topics]
    return {
        "low_pass_filter": [{**common, "key_exprs": [requests], "size_limit": _REQUEST}],
        "downsampling": [
            {**common, "rules": [{"key_expr": requests, "freq": _REQUESTS}]},
            {**common, "messages": ["query"], "rules": queries},
        ],
    }


def client_settings(endpoints: tuple[str, ...], bundle: Bundle | None) -> dict[str, object]:
    """Zenoh's settings for a session that connects to the first endpoint that answers.

    Raises:
      ConfigError: an endpoint is malformed, or encrypted without certificates.
    """
    for endpoint in endpoints:
        check_endpoint(endpoint, encrypted=bundle is not None)
    secured = bundle.settings("connect") if bundle else {}
    return {
        **_COMMON,
        **_CLIENT,
        "connect/endpoints": list(endpoints),
        "listen/endpoints": [],
        **secured,
    }
