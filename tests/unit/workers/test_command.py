"""`farm worker`: its flags are passed on to each of its processes."""

from dataclasses import fields
from pathlib import Path

import pytest

from farm import command_line
from farm.commands import certificates
from farm.errors import ConfigError
from workers.__main__ import Process
from workers.command import WorkerCommand, _flags
from workers.config import WorkerConfig


def passed_on(config: WorkerConfig) -> Process:
    flags = _flags(WorkerCommand(worker=config, log_level="warning"))
    return command_line.parse(Process, flags, "python -m workers")


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"connect": ("tcp/127.0.0.1:7000", "tcp/[::1]:7001"), "farm": "lab", "name": "bench-3"},
        {"timeout": 2.5},
        {"allow_file": ("a.py", "b.py")},
    ],
    ids=str,
)
def test_processes_are_told_everything(changed: dict[str, object], tmp_path: Path) -> None:
    files = tuple(tmp_path / str(name) for name in changed.get("allow_file", ()))  # type: ignore[attr-defined]
    for path in files:
        path.touch()
    config = WorkerConfig(**(changed | ({"allow_file": files} if files else {})))  # type: ignore[arg-type]
    arguments = passed_on(config)
    assert arguments.worker == config
    assert arguments.log_level == "WARNING"


def test_no_setting_is_left_out(tmp_path: Path) -> None:
    """Every setting of a worker has a flag."""
    path = tmp_path / "mine.py"
    path.touch()
    certificates.main(["new", str(tmp_path / "certs"), "--learner", "localhost", "--worker", "w"])
    connect = ("tls/localhost:7447",)
    config = WorkerConfig(
        connect=connect,
        allow_file=(path,),
        timeout=1.0,
        backend="cpu",
        tls=tmp_path / "certs",
        accept_code=True,
    )
    assert passed_on(config).worker == config
    flags = {
        word.removeprefix("--").replace("-", "_") for word in _flags(WorkerCommand(worker=config))
    }
    assert {field.name for field in fields(WorkerConfig)} <= flags


@pytest.mark.parametrize("count", [0, -1, 4097])
def test_a_number_of_processes_that_makes_no_sense(count: int) -> None:
    with pytest.raises(ConfigError, match=f"workers is {count}; expected 1 to 4096"):
        WorkerCommand(workers=count)
