"""`farm certificates`: errors are one line and leave no files; admitted machines stay admitted."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from farm.__main__ import main
from farm.commands import certificates
from farm.errors import ConfigError
from farm.net import tls
from farm.net.tls import find

x509 = pytest.importorskip("cryptography.x509")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    certs = tmp_path / "certs"
    assert (
        main(
            [
                "certificates",
                "new",
                str(certs),
                "--learner",
                "learner.lab",
                "--learner",
                "10.0.0.7",
                "--worker",
                "w1",
            ]
        )
        == 0
    )
    return certs


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(["certificates", *words]) == 2
    out, line = capsys.readouterr()
    assert out == ""
    assert len(line.splitlines()) == 1
    return line


def roster(path: Path) -> dict[str, Any]:
    return json.loads((path / "roster.json").read_text())


def certificate(bundle: Path) -> Any:
    return x509.load_pem_x509_certificate((bundle / "cert.pem").read_bytes())


def hosts(bundle: Path) -> list[str]:
    names = (
        certificate(bundle).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    )
    return [str(name.value) for name in names]


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(
    "host",
    [
        "",
        " ",
        "a b",
        "learner.lab:7447",
        "10.0.0.7:7447",
        "10.0.0.0/8",
        "10.0.0.300",
        "[::1]",
        "a..b",
        ".",
        "-a",
        "*.lab",
        "a" * 64,
        "a." * 130 + "b",
        "tls/learner.lab",
        "learner\n.lab",
        "\x1b[2J",
        "lérner.lab",
        "学習.lab",
        "." * 500 + "é",
    ],
)
def test_what_is_no_host(host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["new", str(tmp_path / "certs"), f"--learner={host}"], capsys)
    assert (
        "is not a host; expected a name like learner.lab, or an address like 10.0.0.7, without port"
        in line
    )
    assert not list(tmp_path.iterdir())


def test_a_host_of_other_letters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["new", str(tmp_path / "certs"), "--learner", "größe.lab"], capsys)
    assert "without port; names of other letters have a form in ASCII, xn--..." in line


@pytest.mark.parametrize(
    "host",
    ["learner", "learner-1.lab", "farm_learner", "10.0.0.7", "::1", "a" * 63, "xn--gre-6ka8i.lab"],
)
def test_hosts(host: str, tmp_path: Path) -> None:
    assert main(["certificates", "new", str(tmp_path / "certs"), "--learner", host]) == 0
    assert hosts(tmp_path / "certs" / "learner") == [host]


@pytest.mark.parametrize("role", ["worker", "viewer"])
def test_names_that_a_certificate_does_not_take(
    role: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(tmp_path)
    for name in ("n" * 65, "n" * 100):
        expected = f"{role} {name} has {len(name)} characters; a certificate can have at most 64"
        assert expected in refused(
            ["add", str(folder), f"--{role}", "ok", f"--{role}", name], capsys
        )
        assert expected in refused(
            ["new", str(tmp_path / "b"), "--learner", "h", f"--{role}", name], capsys
        )
    for name in ("", "n" * 101, "größe", "a b", "a/b"):
        assert "is not a name" in refused(["add", str(folder), f"--{role}={name}"], capsys)
    assert files(tmp_path) == before
    assert main(["certificates", "add", str(folder), f"--{role}", "n" * 64]) == 0


def test_none_or_all(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error leaves no incomplete files."""
    before, issue = files(tmp_path), certificates.Authority.issue

    def full(self: Any, to: Path, role: Any, name: str, days: int, hosts: tuple[str, ...]) -> None:
        if name == "second":
            to.mkdir()
            raise OSError(28, "No space left on device")
        issue(self, to, role, name, days, hosts)

    monkeypatch.setattr(certificates.Authority, "issue", full)
    for words in (["add", str(folder)], ["new", str(tmp_path / "b"), "--learner", "h"]):
        with pytest.raises(ConfigError, match="cannot write to .*: No space left on device"):
            certificates.main([*words, "--worker", "first", "--worker", "second"])
    assert files(tmp_path) == before
    assert not (tmp_path / "b").exists()
    assert {path.name for path in folder.iterdir()} == {"ca", "learner", "worker-w1"}


