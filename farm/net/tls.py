"""Access rights on a farm with certificates: bundles on disk, and the Zenoh configuration for them.

`farm certificates` makes a folder of bundles; each holds what one machine needs:

    certs/ca/            cert.pem  key.pem  roster.json; must not be copied
    certs/learner/       ca.pem  cert.pem  key.pem  identity.json  roster.json
    certs/worker-NAME/   ca.pem  cert.pem  key.pem  identity.json

Both sides of a connection show a certificate of the farm's own CA. The learner or router that
accepts the connection enforces the access rights: a worker may publish only under the common name
of its certificate; a viewer may only read.
"""

import base64
import json
import os
import re
import stat
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from farm.errors import ConfigError
from farm.net import keys

Role = Literal["learner", "worker", "viewer"]

_ADD: Final = "farm certificates add {0} --{role} NAME makes one, in {0}/{role}-NAME"
_TIMES: Final = re.compile(rb"\x17\r(\d{12})Z|\x18\x0f(\d{14})Z")  # UTCTime, GeneralizedTime
_FILES: Final = ("ca.pem", "cert.pem", "key.pem", "identity.json")


@dataclass(frozen=True)
class Roster:
    """Common names of all machines that may take part."""

    learners: tuple[str, ...]
    workers: tuple[str, ...]
    viewers: tuple[str, ...]


@dataclass(frozen=True)
class Bundle:
    """One machine's certificate, its key, and the CA that signed all certificates of the farm."""

    folder: Path
    role: Role
    name: str
    """Common name of the certificate."""
    hosts: tuple[str, ...] = ()
    """Host names and addresses in the learner's certificate; empty if the bundle does not list
    them.
    """

    def settings(self, side: Literal["listen", "connect"]) -> dict[str, object]:
        """Zenoh's settings for a session that accepts connections, or for one that connects."""
        folder = self.folder.absolute()  # a router's configuration may be read elsewhere
        return {
            "transport/link/tls/root_ca_certificate": str(folder / "ca.pem"),
            f"transport/link/tls/{side}_certificate": str(folder / "cert.pem"),
            f"transport/link/tls/{side}_private_key": str(folder / "key.pem"),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/close_link_on_expiration": True,
        }

    def roster(self) -> Roster:
        """The machines that may take part; in the bundles of the learner and of routers.

        Raises:
          ConfigError: this bundle has no such list, or it is damaged.
        """
        path = self.folder / "roster.json"
        try:
            values = json.loads(path.read_text("utf-8"))
            return Roster(
                *(tuple(map(str, values[part])) for part in ("learners", "workers", "viewers"))
            )
        except (OSError, ValueError, KeyError, TypeError):
            raise ConfigError(
                f"{path} has no list of machines; listen with the learner's bundle"
            ) from None


def find(folder: Path, role: Role, name: str = "") -> Bundle:
    """Find the bundle for this role: the folder itself, or its subfolder of that role and name.

    Raises:
      ConfigError: there is none, several match, or it is for another role.
    """
    if not os.access(folder, os.R_OK | os.X_OK):
        why = "this user may not read it" if folder.exists() else "there is no such folder"
        raise ConfigError(
            f"--tls {folder}: {why}; expected the folder of a machine that farm certificates made"
        )
    if (folder / "cert.pem").exists():
        bundle = _read(folder, role)
        if name and name != bundle.name:
            raise ConfigError(
                f"--name {name}: the certificate in {folder} is for {bundle.name}; leave --name out"
            )
        return bundle
    if role == "learner":
        return _read(folder / "learner", role)
    subfolder = folder / f"{role}-{name}"
    if name and subfolder.is_dir():
        return _read(subfolder, role)
    certificates = sorted(folder.glob(f"{role}-*/cert.pem"))
    if len(certificates) == 1 and not name:
        return _read(certificates[0].parent, role)
    if not certificates:
        raise ConfigError(
            f"{folder} holds no {role}'s certificate: {_ADD.format(folder, role=role)}"
        )
    names = ", ".join(path.parent.name.removeprefix(f"{role}-") for path in certificates)
    raise ConfigError(
        f"{folder} holds certificates for these {role}s: {names}; choose one with --name"
    )


def _read(folder: Path, role: Role) -> Bundle:
    missing = [name for name in _FILES if not (folder / name).is_file()]
    closed = [
        name for name in _FILES if name not in missing and not os.access(folder / name, os.R_OK)
    ]
    if closed:
        raise ConfigError(
            f"this user may not read {', '.join(closed)} in {folder}: chown it, or start as its"
            " owner"
        )
    if missing:
        raise ConfigError(
            f"{folder} lacks {', '.join(missing)}: make it with farm certificates, and copy all"
            " of it"
        )
    try:
        identity = json.loads((folder / "identity.json").read_text("utf-8"))
        hosts = tuple(map(str, identity.get("hosts", ())))
        bundle = Bundle(
            folder, identity["role"], keys.checked("certificate", identity["name"]), hosts
        )
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"{folder / 'identity.json'} is damaged") from None
    if bundle.role != role:
        remedy = "--tls CERTS/learner" if role == "learner" else _ADD.format("CERTS", role=role)
        raise ConfigError(
            f"{folder} is the bundle of a {bundle.role}; a {role}'s is needed here: {remedy}"
        )
    for name in _FILES[:3]:
        if b"-----BEGIN " not in (folder / name).read_bytes():
            raise ConfigError(f"{folder / name} is damaged: expected PEM; copy the bundle again")
    private(folder / "key.pem")
    until = _expiry(folder / "cert.pem")
    if until < datetime.now(UTC):
        renewed = "" if role == "learner" else f" --{role} {bundle.name}"
        raise ConfigError(
            f"the certificate of {role} {bundle.name} in {folder} expired on {until:%Y-%m-%d}: "
            f"farm certificates renew CERTS{renewed} replaces it"
        )
    return bundle


