"""`farm certificates`: a small certificate authority for a lab.

The only module that imports cryptography.
"""

import datetime
import importlib.util
import ipaddress
import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import tyro

from farm import command_line
from farm.errors import ConfigError, writing
from farm.net import keys, tls
from farm.net.tls import Role
from farm.settings import Settings, setting
from farm.targets import typed

_THERE: Final = importlib.util.find_spec("cryptography") is not None  # an extra

if TYPE_CHECKING or _THERE:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

LEARNER: Final = "learner"
"""Common name of the learner's certificate."""

_PARTS: Final = ("learners", "workers", "viewers")
_COMMON_NAME: Final = 64  # characters (RFC 5280, ub-common-name)
_LABEL: Final = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")


@dataclass(frozen=True, kw_only=True)
class CertificatesCommand(Settings):
    """A small certificate authority for a lab: makes one folder per machine, to be copied there."""

    action: tyro.conf.Positional[Literal["new", "add", "renew"]]
    """new: an authority and its first certificates | add: certificates of more workers or
    viewers | renew: new certificates for the given names, or for the learner if no name is given.
    """
    dir: tyro.conf.Positional[Path]
    """Folder of the authority; keep it on one machine."""
    learner: tuple[str, ...] = ()
    """Host name or address at which workers reach the learner or router, repeatable."""
    worker: tuple[str, ...] = ()
    """Name of a worker's host, repeatable; all processes of that host share its certificate."""
    viewer: tuple[str, ...] = ()
    """Name of a viewer, which may watch and record only, repeatable."""
    days: int = setting(825, least=1, most=3650)
    """Validity of the certificates [days]; the authority's own is ten years."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for role, name in self.others:
            if len(keys.checked(role, name)) > _COMMON_NAME:
                raise ConfigError(
                    f"{role} {name} has {len(name)} characters; a certificate can have at most"
                    f" {_COMMON_NAME}"
                )
        for host in self.learner:
            _check_host(host)
        names = [LEARNER, *self.worker, *self.viewer]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ConfigError(
                f"{', '.join(sorted(twice))}: a name can be given to one certificate only"
            )

    @property
    def others(self) -> list[tuple[Role, str]]:
        """Roles and names of all but the learner."""
        return [("worker", name) for name in self.worker] + [
            ("viewer", name) for name in self.viewer
        ]


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(CertificatesCommand, words, "farm certificates")
    if not _THERE:
        raise ConfigError("making certificates needs cryptography: pip install cryptography")
    with writing(f"to {command.dir}", ConfigError):
        {"new": _new, "add": _add, "renew": _renew}[command.action](command)
    return 0


def _new(command: CertificatesCommand) -> None:
    if command.dir.exists() and any(command.dir.iterdir()):
        raise ConfigError(
            f"{command.dir} is not empty: take another folder, or farm certificates add"
            f" {command.dir}"
        )
    if not command.learner:
        raise ConfigError(
            "--learner HOST is missing: the name or address at which workers reach the learner"
        )
    with _all_or_nothing(command.dir):
        authority = Authority.create(command.dir / "ca")
        _issue(command, authority, [("learner", LEARNER), *command.others], {"learners": [LEARNER]})
    names = (LEARNER, f"worker-{(*command.worker, 'NAME')[0]}")
    learner, worker = (typed(command.dir / name) for name in names)
    sys.stdout.write(
        f"learner: farm learner --listen tls/0.0.0.0:7447 --tls {learner}\n"
        f"workers: farm worker --connect tls/{command.learner[0]}:7447 --tls {worker}\n"
        f"{command.dir / 'ca'} holds the authority's key: keep it secret, and do not copy it\n"
    )


def _add(command: CertificatesCommand) -> None:
    if command.learner:
        raise ConfigError("--learner belongs to farm certificates new and renew")
    if not command.others:
        raise ConfigError("nothing to add: give --worker NAME or --viewer NAME")
    authority, roster = Authority.load(command.dir / "ca"), _roster(command.dir)
    names = {name for names in roster.values() for name in names}
    if twice := sorted({name for _, name in command.others if name in names}):
        raise ConfigError(
            f"{', '.join(twice)} has a certificate already: farm certificates renew replaces it"
        )
    _issue(command, authority, command.others, roster)
    admitted = command.dir / LEARNER / "roster.json"
    sys.stdout.write(
        f"{admitted} has the new names; "
        if admitted.exists()
        else f"copy {command.dir}/ca/roster.json into the learner's folder; "
    )
    sys.stdout.write(
        "restart the learner: it admits those that it knew at its start. A router has a"
        " roster.json of its own: replace it, and restart the router\n"
    )


def _renew(command: CertificatesCommand) -> None:
    authority, roster = Authority.load(command.dir / "ca"), _roster(command.dir)
    for role, name in command.others:
        if name not in roster[f"{role}s"]:
            raise ConfigError(
                f"no {role} {name} is known in {command.dir}: farm certificates add makes a new one"
            )
    learner: list[tuple[Role, str]] = (
        [("learner", LEARNER)] if command.learner or not command.others else []
    )
    hosts = command.learner or (_hosts(command.dir / LEARNER) if learner else ())
    _issue(command, authority, [*learner, *command.others], roster, hosts)
    sys.stdout.write(
        "restart the programs that use them; the old certificates stay valid until they expire\n"
    )


def _issue(
    command: CertificatesCommand,
    authority: "Authority",
    identities: list[tuple[Role, str]],
    roster: dict[str, list[str]],
    hosts: tuple[str, ...] | None = None,
) -> None:
    """Make bundles, all or none, update the list of admitted names, and print the new folders."""
    with ExitStack() as undo:
        moves = []
        for role, name in identities:
            folder = command.dir / (LEARNER if role == "learner" else f"{role}-{name}")
            aside = command.dir / f".{folder.name}.new"
            shutil.rmtree(aside, ignore_errors=True)
            undo.callback(shutil.rmtree, aside, ignore_errors=True)
            addresses = () if role != "learner" else command.learner if hosts is None else hosts
            authority.issue(aside, role, name, command.days, addresses)
            moves.append((aside, folder))
            roster[f"{role}s"] = sorted({name, *roster.get(f"{role}s", [])})
        for aside, folder in moves:
            shutil.rmtree(folder, ignore_errors=True)
            aside.rename(folder)
    text = json.dumps({part: roster.get(part, []) for part in _PARTS}, indent=2) + "\n"
    for folder in (command.dir / "ca", command.dir / LEARNER):
        if folder.is_dir():  # the learner's may have been moved to its machine
            (folder / "roster.json").write_text(text, "utf-8")
    folders = "\n  ".join(str(folder) for _, folder in moves)
    sys.stdout.write(f"made, one folder for each machine to copy there:\n  {folders}\n")


def _roster(folder: Path) -> dict[str, list[str]]:
    """The admitted names by role: the authority's own list, wherever bundles were moved."""
    path = folder / "ca" / "roster.json"
    try:
        values = json.loads(path.read_text("utf-8"))
        return {part: [keys.checked(part, name) for name in values[part]] for part in _PARTS}
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ConfigError):
        raise ConfigError(
            f"{path} is missing or damaged: expected lists of {', '.join(_PARTS)}; the learner's"
            " bundle has a copy"
        ) from None