def test_a_bundle_that_was_moved_stays_on_the_roster(folder: Path, tmp_path: Path) -> None:
    shutil.move(folder / "worker-w1", tmp_path / "elsewhere")
    shutil.move(folder / "learner", tmp_path / "there")
    assert main(["certificates", "add", str(folder), "--worker", "w2", "--viewer", "eva"]) == 0
    assert roster(folder / "ca") == {
        "learners": ["learner"],
        "workers": ["w1", "w2"],
        "viewers": ["eva"],
    }
    assert find(tmp_path / "elsewhere", "worker").name == "w1"
    assert main(["certificates", "add", str(folder), "--worker", "w1"]) == 2, (
        "two machines of one name"
    )


def test_a_roster_that_is_lost(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "ca" / "roster.json").unlink()
    line = refused(["add", str(folder), "--worker", "w2"], capsys)
    assert "roster.json is missing or damaged" in line
    assert "the learner's bundle has a copy" in line
    shutil.copy(folder / "learner" / "roster.json", folder / "ca")
    assert main(["certificates", "add", str(folder), "--worker", "w2"]) == 0
    assert roster(folder / "ca")["workers"] == ["w1", "w2"]


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"learners": 3, "workers": [], "viewers": []}', "[" * 100_000]
)
def test_a_damaged_roster(text: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "ca" / "roster.json").write_text(text)
    before = files(folder)
    assert "roster.json is missing or damaged" in refused(
        ["add", str(folder), "--worker", "w2"], capsys
    )
    assert files(folder) == before


def test_renewed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    learner, worker, authority = folder / "learner", folder / "worker-w1", files(folder / "ca")
    before = certificate(learner), certificate(worker)
    assert main(["certificates", "renew", str(folder), "--days", "30"]) == 0
    assert certificate(learner).serial_number != before[0].serial_number
    assert certificate(learner).not_valid_after_utc < before[0].not_valid_after_utc
    assert hosts(learner) == ["learner.lab", "10.0.0.7"]
    assert certificate(worker) == before[1]
    assert find(folder, "learner").roster().workers == ("w1",)
    assert files(folder / "ca") == authority

    assert (
        main(["certificates", "renew", str(folder), "--learner", "new.lab", "--worker", "w1"]) == 0
    )
    assert hosts(learner) == ["new.lab"]
    assert certificate(worker).serial_number != before[1].serial_number
    certificate(worker).verify_directly_issued_by(certificate(folder / "ca"))

    assert "no worker w9 is known" in refused(["renew", str(folder), "--worker", "w9"], capsys)
    shutil.move(learner, tmp_path / "there")
    assert "give its host names with --learner HOST" in refused(["renew", str(folder)], capsys)
    assert main(["certificates", "renew", str(folder), "--learner", "new.lab"]) == 0
    assert find(folder, "learner").roster().workers == ("w1",)


def test_a_key_that_others_can_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = folder / "worker-w1" / "key.pem"
    for mode in (0o644, 0o640, 0o602):
        key.chmod(mode)
        with pytest.raises(
            ConfigError, match=rf"can be read by other users \(mode {mode:04o}\).*: chmod 600 {key}"
        ):
            find(folder, "worker")
    key.chmod(0o400)
    assert find(folder, "worker").name == "w1"
    (folder / "ca" / "key.pem").chmod(0o644)
    assert "can be read by other users (mode 0644)" in refused(
        ["add", str(folder), "--worker", "w2"], capsys
    )


def test_another_name_than_the_certificates_is_refused(folder: Path) -> None:
    [bundle] = folder.glob("worker-*")
    name = bundle.name.removeprefix("worker-")
    assert tls.find(bundle, "worker", name).name == name
    with pytest.raises(
        ConfigError,
        match=f"--name other: the certificate in {bundle} is for {name}; leave --name out",
    ):
        tls.find(bundle, "worker", "other")


def test_a_bundle_that_cannot_be_read(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match="there is no such folder; expected the folder of a machine"
    ):
        tls.find(folder / "nowhere", "learner")
    (folder / "learner" / "cert.pem").write_text("no certificate")
    with pytest.raises(
        ConfigError, match=r"cert\.pem is damaged: expected PEM; copy the bundle again$"
    ):
        tls.find(folder, "learner")


def test_workers_are_told_a_name_that_the_certificate_has(folder: Path) -> None:
    bundle = tls.find(folder, "learner")
    assert bundle.hosts == tuple(hosts(folder / "learner"))
