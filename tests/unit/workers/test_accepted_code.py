"""Code sent by a learner: when it is fetched, what is refused, and what its process can still
access.
"""

import hashlib
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import POLE, pole, spec_of
from stage import FARM, WAIT, Learner, Runner, Stage, indices, until

from farm import plugins, subprocess_runner
from farm.commands import certificates
from farm.errors import ConfigError, UnservedError
from farm.neighbours import MAGIC, packed
from farm.net import keys
from farm.net.session import Session, connect, free_endpoint, listen
from farm.net.tls import find
from farm.net.work import Failure
from workers.config import WorkerConfig
from workers.source_cache import SourceCache
from workers.worker import Worker


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates") / "own"
    certificates.main(["new", str(folder), "--learner", "127.0.0.1", "--worker", "w"])
    return folder


@pytest.fixture
def safe(certs: Path) -> Iterator[Stage]:
    """A stage with certificates, whose workers simulate."""
    Runner.go = threading.Event()
    endpoint = free_endpoint().replace("tcp/", "tls/")
    with listen(endpoint, FARM, find(certs, "learner")) as session:
        opened = Stage(session, endpoint)
        yield opened
        opened.close()


class Author(Learner):
    """A learner of a run whose task is a class in a file; workers may ask it for the file."""

    def __init__(
        self,
        stage: Stage,
        file: Path,
        run: str = "r",
        sends: bytes | None = None,
        presence: Session | None = None,
    ) -> None:
        self.source = plugins.find("tasks", f"{file}:Pole").source
        spec = spec_of(file)
        if sends is not None:
            spec = replace(spec, code=spec.code | {"task": digest(file)})
        key = keys.code(FARM, run, digest(file))
        stage.session.answer(
            key, lambda: self._say("code", self.source if sends is None else sends)
        )
        super().__init__(stage.session, run, spec, presence)
        self.header = replace(self.header, mu=np.ones(2), traces="none")


def digest(file: Path) -> str:
    return plugins.file_digest(file)


def write(folder: Path, text: str = "", name: str = "pole.py") -> Path:
    """The pole's file with something before it."""
    return pole(folder, text + POLE, name)


def hire(stage: Stage, certs: Path) -> Worker:
    return stage.hire(tls=certs, accept_code=True)


def kept(file: Path) -> list[Path]:
    """Where workers of this machine keep that file."""
    return list(Path(tempfile.gettempdir()).glob(f"rolloutfarm-code-*/{digest(file)}/*"))


def alive(pid: int) -> bool:
    """Whether the process is there, and more than an entry that nobody has read."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


def test_it_is_fetched_once_and_run_elsewhere(
    safe: Stage,
    certs: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setenv("A_SECRET", "s")
    log = tmp_path / "said"
    spy = f"""
import os, sys
if sys.argv[0].endswith("runner_process.py"):
    bound, session = "NoNewPrivs:\\t1" in open("/proc/self/status").read(), "zenoh" in sys.modules
    with open({str(log)!r}, "a") as file:
        here = os.getpid(), os.getcwd(), os.listdir()
        print(*here, bound, session, *os.environ, sep="|", file=file)
print("noise")
"""
    file = write(tmp_path, spy)
    author, other = Author(safe, file), Author(safe, file, "again")
    worker = hire(safe, certs)
    for learner in (author, author, other):
        learner.send(worker.id, 0, 1)
        returns = safe.results(learner.run).returns
        assert (returns > 3.9).all(), "four steps of at most 1"
    assert author.asked["code"] + other.asked["code"] == 1, "a source is fetched once, for all runs"
    assert f"received pole.py (SHA-256 {digest(file)}) from its learner" in caplog.text
    [copy] = kept(file)
    assert copy.read_bytes() == file.read_bytes()
    assert copy.parents[1].stat().st_mode & 0o077 == 0
    lines = [line.split("|") for line in log.read_text().splitlines()]
    assert len(lines) == 2, "one process for each run"
    for pid, folder, content, bound, session, *names in lines:
        assert int(pid) != os.getpid()
        assert (Path(folder), content) == (copy.parents[1] / "run", "[]")
        assert (bound, session) == ("True", "False"), "no new privileges, and no session"
        assert not {"A_SECRET", "HOME"} & set(names)
    safe.let_go()


@pytest.mark.slow
def test_a_process_that_dies_is_begun_again_and_ends_with_its_run(
    safe: Stage, certs: Path, tmp_path: Path
) -> None:
    log = tmp_path / "said"
    spy = f"""
