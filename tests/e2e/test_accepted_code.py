"""Tasks sent by the learner: edited here, learnt by running workers; other machines cannot send
one.
"""

import contextlib
import hashlib
import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import made
import numpy as np
import pytest
from network import Network, address
from processes import Farm
from robot import robot

from farm.commands import certificates
from farm.errors import FarmError
from farm.net import codec, keys, session
from farm.net.session import Session, free_endpoint
from farm.net.tls import Bundle, Roster, find
from farm.net.work import RoundHeader
from learner.tools.replay.loaded import load
from learner.tools.replay.rewind import rewind

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]

FEW = ("--generations", "2", "--pairs", "4", "--no-record")


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates")
    workers = ("--worker", "w1", "--worker", "w2", "--viewer", "eva")
    certificates.main(["new", str(folder / "own"), "--learner", "127.0.0.1", *workers])
    certificates.main(["new", str(folder / "foreign"), "--learner", "127.0.0.1", "--worker", "w1"])
    return folder


@pytest.fixture
def task(farm: Farm) -> Path:
    return made.pole(farm.folder)


@pytest.fixture
def router(farm: Farm, certs: Path) -> str:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    farm.start_router(endpoint, "--tls", str(certs / "own"))
    return endpoint


def hire(farm: Farm, endpoint: str, certs: Path, name: str, *flags: str) -> Any:
    """A worker that has joined."""
    words = (
        "worker",
        "--connect",
        endpoint,
        "--tls",
        str(certs / "own"),
        "--name",
        name,
        "--workers",
        "1",
        *flags,
    )
    worker = farm.start(*words)
    warned = "--accept-code: learners of this farm run their code here, as this user"
    assert any(
        (warned if "--accept-code" in flags else "joined as") in line for line in worker.stdout
    )
    return worker


def learner(farm: Farm, endpoint: str, certs: Path, name: str, *flags: str) -> Any:
    words = (
        "--connect",
        endpoint,
        "--tls",
        str(certs / "own"),
        "--task",
        "pole.py:Pole",
        "--name",
        name,
    )
    return farm.start("learner", *words, *FEW, *flags)


SOON = 10.0
"""Generous, for a machine that has other things to do [s]; an idle one takes less than 1."""


def until_a_generation(process: Any) -> float:
    """Time from a run's announcement to a whole generation [s]; the run is waited for."""
    for line in process.stdout:
        if '"event": "run"' in line:
            start = time.monotonic()
        if '"event": "generation"' in line:
            seconds = time.monotonic() - start
            break
    process.communicate(timeout=60)
    assert process.returncode == 0
    return seconds


def output_of(process: Any) -> str:
    process.terminate()
    return process.communicate(timeout=20)[0]