def _expiry(path: Path) -> datetime:
    """When a certificate expires: the second time in it (RFC 5280, 4.1), with a year of two or four
    digits.
    """
    try:
        body = (
            path.read_bytes().partition(b"-----BEGIN CERTIFICATE-----")[2].partition(b"-----END")[0]
        )
        short, long = _TIMES.findall(base64.b64decode(body))[1]
        return datetime.strptime(f"{(long or b'20' + short).decode()}+0000", "%Y%m%d%H%M%S%z")
    except (ValueError, IndexError):
        raise ConfigError(
            f"{path} is damaged: expected a certificate; copy the bundle again"
        ) from None


def private(key: Path) -> None:
    """Check that other users cannot read one of our keys.

    Raises ConfigError otherwise, like ssh.
    """
    status = key.stat()
    if status.st_uid == os.getuid() and status.st_mode & 0o077:
        mode = stat.S_IMODE(status.st_mode)
        raise ConfigError(f"{key} can be read by other users (mode {mode:04o}): chmod 600 {key}")


def access_control(farm: str, roster: Roster) -> dict[str, Any]:
    """Zenoh's access control for a session that accepts connections: everything not listed is
    denied.
    """
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []

    def admit(name: str, parts: list[tuple[str, list[str], list[str]]]) -> None:
        entries = [
            {
                "id": f"{name} {i}",
                "permission": "allow",
                "flows": [flow],
                "messages": messages,
                "key_exprs": expressions,
            }
            for i, (flow, messages, expressions) in enumerate(parts)
        ]
        rules.extend(entries)
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": [rule["id"] for rule in entries], "subjects": [name]})

    for name in roster.workers:
        admit(name, _worker(farm, name))
    for name in roster.viewers:
        admit(name, _viewer(farm))
    for name in roster.learners:
        admit(name, _learner(farm))
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **lists}


_TOKENS: Final = ["liveliness_token"]
_WATCHES: Final = ["declare_liveliness_subscriber", "liveliness_query"]


def _worker(farm: str, name: str) -> list[tuple[str, list[str], list[str]]]:
    """Rules for what a worker may send and receive."""
    topics, rounds = f"{name}/**", keys.generation(farm, "*")
    queries = [keys.spec(farm, "*"), keys.code(farm, "*", "*"), keys.asset(farm, "*", "*"), rounds]
    messages = [keys.inbox(farm, topics), keys.refused(farm, topics), rounds]
    return [
        ("ingress", ["put"], [keys.want(farm, topics), keys.result(farm, "*", topics)]),
        ("ingress", ["declare_subscriber"], messages),
        ("ingress", ["query"], queries),
        ("ingress", _TOKENS, [keys.worker_token(farm, topics)]),
        ("ingress", _WATCHES, [keys.learner_token(farm, "*")]),
        ("egress", ["put"], messages),
        ("egress", ["reply", "declare_queryable"], queries),
        ("egress", _TOKENS, [keys.learner_token(farm, "*")]),
        # The learners' own wildcard subscriptions; without them the worker would see no receivers.
        ("egress", ["declare_subscriber"], [keys.want(farm, "**"), keys.result(farm, "*", "**")]),
        ("egress", _WATCHES, [keys.worker_token(farm, "**")]),
    ]


def _viewer(farm: str) -> list[tuple[str, list[str], list[str]]]:
    """A viewer may see learners, workers, the runs' descriptions and their reports."""
    reports = [keys.generation(farm, "*"), keys.report(farm, "*"), keys.history(farm, "*")]
    names = (keys.spec, keys.generation, keys.status, keys.history)
    queries = [*(name(farm, "*") for name in names), keys.asset(farm, "*", "*")]
    tokens = [keys.learner_token(farm, "*"), keys.worker_token(farm, "**")]
    return [
        ("ingress", ["declare_subscriber"], reports),
        ("ingress", ["query"], queries),
        ("ingress", _WATCHES, tokens),
        ("egress", ["put"], reports),
        ("egress", ["reply", "declare_queryable"], queries),
        ("egress", _TOKENS, tokens),
    ]


def _learner(farm: str) -> list[tuple[str, list[str], list[str]]]:
    """A learner connected to a router may do everything on its farm."""
    every = [
        "put",
        "declare_subscriber",
        "query",
        "reply",
        "declare_queryable",
        *_TOKENS,
        *_WATCHES,
    ]
    return [(flow, every, [f"{farm}/**"]) for flow in ("ingress", "egress")]
