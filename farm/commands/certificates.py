"""`farm certificates`: a small certificate authority for a lab; the only door to cryptography."""

import datetime
import importlib.util
import ipaddress
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import tyro

from farm import settings as arguments
from farm.errors import ConfigError
from farm.net import keys
from farm.net.tls import Role

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.x509 import Certificate

LEARNER: Final = "learner"
"""Common name of the learner's certificate."""


@dataclass(frozen=True, kw_only=True)
class CertificatesCommand:
    """A small certificate authority for a lab: makes one folder for each machine to copy there."""

    action: tyro.conf.Positional[Literal["new", "add"]]
    """new: an authority and its first certificates; add: more workers or viewers."""
    dir: tyro.conf.Positional[Path]
    """Folder of the authority; keep it on one machine."""
    learner: tuple[str, ...] = ()
    """Host name or address at which workers dial the learner or router, repeatable."""
    worker: tuple[str, ...] = ()
    """Name of a worker's host, repeatable; all processes of that host share its certificate."""
    viewer: tuple[str, ...] = ()
    """Name of somebody who may look but not work, repeatable."""
    days: int = 825
    """Validity of the certificates [days]; the authority's own is ten years."""

    def __post_init__(self) -> None:
        """Check every value."""
        for kind in ("worker", "viewer"):
            for name in getattr(self, kind):
                keys.checked(kind, name)
        names = [LEARNER, *self.worker, *self.viewer]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ConfigError(f"{', '.join(sorted(twice))}: a name can be given to one certificate only")
        if not 1 <= self.days <= 3650:
            raise ConfigError(f"days is {self.days}; expected 1 to 3650")


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(CertificatesCommand, words, "farm certificates")
    if importlib.util.find_spec("cryptography") is None:
        raise ConfigError("making certificates needs cryptography: pip install 'rolloutfarm[certificates]'")
    try:
        (_new if command.action == "new" else _add)(command)
    except OSError as error:
        raise ConfigError(f"cannot write to {command.dir}: {error.strerror}") from None
    return 0


def _new(command: CertificatesCommand) -> None:
    if command.dir.exists() and any(command.dir.iterdir()):
        raise ConfigError(f"{command.dir} is not empty: take another folder, or farm certificates add {command.dir}")
    if not command.learner:
        raise ConfigError("--learner HOST is missing: the name or address at which workers dial the learner")
    authority = _Authority.create(command.dir / "ca")
    authority.issue(command.dir / LEARNER, "learner", LEARNER, command.days, command.learner)
    _issue(command, authority)
    _say(command, "new")


def _add(command: CertificatesCommand) -> None:
    if command.learner:
        raise ConfigError("--learner belongs to farm certificates new; another learner needs another authority")
    if not (*command.worker, *command.viewer):
        raise ConfigError("nothing to add: give --worker NAME or --viewer NAME")
    there = [name for role in ("worker", "viewer") for name in getattr(command, role)]
    known = [path.name.partition("-")[2] for path in command.dir.glob("*-*") if path.is_dir()]
    if set(there) & set(known):
        raise ConfigError(f"{', '.join(sorted(set(there) & set(known)))} has a certificate in {command.dir} already")
    _issue(command, _Authority.load(command.dir / "ca"))
    _say(command, "add")


def _issue(command: CertificatesCommand, authority: "_Authority") -> None:
    roles: tuple[Role, ...] = ("worker", "viewer")
    for role in roles:
        for name in getattr(command, role):
            authority.issue(command.dir / f"{role}-{name}", role, name, command.days, ())
    roster = {f"{role}s": _names(command.dir, role) for role in roles}
    text = json.dumps({"learners": [LEARNER], **roster}, indent=2) + "\n"
    (command.dir / LEARNER / "roster.json").write_text(text, "utf-8")


def _names(folder: Path, role: Role) -> list[str]:
    return sorted(path.parent.name.removeprefix(f"{role}-") for path in folder.glob(f"{role}-*/cert.pem"))