import os, sys
if sys.argv[0].endswith("runner_process.py"):
    print(os.getpid(), file=open({str(log)!r}, "a"))
"""
    with connect((safe.endpoint,), WAIT, lambda: False, find(certs, "learner")) as presence:
        author, worker = Author(safe, write(tmp_path, spy), presence=presence), hire(safe, certs)
        author.send(worker.id, 0)
        safe.results()
        first = int(log.read_text())
        os.kill(first, signal.SIGKILL)
        until(lambda: not alive(first))
        author.send(worker.id, 1)
        assert indices(safe.results()) == [1], "its job is tried once more"
        second = int(log.read_text().split()[-1])
        assert second != first
    until(lambda: not Path(f"/proc/{second}").exists())


@pytest.mark.parametrize(
    ("sends", "words"),
    [
        (b"x = 1\n", "the received source of pole.py does not match its digest"),
        (b"#" * 1_000_001, "the received source of pole.py has more than 1000000 bytes"),
    ],
    ids=["digest", "size"],
)
def test_what_does_not_fit_is_not_run(
    safe: Stage, certs: Path, tmp_path: Path, sends: bytes, words: str
) -> None:
    file = write(tmp_path, f"# for {tmp_path} alone\n")
    author, worker = Author(safe, file, sends=sends), hire(safe, certs)
    author.send(worker.id, 0)
    failure = safe.failure()
    assert (failure.index, failure.error) == (None, words)
    assert not kept(file)


def test_a_worker_without_accept_code_fetches_none(
    safe: Stage, certs: Path, tmp_path: Path
) -> None:
    author, worker = Author(safe, write(tmp_path)), safe.hire(tls=certs)
    author.send(worker.id, 0)
    failure = safe.failure()
    assert failure.index is None
    assert (
        "allow it by --allow-file pole.py, or start this worker with --accept-code and --tls"
        in failure.error
    )
    assert not author.asked["code"]


@pytest.mark.parametrize("name", ["a/pole.py", "..py", "\0.py", "po\nle.py"])
def test_a_name_that_leads_elsewhere(safe: Stage, certs: Path, tmp_path: Path, name: str) -> None:
    learner = Learner(safe.session, "r", replace(spec_of(write(tmp_path)), task=f"{name}:Pole"))
    worker = hire(safe, certs)
    learner.send(worker.id, 0)
    assert "is not a valid name for a file" in safe.failure().error


def test_an_import_error_is_told_with_its_traceback_and_the_worker_lives_on(
    safe: Stage, certs: Path, tmp_path: Path
) -> None:
    guard = "import sys\nhere = sys.argv[0].endswith('runner_process.py')\n"
    broken = write(
        tmp_path,
        guard + "def load():\n    import nowhere_to_be_found\nif here: load()\n",
        "broken.py",
    )
    author = Author(safe, broken)
    other = Author(safe, write(tmp_path), "other")
    worker = hire(safe, certs)
    author.send(worker.id, 0, 1)
    failure = safe.failure()
    assert failure.index is None
    assert (
        failure.error
        == "broken.py cannot be imported: line 4: ModuleNotFoundError: No module named"
        " 'nowhere_to_be_found'"
    )
    assert failure.traceback == (
        '  File "broken.py", line 5, in <module>',
        "    if here: load()",
        '  File "broken.py", line 4, in load',
        "    import nowhere_to_be_found",
        "ModuleNotFoundError: No module named 'nowhere_to_be_found'",
    )
    other.send(worker.id, 0)
    assert indices(safe.results("other")) == [0]


@pytest.mark.slow
def test_an_error_in_a_rollout_and_a_file_that_is_missing(
    safe: Stage, certs: Path, tmp_path: Path
) -> None:
    raises = tmp_path / "raises.py"
    raises.write_text(POLE.replace("return np", "1 / (sim.t < 2)\n        return np"))
    guard = "import sys\nif sys.argv[0].endswith('runner_process.py'): open('pole.xml')\n"
    author, other = Author(safe, raises), Author(safe, write(tmp_path, guard), "other")
    worker = hire(safe, certs)
    author.send(worker.id, 3)
    results = safe.results()
    assert (results.jobs.tolist(), results.error) == ([3], "ZeroDivisionError: division by zero")
    assert results.flags[:, 2].all()
    assert results.traceback[0].startswith('  File "raises.py", line 12, in reward')
    other.send(worker.id, 0)
    _, failure = safe.next("result of other", kind=Failure)
    assert failure.index is None, "the task cannot be built here"  # type: ignore[attr-defined]
    assert failure.error.endswith("but those that its xml names do, and neighbours")  # type: ignore[attr-defined]


def test_neighbours_come_with_it(safe: Stage, certs: Path, tmp_path: Path) -> None:
    """Kept beside it, imported from there; an error in one names it and no path of the worker."""
    (tmp_path / "gaits.py").write_text(
        "import parts\n\ndef level(t):\n    return parts.SIZE / (t < 3)\n"
    )
    (tmp_path / "parts.py").write_text("SIZE = 3.0\n")
    text = f"__neighbours__ = ('gaits', 'parts')\nimport gaits\n{POLE}"
    file = pole(tmp_path, text.replace("return np", "return gaits.level(sim.t) * np"))
    author = Author(safe, file)
    worker = hire(safe, certs)
    author.send(worker.id, 3)
    results = safe.results()
    assert {path.name for path in kept(file)} == {"pole.py", "gaits.py", "parts.py"}
    assert all(path.read_bytes() == (tmp_path / path.name).read_bytes() for path in kept(file))
    assert results.error == "ZeroDivisionError: float division by zero"
    assert '  File "gaits.py", line 4, in level' in results.traceback
    assert not any("rolloutfarm-code" in line for line in results.traceback)


def test_a_bundle_that_is_none_is_refused(tmp_path: Path) -> None:
    cache = SourceCache()
    with closing(cache):
        for content in (MAGIC + b"[]\n", packed(b"", {"pole": b""})):
            with pytest.raises(UnservedError, match=r"the received source of pole.py (is|has)"):
                cache.keep("pole.py", hashlib.sha256(content).hexdigest(), content)


@pytest.mark.slow
def test_code_that_hangs_is_ended(
    safe: Stage, certs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subprocess_runner, "_JOBS", 0.2)
    hangs = tmp_path / "hangs.py"
    hangs.write_text(POLE.replace("return np", "while sim.t > 1: pass\n        return np"))
    author, worker = Author(safe, hangs), hire(safe, certs)
    author.send(worker.id, 0)
    failure = safe.failure()
    assert (failure.index, failure.error) == (
        None,
        "its code did not answer within 0.2 s and was stopped",
    )


@pytest.mark.slow
def test_what_cannot_be_shown_is_no_answer(safe: Stage, certs: Path, tmp_path: Path) -> None:
    """The code may write to the worker itself."""
    forged = """