def test_an_edited_task_is_learnt_at_once_by_workers_that_stay(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    workers = [hire(farm, router, certs, name, "--accept-code") for name in ("w1", "w2")]
    texts = [made.POLE.replace("np.cos", f"{factor} * np.cos") for factor in (1, 2, 3)]
    took = []
    for i, text in enumerate(texts):
        task.write_text(text)
        took.append(until_a_generation(learner(farm, router, certs, f"r{i}", "--json")))
    farm.call("run", "--task", "pole.py:Pole", "--name", "here", "--workers", "2", *FEW)
    assert max(took) < SOON
    output = "".join(map(output_of, workers))
    for i, text in enumerate(texts):
        digest = hashlib.sha256(text.encode()).hexdigest()
        assert f"run r{i}: received pole.py (SHA-256 {digest}) from its learner" in output
    assert len({farm.summary(f"r{i}")["mean_policy_return"] for i in range(3)}) == 3, (
        "each is another task"
    )
    assert farm.summary("here")["parameters_sha256"] == farm.summary("r2")["parameters_sha256"]


def test_neighbours_travel_with_their_task(farm: Farm, certs: Path, router: str) -> None:
    """Two workers in empty folders; an edited neighbour is another task."""
    folder = farm.folder / "tasks"
    made.pole(
        folder,
        "__neighbours__ = ('gaits',)\nimport"
        f" gaits\n{made.POLE.replace('np.cos', 'gaits.SIZE * np.cos')}",
    )
    words = ("--connect", router, "--tls", str(certs / "own"), "--task", "tasks/pole.py:Pole", *FEW)
    workers = [hire(farm, router, certs, name, "--accept-code") for name in ("w1", "w2")]
    try:
        for size in (1, 3):
            (folder / "gaits.py").write_text(f"SIZE = {size}\n")
            farm.call("learner", *words, "--name", f"r{size}")
            farm.call("run", "--task", "tasks/pole.py:Pole", "--name", f"here{size}", *FEW)
            there, here = (farm.summary(f"{name}{size}") for name in ("r", "here"))
            assert there["parameters_sha256"] == here["parameters_sha256"]
            assert there["robust_return"] == pytest.approx(4.0 * size, rel=0.1)
    finally:
        output = "".join(map(output_of, workers))
    assert output.count("received pole.py") == 4


def test_a_robot_in_files_is_learnt_by_a_worker_in_an_empty_folder(
    farm: Farm, certs: Path, router: str
) -> None:
    """Meshes, a moving goal and pushes: checked, learnt over TLS by a worker that has nothing,
    repeated bit by bit.
    """
    robot(farm.folder)
    assert "same bits together" in farm.call("check", "reach.py:Reach", "--picture", "reach.png")
    empty = farm.folder / "elsewhere"
    empty.mkdir()
    other = Farm(empty)
    words = ("--connect", router, "--tls", str(certs / "own"))
    worker = other.start("worker", *words, "--name", "w1", "--workers", "1", "--accept-code")
    flags = (
        "--task",
        "reach.py:Reach",
        "--policy",
        "linear",
        "--generations",
        "3",
        "--pairs",
        "4",
        "--no-record",
    )
    try:
        farm.call("learner", *words, *flags, "--name", "there")
    finally:
        output = output_of(worker)
    assert "run there: received reach.py" in output
    assert not list(empty.iterdir())
    farm.call("run", *flags, "--name", "here")
    summary = farm.summary("there")
    assert summary["parameters_sha256"] == farm.summary("here")["parameters_sha256"]
    shutil.rmtree(farm.folder / "robot")
    run = farm.folder / "runs/there"
    assert load(run).rollout().trajectory.value == summary["mean_policy_return"]
    for line in farm.progress("there"):
        assert rewind(run, line["generation"]).returns.max() == line["return_max"]


def test_what_is_edited_on_one_host_is_learnt_by_two_others(farm: Farm, task: Path) -> None:
    with closing(Network(3)) as network:
        names = [word for name in ("left", "right") for word in ("--worker", name)]
        farm.call("certificates", "new", "certs", "--learner", address(0), *names)
        join = ("--connect", f"tls/{address(0)}:7447", "--tls")
        farm.start("router", "--listen", join[1], "--tls", "certs/learner", host=network.hosts[0])
        flags = ("--workers", "1", "--accept-code")
        workers = [
            farm.start("worker", *join, f"certs/worker-{name}", *flags, host=host)
            for name, host in zip(("left", "right"), network.hosts[1:], strict=True)
        ]
        for worker in workers:
            assert any("joined as" in line for line in worker.stdout or ())
        for name, text in (
            ("first", made.POLE),
            ("second", made.POLE.replace("np.cos", "-np.cos")),
        ):
            task.write_text(text)
            words = (
                "--task",
                "pole.py:Pole",
                "--name",
                name,
                "--generations",
                "20",
                "--pairs",
                "20",
                "--no-record",
            )
            process = farm.start("learner", *join, "certs/learner", *words, host=network.hosts[0])
            output, _ = process.communicate(timeout=60)
            assert process.returncode == 0, output
        for worker in workers:
            output = output_of(worker)
            for name in ("first", "second"):
                assert f"run {name}: received pole.py" in output
                assert f"serving run {name}" in output


def test_a_worker_without_accept_code_says_which_flag(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    plain = hire(farm, router, certs, "w1")
    process = learner(farm, router, certs, "r")
    words = "allow it by --allow-file pole.py, or start this worker with --accept-code and --tls"
    assert any("does not serve this run" in line and words in line for line in process.stdout)
    hire(farm, router, certs, "w2", "--accept-code")
    process.communicate(timeout=60)
    assert process.returncode == 0, "others serve it"
    assert words in output_of(plain)


def test_an_import_error_is_told_to_the_author_and_the_worker_lives_on(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    worker = hire(farm, router, certs, "w1", "--accept-code")
    task.write_text(
        "import os\ndef look():\n    os.environ['PYTEST_CURRENT_TEST']\nlook()\n" + made.POLE
    )
    process = learner(farm, router, certs, "broken")
    lines = []
    for line in process.stdout:
        lines.append(line.rstrip())
        if "KeyError" in line and "cannot be imported" not in line:
            break
    [first] = [i for i, line in enumerate(lines) if "does not serve this run" in line]
    assert "pole.py cannot be imported: line 3: KeyError: 'PYTEST_CURRENT_TEST'" in lines[first]
    assert '  File "pole.py", line 4, in <module>' in lines[first + 1]
    assert '  File "pole.py", line 3, in look' in "\n".join(lines[first:])
    output_of(process)
    task.write_text(made.POLE)
    repaired = learner(farm, router, certs, "repaired")
    repaired.communicate(timeout=60)
    assert repaired.returncode == 0
    assert worker.poll() is None


def test_a_worker_that_lacks_a_file_ends_nothing_and_a_good_one_learns(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    """Received code runs in an empty folder: what it reads itself from beside the task is not
    there.
    """
    (farm.folder / "limits.txt").write_text("1.0")
    reads = (
        "from pathlib import Path\nLIMIT ="
        " float(Path(__file__).with_name('limits.txt').read_text())\n"
    )
    task.write_text(reads + made.POLE)
    bad = hire(farm, router, certs, "w1", "--accept-code")
    process = learner(farm, router, certs, "r")
    refused = next(line for line in process.stdout if "does not serve this run" in line)
    assert "worker w1/" in refused
    assert "limits.txt" in refused
    good = hire(farm, router, certs, "w2", "--allow-file", "pole.py")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert "failed wherever" not in output
    assert farm.summary("r")["state"] == "finished"
    assert "cannot serve run r" in output_of(bad)
    assert "cannot serve" not in output_of(good)


def test_what_is_refused_at_the_start(farm: Farm, certs: Path, task: Path) -> None:
    output = farm.call("worker", "--accept-code", "--workers", "1", status=2)
    assert (
        output == "farm: --accept-code needs --tls: without certificates anyone could send code\n"
    )
    task.write_text(made.POLE + "#" * 1_000_000)
    tls = ("--listen", free_endpoint().replace("tcp/", "tls/"), "--tls", str(certs / "own"))
    output = farm.call("learner", "--task", "pole.py:Pole", "--name", "large", *FEW, *tls, status=2)
    assert "a class's file travels to workers and has at most 1000000" in output
    assert len(output.splitlines()) == 1
    assert not (farm.folder / "runs").exists()


EVIL = b"raise SystemExit('evil')"


def pose(opened: Session, worker: str, run: str) -> None:
    """Do everything that the learner of such a task does."""
    digest = hashlib.sha256(EVIL).hexdigest()
    spec = codec.encode(
        made.spec(run=run, task="evil.py:Evil", policy="linear", code={"task": digest})
    )
    header = RoundHeader(
        run=run,
        incarnation="i",
        round=1,
        generation=0,
        spec=hashlib.sha256(spec).hexdigest(),
        traces="none",
        mu=np.zeros(2),
    )
    for key, payload in (
        (keys.spec("farm", run), spec),
        (keys.generation("farm", run), codec.encode(header)),
        (keys.code("farm", run, digest), EVIL),
        ("farm/**", EVIL),
    ):
        opened.answer(key, lambda payload=payload: payload)
    opened.token(keys.learner_token("farm", run))
    opened.publish(keys.generation("farm", run), codec.encode(header))
    opened.publish(keys.inbox("farm", worker), b"")


@contextlib.contextmanager
def holding(endpoint: str, bundle: Bundle) -> Iterator[Session]:
    with session.connect((endpoint,), 5, lambda: False, bundle) as opened:
        yield opened


def test_a_workers_or_a_viewers_certificate_sends_no_code(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    folder = certs / "own"
    evil, honest = hashlib.sha256(EVIL).hexdigest(), hashlib.sha256(task.read_bytes()).hexdigest()
    with (
        holding(router, find(folder, "worker", "w2")) as w2,
        holding(router, find(folder, "viewer", "eva")) as eva,
        holding(router, find(folder, "viewer", "eva")) as looking,
        holding(router, find(folder, "learner")) as witness,
    ):
        for liar, run in ((w2, "fake"), (eva, "false")):
            pose(liar, "w1/1", run)
            pose(liar, "w1/1", "r")
        process = learner(farm, router, certs, "r")
        farm.wait_for(lambda: witness.ask(keys.code("farm", "r", honest), 0.5) == task.read_bytes())
        assert looking.ask(keys.code("farm", "r", honest), 0.5) is None, "a viewer reads no source"
        worker = hire(farm, router, certs, "w1", "--accept-code")
        process.communicate(timeout=60)
        for run in ("fake", "false", "r"):  # the liars had the time of a whole run
            assert not witness.present(keys.learner_token("farm", run), 0.5)
            assert witness.ask(keys.code("farm", run, evil), 0.5) is None
    assert process.returncode == 0
    output = output_of(worker)
    assert "pole.py" in output
    assert not {"evil", "fake", "false"} & set(output.replace(":", " ").split())


class Posing(Bundle):
    """A worker's bundle, used to listen as a learner does."""

    def roster(self) -> Roster:
        return Roster(("w2",), ("w1",), ())


@pytest.mark.parametrize("who", ["foreign", "worker"])
def test_a_listener_without_a_learners_certificate_of_this_authority_sends_no_code(
    certs: Path, who: str
) -> None:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    folder = certs / "own" / "worker-w2"
    bundle = (
        find(certs / "foreign", "learner") if who == "foreign" else Posing(folder, "learner", "w2")
    )
    with session.listen(endpoint, "farm", bundle) as liar:
        pose(liar, "w1/1", "fake")
        with (
            pytest.raises(FarmError, match="no answer from"),
            holding(endpoint, find(certs / "own", "worker", "w1")),
        ):
            pass


def test_a_foreign_learner_does_not_reach_the_router(
    farm: Farm, certs: Path, router: str, task: Path
) -> None:
    worker = hire(farm, router, certs, "w1", "--accept-code")
    words = (
        "--connect",
        router,
        "--tls",
        str(certs / "foreign"),
        "--task",
        "pole.py:Pole",
        "--name",
        "foreign",
        *FEW,
    )
    foreign = farm.start("learner", *words)
    assert any("its certificate is of another authority" in line for line in foreign.stdout)
    output_of(foreign)
    assert "foreign" not in output_of(worker)
