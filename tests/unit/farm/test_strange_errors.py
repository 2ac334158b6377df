"""Errors that no task should raise, and a low limit of memory: one line each."""

import asyncio
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from farm import errors, plugins
from farm.__main__ import main
from farm.errors import ConfigError, TaskError, described, short_of_memory
from farm.plugins import no_exit


class Own(BaseException):
    """No Exception."""


class MuteError(Exception):
    """Whose text cannot be made."""

    def __str__(self) -> str:
        raise RuntimeError("never")


@no_exit
def raising(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (SystemExit(3), r"sys\.exit\(3\): raise an error instead"),
        (Own("base"), "Own: base: raise an error instead"),
        (GeneratorExit(), "GeneratorExit: raise an error instead"),
        (asyncio.CancelledError(), "CancelledError: raise an error instead"),
        (StopIteration(7), "StopIteration: 7: raise an error instead"),
    ],
)
def test_what_is_no_usual_error_becomes_one(error: BaseException, text: str) -> None:
    with pytest.raises(TaskError, match=text):
        raising(error)


@pytest.mark.parametrize(
    "error", [ValueError("usual"), MuteError(), MemoryError(), ConfigError("ours")]
)
def test_usual_errors_stay(error: Exception) -> None:
    with pytest.raises(type(error)) as raised:
        raising(error)
    assert raised.value is error


def test_ctrl_c_is_one_only_where_it_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        raising(KeyboardInterrupt())
    before = signal.signal(signal.SIGINT, lambda *_: None)  # as in a worker
    try:
        with pytest.raises(TaskError, match="KeyboardInterrupt: raise an error instead"):
            raising(KeyboardInterrupt())
    finally:
        signal.signal(signal.SIGINT, before)


def test_texts_of_errors() -> None:
    assert described(ValueError("usual")) == "ValueError: usual"
    assert described(MemoryError()) == "MemoryError"
    assert described(MuteError()) == "MuteError: its text cannot be made: RuntimeError"


@pytest.mark.parametrize(
    "statement", ["raise Own", "raise Mute", "raise KeyboardInterrupt", "raise StopIteration"]
)
def test_a_file_that_raises_them_when_it_is_imported(tmp_path: Path, statement: str) -> None:
    file = tmp_path / "strange.py"
    kinds = (
        "class Own(BaseException): pass\nclass Mute(Exception):\n    def __str__(self): raise"
        " RuntimeError\n"
    )
    file.write_text(f"{kinds}{statement}\n")
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        with pytest.raises(ConfigError, match="strange.py cannot be imported: line 4: "):
            plugins.find("tasks", f"{file}:T")
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_low_limit_of_memory_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    assert short_of_memory(ValueError()) == ""
    assert short_of_memory(RuntimeError("something else")) == ""
    for error in (
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError(12, "Cannot allocate memory"),
    ):
        assert short_of_memory(error) == "there is not enough memory"
    monkeypatch.setattr(errors, "address_limit", lambda: 1 << 30)
    assert short_of_memory(MemoryError()).startswith(
        "ulimit -v 1048576 leaves too few addresses: ulimit -v unlimited"
    )
    errors.check_addresses(1 << 30, "this")
    with pytest.raises(
        ConfigError,
        match="ulimit -v 1048576 is too low for that, which reserves 4 GiB of addresses",
    ):
        errors.check_addresses(4 << 30, "that")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the limit is another")
@pytest.mark.parametrize(("words", "kib"), [((), 3_000_000), (("--no-record",), 1_000_000)])
def test_commands_under_a_limit(tmp_path: Path, words: tuple[str, ...], kib: int) -> None:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (kib << 10, kib << 10))

    command = [
        sys.executable,
        "-m",
        "farm",
        "run",
        "--generations",
        "1",
        "--pairs",
        "1",
        "--workers",
        "1",
        *words,
    ]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        preexec_fn=limited,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"farm: ulimit -v {kib} is too low for ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("run", "--name=--rf"), "run '--rf' is not a name"),
        (("worker", "--name=-x"), "worker '-x' is not a name"),
        (("run", "--farm=-f"), "farm '-f' is not a name"),
        (("new-task", "None"), "'None' is no name of a task: a class cannot be called None"),
        (("new-task", "true"), "a class cannot be called True"),
        (("new-task", "task"), "a class cannot be called Task"),
        (("new-task", "_"), "'_' is no name of a task; expected letters"),
        (("new-task", "_1"), "'_1' is no name of a task; expected letters"),
        (("new-task", "numpy"), "numpy.py would hide the module numpy from programs in this"),
        (("new-task", "random"), "random.py would hide the module random from programs in this"),
    ],
)
def test_names_that_would_be_something_else(
    words: tuple[str, ...],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(list(words)) == 2
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