def _say(command: CertificatesCommand, action: str) -> None:
    made = [f"{role}-{name}" for role in ("worker", "viewer") for name in getattr(command, role)]
    lines = [f"{command.dir / name}" for name in (([LEARNER] if action == "new" else []) + made)]
    sys.stdout.write("made, one folder for each machine to copy there:\n  " + "\n  ".join(lines) + "\n")
    if action == "add":
        sys.stdout.write(f"copy {command.dir / LEARNER}/roster.json to the learner (or router) and restart it\n")
    else:
        host = command.learner[0]
        sys.stdout.write(
            f"learner: farm learner --listen tls/0.0.0.0:7447 --tls {command.dir / LEARNER}\n"
            f"workers: farm worker --connect tls/{host}:7447 --tls worker-NAME\n"
            f"{command.dir / 'ca'} makes more of them: keep it where you are, and to yourself\n"
        )


class _Authority:
    """A CA: its certificate, and the key that signs."""

    def __init__(self, folder: Path, key: "EllipticCurvePrivateKey", certificate: "Certificate") -> None:
        self._folder, self._key, self._certificate = folder, key, certificate

    @classmethod
    def create(cls, folder: Path) -> "_Authority":
        from cryptography.hazmat.primitives.asymmetric import ec

        folder.mkdir(parents=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _certificate("rolloutfarm CA", key, None, key, 3650, _ca_extensions(key))
        _write(folder, key, certificate)
        return cls(folder, key, certificate)

    @classmethod
    def load(cls, folder: Path) -> "_Authority":
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import load_pem_private_key

        try:
            key: Any = load_pem_private_key((folder / "key.pem").read_bytes(), None)
            certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
        except (OSError, ValueError):
            raise ConfigError(f"{folder} holds no certificate authority: farm certificates new makes one") from None
        return cls(folder, key, certificate)

    def issue(self, folder: Path, role: Role, name: str, days: int, hosts: tuple[str, ...]) -> None:
        """Make a bundle."""
        from cryptography.hazmat.primitives.asymmetric import ec

        folder.mkdir(mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        extensions = _leaf_extensions(role, hosts, key, self._key)
        certificate = _certificate(name, key, self._certificate, self._key, days, extensions)
        _write(folder, key, certificate)
        shutil.copy(self._folder / "cert.pem", folder / "ca.pem")
        (folder / "identity.json").write_text(json.dumps({"role": role, "name": name}) + "\n", "utf-8")


def _certificate(
    name: str,
    key: "EllipticCurvePrivateKey",
    issuer: "Certificate | None",
    signer: "EllipticCurvePrivateKey",
    days: int,
    extensions: "list[tuple[Any, bool]]",
) -> "Certificate":
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.x509.oid import NameOID

    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer.subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))  # machines' clocks differ
        .not_valid_after(now + datetime.timedelta(days=days))
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(signer, hashes.SHA256())


def _ca_extensions(key: "EllipticCurvePrivateKey") -> "list[tuple[Any, bool]]":
    from cryptography import x509

    usage = x509.KeyUsage(
        digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return [(x509.BasicConstraints(ca=True, path_length=0), True), (usage, True), (identifier, False)]


def _leaf_extensions(
    role: Role, hosts: tuple[str, ...], key: "EllipticCurvePrivateKey", signer: "EllipticCurvePrivateKey"
) -> "list[tuple[Any, bool]]":
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID

    # The learner is dialled, but behind a router it dials as well.
    client, server = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
    uses = x509.ExtendedKeyUsage([server, client] if role == "learner" else [client])
    out: list[tuple[Any, bool]] = [
        (x509.BasicConstraints(ca=False, path_length=None), True),
        (uses, False),
        (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False),
        (x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), False),
    ]
    if hosts:
        out.append((x509.SubjectAlternativeName([_host(host) for host in hosts]), False))
    return out


def _host(host: str) -> Any:  # noqa: ANN401  one of cryptography's general names
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write(folder: Path, key: "EllipticCurvePrivateKey", certificate: "Certificate") -> None:
    from cryptography.hazmat.primitives import serialization as s

    private = key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, s.NoEncryption())
    path = folder / "key.pem"
    path.touch(mode=0o600)
    path.write_bytes(private)
    (folder / "cert.pem").write_bytes(certificate.public_bytes(s.Encoding.PEM))