def _hosts(folder: Path) -> tuple[str, ...]:
    """The host names in the learner's present certificate."""
    try:
        present = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
        names = present.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (OSError, ValueError, x509.ExtensionNotFound):
        raise ConfigError(
            f"no certificate in {folder} to renew: give its host names with --learner HOST"
        ) from None
    return tuple(str(name.value) for name in names)


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[None]:
    """Remove everything from a folder that could not be filled completely."""
    existed = folder.exists()
    try:
        yield
    except BaseException:
        for path in folder.iterdir() if folder.exists() else ():
            shutil.rmtree(path, ignore_errors=True)
        if not existed and folder.exists():
            folder.rmdir()
        raise


def _check_host(host: str) -> None:
    """Check that a certificate can be made for a host; else a ConfigError."""
    if _is_address(host):
        return
    labels = host.split(".")
    if len(host) > 253 or not all(map(_LABEL.fullmatch, labels)) or labels[-1].isdecimal():
        hint = "" if host.isascii() else "; names of other letters have a form in ASCII, xn--..."
        raise ConfigError(
            f"--learner {host[:100]!r} is not a host; expected a name like learner.lab, or an"
            f" address like 10.0.0.7, without port{hint}"
        )


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Authority:
    """A CA: its certificate, and the key that signs."""

    folder: Path
    key: "ec.EllipticCurvePrivateKey"
    certificate: "x509.Certificate"

    @classmethod
    def create(cls, folder: Path) -> "Authority":
        """Make a new CA, valid for ten years, in a new folder that only its owner can read."""
        folder.mkdir(parents=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        usage = x509.KeyUsage(
            digital_signature=True,
            key_cert_sign=True,
            crl_sign=True,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            encipher_only=False,
            decipher_only=False,
        )
        constraints = x509.BasicConstraints(ca=True, path_length=0)
        certificate = _certificate(
            "rolloutfarm CA", key, None, key, 3650, [(constraints, True), (usage, True)]
        )
        _write(folder, key, certificate)
        return cls(folder, key, certificate)

    @classmethod
    def load(cls, folder: Path) -> "Authority":
        """Read a CA from its folder.

        Raises:
          ConfigError: the folder holds no CA, or others can read its key.
        """
        try:
            key: Any = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), None)
            certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
            tls.private(folder / "key.pem")
        except (OSError, ValueError, TypeError):
            raise ConfigError(
                f"{folder} holds no certificate authority: farm certificates new makes one"
            ) from None
        return cls(folder, key, certificate)

    def issue(
        self, folder: Path, role: Role, name: str, days: float, hosts: tuple[str, ...]
    ) -> None:
        """Make a machine's bundle in a new folder: key, certificate and the CA's certificate.

        Args:
          folder: of the bundle.
          role: of the machine.
          name: of the certificate.
          days: for which it is valid; below zero if it has expired, at most five minutes ago.
          hosts: host names and addresses at which a learner can be reached.
        """
        folder.mkdir(mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        # Workers connect to the learner, but behind a router the learner connects as well.
        client, server = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
        extensions: list[tuple[Any, bool]] = [
            (x509.BasicConstraints(ca=False, path_length=None), True),
            (x509.ExtendedKeyUsage([server, client] if role == "learner" else [client]), False),
            (x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), False),
        ]
        if hosts:
            extensions.append((x509.SubjectAlternativeName([_host(host) for host in hosts]), False))
        _write(folder, key, _certificate(name, key, self.certificate, self.key, days, extensions))
        shutil.copy(self.folder / "cert.pem", folder / "ca.pem")
        (folder / "identity.json").write_text(
            json.dumps({"role": role, "name": name, "hosts": hosts}) + "\n", "utf-8"
        )


