"""The farm as compose.yaml starts it: real containers, some of which die."""

import json
import os
import shutil
import subprocess
import tarfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Farm, need_zenohd
from recordings import generations

from farm.commands import certificates

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
BASE, DEBIAN = "python:3.11-slim", "rolloutfarm-base:bookworm"
USER = os.geteuid() or 1000
"""Whom the programs in the images run as."""


def call(*command: str, **settings: str) -> str:
    """A command's output; the command must succeed."""
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout


def succeeds(*command: str) -> bool:
    return (
        bool(shutil.which(command[0]))
        and not subprocess.run(command, capture_output=True, check=False).returncode
    )


@pytest.fixture(scope="module")
def base() -> str:
    """The Dockerfile's base image if it is available, otherwise one made from Debian's packages."""
    if not succeeds("docker", "version"):
        pytest.skip("Docker does not run here")
    if succeeds("docker", "image", "inspect", BASE) or succeeds("docker", "pull", "--quiet", BASE):
        return BASE
    if os.geteuid() != 0 or not shutil.which("debootstrap"):
        pytest.skip(
            f"{BASE} is not to be had; a base of Debian's packages needs root and debootstrap"
        )
    call(str(ROOT / "tests/e2e/base_image.sh"), DEBIAN)
    return DEBIAN


class Stack:
    """The services of compose.yaml, under a project name that no other farm has."""

    def __init__(self, base: str) -> None:
        self._program = (
            ["docker", "compose"]
            if succeeds("docker", "compose", "version")
            else ["docker-compose"]
        )
        self._project = f"farm{uuid.uuid4().hex[:8]}"
        self.files: tuple[str, ...] = ()
        self._always: dict[str, str] = {
            "BASE": base,
            "FARM_UID": str(USER),
            "LIVE": "127.0.0.1:0",
            "PACKAGES": "rolloutfarm[gym]",
        }
        self.settings = self._always

    def compose(self, *words: str) -> str:
        files = [
            word for name in ("compose.yaml", *self.files) for word in ("-f", str(ROOT / name))
        ]
        return call(*self._program, "-p", self._project, *files, *words, **self.settings)

    def start(self, *files: str, **settings: str) -> None:
        self.files, self.settings = files, {**self._always, **settings}
        self.compose("up", "--detach")

    def containers(self, service: str) -> list[str]:
        return self.compose("ps", "--all", "--quiet", service).split()

    def container(self, service: str) -> str:
        (name,) = self.containers(service)
        return name

    def read(self, name: str, folder: Path) -> str:
        """A file of the run; empty if it does not exist yet."""
        return self.fetch("learner", f"runs/{self.settings['RUN']}/{name}", folder).decode()

    def fetch(self, service: str, path: str, folder: Path) -> bytes:
        """A file from a service's container; empty if it does not exist yet."""
        command = ["docker", "cp", f"{self.container(service)}:/farm/{path}", "-"]
        with (folder / "copied.tar").open("w+b") as file:
            if subprocess.run(command, stdout=file, stderr=subprocess.PIPE, check=False).returncode:
                return b""
            file.seek(0)
            with tarfile.open(fileobj=file) as tar:
                member = tar.extractfile(Path(path).name)
                assert member
                return member.read()

    def healthy(self, service: str) -> bool:
        """Whether the service's own health check passes in each of its containers, asked now."""
        for container in self.containers(service):
            kind, check = json.loads(
                call("docker", "inspect", "-f", "{{json .Config.Healthcheck.Test}}", container)
            )
            assert kind == "CMD-SHELL"
            if not succeeds("docker", "exec", container, "sh", "-c", check):
                return False
        return True

    def hash_at_the_end(self, folder: Path) -> str:
        """The run's hash, once its learner has ended."""
        status = call("docker", "wait", self.container("learner")).strip()
        assert status == "0", self.compose("logs", "--no-color", "--tail", "50")
        return str(json.loads(self.read("summary.json", folder))["parameters_sha256"])

    def end(self, *words: str) -> None:
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5", *words)


@pytest.fixture(scope="module")
def images(base: str) -> Iterator[Stack]:
    built = Stack(base)
    try:
        built.compose("build", "--quiet")
        yield built
    finally:
        built.files = ()
        built.end("--rmi", "local")


@pytest.fixture
def stack(images: Stack) -> Iterator[Stack]:
    yield images
    images.end()


def outside(farm: Farm, **settings: str) -> str:
    """The hash of the same run without containers."""
    variables = [name for name in ("TASK", "SEED", "GENERATIONS", "PAIRS") if name in settings]
    flags = [word for name in variables for word in (f"--{name.lower()}", settings[name])]
    farm.call("run", "--name", settings["RUN"], "--no-record", *flags, timeout=300)
    return str(farm.summary(settings["RUN"])["parameters_sha256"])


def exit_statuses(containers: list[str]) -> set[str]:
    return {
        call("docker", "inspect", "-f", "{{.State.ExitCode}}", container).strip()
        for container in containers
    }


