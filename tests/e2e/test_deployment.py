"""The files of docs/deployment: each is checked by the program that it is for, and its commands
learn.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from processes import SMALL, Farm

from farm.commands import certificates
from farm.net.session import free_endpoint

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FILES = ROOT / "docs/deployment"
MANIFEST = list(yaml.safe_load_all((FILES / "kubernetes.yaml").read_text()))
RELEASES = ("1.31", "1.37")
"""Of Kubernetes: the first with all that the manifest asks for, and the newest that the validator
knows.
"""

Place = tuple[str, Callable[[str], str]]


@pytest.fixture
def place(farm: Farm) -> Place:
    """A free endpoint, and a function that replaces the files' addresses and folders by those of
    this test.
    """
    endpoint, certs = free_endpoint().replace("tcp", "tls"), farm.folder / "certs"
    certificates.main(
        ["new", str(certs), "--learner", "127.0.0.1", "--worker", "w", "--viewer", "v"]
    )
    paths = {
        "/opt/rolloutfarm/bin/farm": "farm",
        "${FARM_ROUTER}": endpoint,
        "tls/farm-router:7447": endpoint,
        "tls/0.0.0.0:7447": endpoint,
        "/etc/rolloutfarm/first.json": str(farm.folder / "first.json"),
        "/runs": "runs",
        **{
            f"{folder}/learner": str(certs / "learner") for folder in ("/certs", "/etc/rolloutfarm")
        },
        **{
            f"{folder}/worker": str(certs / "worker-w") for folder in ("/certs", "/etc/rolloutfarm")
        },
        "/certs/health": str(certs / "viewer-v"),
    }
    return endpoint, lambda word: paths.get(
        word.replace("%i", "first"), word.replace("%i", "first")
    )


def learn(
    farm: Farm, router: list[str], worker: list[str], learner: list[str], *settings: str
) -> None:
    """Start these commands; the run ends with the hash of the same run on one machine."""
    started = farm.start(*router)
    assert started.stdout
    assert "router at" in started.stdout.readline()
    farm.start(*worker)
    farm.call(*learner, *settings)
    farm.call("run", "--name", "here", "--generations", "5", *SMALL)
    assert farm.summary("first")["parameters_sha256"] == farm.summary("here")["parameters_sha256"]


def container(name: str) -> dict[str, Any]:
    (settings,) = (
        container
        for part in MANIFEST
        for container in part["spec"].get("template", {}).get("spec", {}).get("containers", ())
        if container["name"] == name
    )
    return settings


@pytest.mark.parametrize("release", RELEASES)
def test_the_manifest_is_what_kubernetes_takes(release: str) -> None:
    for part in MANIFEST:
        kubernetes_validate.validate(part, release, strict=True)
    container("learner")["imagePolicy"] = "Always"
    try:
        with pytest.raises(kubernetes_validate.ValidationError):
            kubernetes_validate.validate(MANIFEST[-1], release, strict=True)
    finally:
        del container("learner")["imagePolicy"]


def test_the_manifest_fits_together() -> None:
    service, router, worker, claim, job = MANIFEST
    for part in (router, worker):
        assert (
            part["spec"]["selector"]["matchLabels"]
            == part["spec"]["template"]["metadata"]["labels"]
        )
    assert service["spec"]["selector"] == router["spec"]["selector"]["matchLabels"]
    assert f"tls/{service['metadata']['name']}:7447" in container("worker")["args"]
    for part in (router, worker, job):
        pod = part["spec"]["template"]["spec"]
        mounted = {mount["name"] for mount in pod["containers"][0]["volumeMounts"]}
        assert mounted == {volume["name"] for volume in pod["volumes"]}
    volumes = {volume["name"]: volume for volume in job["spec"]["template"]["spec"]["volumes"]}
    assert volumes["runs"]["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
    assert volumes["tasks"]["configMap"]["optional"], (
        "a farm without tasks of its own does not start"
    )


def test_the_manifests_commands_learn(farm: Farm, place: Place) -> None:
    endpoint, here = place
    router, worker, learner = (
        [here(word) for word in container(n)["args"]] for n in ("router", "worker", "learner")
    )
    learn(farm, router, worker, learner, "--generations", "5", "--pairs", "6")
    alive = [here(word) for word in container("router")["livenessProbe"]["exec"]["command"]]
    ready = [here(word) for word in container("learner")["readinessProbe"]["exec"]["command"]]
    assert alive[0] == ready[0] == "farm"
    farm.call(*alive[1:])
    farm.call(*ready[1:], status=1)  # its learner has ended
    farm.start(
        *learner[:-1], "--no-record", "--generations", "100000", "--name", "again", "--pairs", "6"
    )
    farm.wait_for(lambda: farm.progress("again"))
    farm.call(*["again" if word == "first" else word for word in ready[1:]])


def unit(name: str) -> list[str]:
    """The command that a unit starts."""
    text = (FILES / name).read_text().replace("\\\n", "")
    (line,) = (line for line in text.splitlines() if line.startswith("ExecStart="))
    return shlex.split(line.removeprefix("ExecStart="))


def test_the_units_commands_learn(farm: Farm, place: Place) -> None:
    _, here = place
    farm.call("run", "--no-record", "--name", "settings", "--generations", "5", "--pairs", "6")
    shutil.copy(farm.folder / "runs/settings/config.json", farm.folder / "first.json")
    names = ("farm-router.service", "farm-worker.service", "farm-learner@.service")
    commands = [[here(word) for word in unit(name)] for name in names]
    assert {command[0] for command in commands} == {"farm"}
    learn(farm, *(command[1:] for command in commands))


def test_units_are_what_systemd_takes(tmp_path: Path) -> None:
    if not shutil.which("systemd-analyze"):
        pytest.skip("systemd-analyze is not installed (Debian: systemd)")
    program = Path(sys.executable).with_name("farm")
    paths = []
    for path in FILES.glob("*.service"):
        paths.append(tmp_path / path.name.replace("@", "@first"))
        paths[-1].write_text(path.read_text().replace("/opt/rolloutfarm/bin/farm", str(program)))
    assert len(paths) == 3
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *map(str, paths)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, [line for line in done.stderr.splitlines() if "farm-" in line]) == (
        0,
        [],
    )


def test_shell_scripts_are_clean() -> None:
    if not shutil.which("shellcheck"):
        pytest.skip("shellcheck is not installed (Debian: shellcheck)")
    scripts = [
        FILES / "workers.sbatch",
        ROOT / "tests/e2e/base_image.sh",
        *(ROOT / ".ci").iterdir(),
    ]
    done = subprocess.run(
        ["shellcheck", *map(str, scripts)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_a_slurm_task_works_and_leaves(
    farm: Farm, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, _ = place
    certs = farm.folder / "certs"
    for name, value in (("ROUTER", endpoint), ("CERTS", str(certs / "worker-w"))):
        monkeypatch.setenv(f"FARM_{name}", value)
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
    monkeypatch.setenv("FARM", str(Path(sys.executable).with_name("farm")))
    task = farm.start_program("bash", str(FILES / "workers.sbatch"))
    learner = ("learner", "--listen", endpoint, "--tls", str(certs / "learner"), "--name", "first")
    farm.call(*learner, "--generations", "5", *SMALL)
    assert farm.summary("first")["workers"] == 2
    task.terminate()
    task.communicate(timeout=10)
    assert task.returncode == 0
    monkeypatch.delenv("FARM_ROUTER")
    done = subprocess.run(
        ["bash", FILES / "workers.sbatch"], env=os.environ, capture_output=True, check=False
    )
    assert done.returncode == 1
    assert b"where learner or router listens" in done.stderr