import socket, sys
if sys.argv[0].endswith("runner_process.py"):
    from farm.runner_process import Answer, send
    Answer.__post_init__ = lambda _: None
    send(socket.socket(fileno=int(sys.argv[1])), Answer(error="e", traceback=("\\x1b[2J",)))
"""
    author = Author(safe, write(tmp_path, forged, "forged.py"))
    other = Author(safe, write(tmp_path), "other")
    worker = hire(safe, certs)
    author.send(worker.id, 0)
    failure = safe.failure()
    assert failure.error.startswith("the process that runs its code ended")
    other.send(worker.id, 0)
    assert indices(safe.results("other")) == [0]


def test_without_certificates_it_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="--accept-code needs --tls: without certificates anyone could send code"
    ):
        WorkerConfig(accept_code=True)


_HOLDS = """
import time
from workers.source_cache import SourceCache
cache = SourceCache()
print(cache.empty, flush=True)
time.sleep(1000)
"""


def test_what_a_killed_worker_left_is_deleted_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of this process; TMPDIR is of the others
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    environment, command = {**os.environ, "TMPDIR": str(tmp_path)}, [sys.executable, "-c", _HOLDS]
    other = tmp_path / "rolloutfarm-code-link"
    other.symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    with (
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as killed,
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as working,
    ):
        try:
            assert killed.stdout
            assert working.stdout
            orphan, folder = (
                Path(process.stdout.readline().strip()).parent for process in (killed, working)
            )
            killed.kill()
            killed.wait()
            assert orphan.is_dir()
            with closing(SourceCache()) as cache:
                assert cache.empty.is_dir()
                assert not orphan.exists()
                assert folder.is_dir(), "its worker is alive"
                assert other.is_symlink(), "no worker made it"
        finally:
            killed.kill()
            working.kill()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["elsewhere", other.name, folder.name]
    )