def test_containers_that_die(farm: Farm, stack: Stack) -> None:
    settings = {"RUN": "boxed", "SEED": "3", "GENERATIONS": "100000", "PAIRS": "15"}
    stack.start(**settings)

    def done() -> int:
        return stack.read("progress.jsonl", farm.folder).count("\n")

    def goes_on() -> None:
        before = done()
        farm.wait_for(lambda: done() >= before + 20, 60)

    goes_on()
    assert all(stack.healthy(service) for service in ("router", "learner", "worker"))
    stack.compose("up", "--detach", "--no-recreate", "--scale", "worker=3")
    farm.wait_for(lambda: '"workers": 3' in stack.read("progress.jsonl", farm.folder), 60)
    killed, *left = stack.containers("worker")
    call("docker", "kill", killed)
    goes_on()
    stack.compose("stop", "router")
    assert not stack.healthy("learner")
    stack.compose("start", "router")
    goes_on()
    learner = stack.container("learner")
    call("docker", "kill", learner)
    call("docker", "start", learner)
    goes_on()
    stack.compose("stop", "learner", "worker")
    assert exit_statuses([learner]) == {"130"}
    assert exit_statuses(left) == {"0"}
    summary = json.loads(stack.read("summary.json", farm.folder))
    lines = stack.read("progress.jsonl", farm.folder).splitlines()
    assert [json.loads(line)["generation"] for line in lines] == list(
        range(1, summary["generations"] + 1)
    )
    assert summary["state"] == "interrupted"
    assert "continuing after generation" in stack.compose("logs", "--no-color", "learner")
    expected = outside(farm, **{**settings, "GENERATIONS": str(summary["generations"])})
    assert summary["parameters_sha256"] == expected


@pytest.mark.parametrize(
    "settings",
    [
        {"TASK": "tasks/own.py:Own", "ALLOW": "--allow-file tasks/own.py"},
        {"TASK": "gym:Pusher-v5"},
    ],
    ids=["file", "package"],
)
def test_a_task_of_ones_own(farm: Farm, stack: Stack, settings: dict[str, str]) -> None:
    (farm.folder / "tasks").mkdir()
    farm.call("new-task", "own")
    shutil.move(farm.folder / "own.py", farm.folder / "tasks")
    # Long enough that the recorder's container is up before the run is over, also on a busy
    # machine.
    run = {"RUN": "own", "SEED": "6", "GENERATIONS": "100", "PAIRS": "4", **settings}
    stack.start(TASKS=str(farm.folder / "tasks"), **run)
    assert stack.hash_at_the_end(farm.folder) == outside(farm, **run)
    assert call("docker", "wait", stack.container("recorder")).strip() == "0"
    recording = farm.folder / "run.rrd"
    recording.write_bytes(stack.fetch("recorder", "recordings/own/run.rrd", farm.folder))
    assert generations(recording) == list(range(1, 101))


def test_certificates(farm: Farm, stack: Stack) -> None:
    certs = farm.folder / "certs"
    settings = {"RUN": "sealed", "SEED": "4", "GENERATIONS": "20", "PAIRS": "6"}
    hosts = ("--learner", "router", "--learner", "127.0.0.1")
    certificates.main(["new", str(certs), *hosts, "--worker", "compose", "--viewer", "health"])
    if os.geteuid() == 0:
        for path in (certs, *certs.rglob("*")):
            os.chown(path, USER, USER)
    stack.start("compose.tls.yaml", CERTS=str(certs), PUBLISH="127.0.0.1:0", **settings)
    assert stack.hash_at_the_end(farm.folder) == outside(farm, **settings)
    assert stack.healthy("router")
    assert stack.healthy("worker")
    assert call("docker", "wait", stack.container("recorder")).strip() == "0"
    recording = farm.folder / "run.rrd"
    recording.write_bytes(stack.fetch("recorder", "recordings/sealed/run.rrd", farm.folder))
    assert generations(recording) == list(range(1, 21))
    published = stack.compose("port", "router", "7447").strip()
    assert published.startswith("127.0.0.1:")
    farm.call(
        "status",
        "--connect",
        f"tls/{published}",
        "--tls",
        str(certs / "viewer-health"),
        "--worker",
        "compose",
    )


def test_the_official_router(farm: Farm, base: str, stack: Stack) -> None:
    """A zenohd under the official image's name for it: an entry point that takes zenohd's
    arguments.
    """
    shutil.copy(need_zenohd(), farm.folder / "zenohd")
    (farm.folder / "Dockerfile").write_text(f'FROM {base}\nCOPY zenohd /\nENTRYPOINT ["/zenohd"]\n')
    image = f"zenohd-{uuid.uuid4().hex[:8]}"
    config = farm.folder / "router.json5"
    settings = {"RUN": "routed", "SEED": "5", "GENERATIONS": "20", "PAIRS": "6"}
    config.write_text(
        farm.call("router", "--print-config", "--listen", "tcp/0.0.0.0:7447", "--trust-network")
    )
    try:
        call("docker", "build", "--quiet", "--tag", image, str(farm.folder))
        stack.start(
            "compose.zenohd.yaml", ROUTER_IMAGE=image, ROUTER_CONFIG=str(config), **settings
        )
        assert stack.containers("router") == []
        assert stack.hash_at_the_end(farm.folder) == outside(farm, **settings)
    finally:
        stack.end()
        call("docker", "image", "rm", "--force", image)