def signed(folder: Path, content: bytes) -> bytes:
    """Sign a content with the key in a machine's folder: ECDSA over SHA-256, in DER, as openssl
    dgst has it.

    Raises:
      ConfigError: cryptography is missing, or the key is damaged.
    """
    if not _THERE:
        raise ConfigError("a signature needs cryptography: pip install cryptography")
    try:
        key: Any = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), None)
        signature: bytes = key.sign(content, ec.ECDSA(hashes.SHA256()))
        return signature
    except (OSError, ValueError, AttributeError, TypeError):
        raise ConfigError(f"{folder / 'key.pem'} is no key that farm certificates made") from None


def _certificate(
    name: str,
    key: "ec.EllipticCurvePrivateKey",
    issuer: "x509.Certificate | None",
    signer: "ec.EllipticCurvePrivateKey",
    days: float,
    extensions: list[tuple[Any, bool]],
) -> "x509.Certificate":
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
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(signer, hashes.SHA256())


def _host(host: str) -> "x509.GeneralName":
    return x509.IPAddress(ipaddress.ip_address(host)) if _is_address(host) else x509.DNSName(host)


def _write(
    folder: Path, key: "ec.EllipticCurvePrivateKey", certificate: "x509.Certificate"
) -> None:
    s = serialization
    private = key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, s.NoEncryption())
    path = folder / "key.pem"
    path.touch(mode=0o600)
    path.write_bytes(private)
    (folder / "cert.pem").write_bytes(certificate.public_bytes(s.Encoding.PEM))
