"""A user's mistake gets one line and the right exit status, and nothing is lost."""

import json
import logging
import re
import shutil
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import SMALL, Farm

from farm.__main__ import main
from farm.net.session import free_endpoint

MISTAKES = [
    (("fly",), "unknown command 'fly'; farm --help lists them"),
    (
        ("run", "--preset", "best"),
        "unknown preset 'best' of task finger-gait; known are default, thesis",
    ),
    (
        ("run", "--state", "smell"),
        "unknown state base 'smell'; known are joints, joints+contacts, tactile",
    ),
    (("run", "--algorithm", "guess"), "unknown algorithm 'guess'; known are pgpe"),
    (("run", "--algorithm", "ars", "--top", "17"), "top is 17; expected 1 to 16 (pairs)"),
    (("run", "--algorithm", "snes", "--pairs", "0"), "pairs is 0; expected 1 or more"),
    (("run", "--algorithm", "sep-cma", "--population", "3"), "population is 3; expected 4 or more"),
    (("run", "--algorithm", "cma-es", "--policy", "mlp"), "parameters; cma-es takes 1 to 1000"),
    (("run", "--backend", "gpu"), "unknown backend 'gpu'; known are cpu"),
    (("run", "--object", "cat"), "unknown object 'cat'; known are bar"),
    (
        ("run", "--policy", "pid"),
        "unknown policy 'pid'; known are direct, projected, kernel, cosine",
    ),
    (
        ("run", "--policy", "mlp", "--layers", "0"),
        "layers has 0; expected 1 to 10000 units in each",
    ),
    (
        ("run", "--policy", "mlp", *("--layers", "9999") * 2),
        "100159991 parameters; at most 4194304 fit into a message",
    ),
    (("run", "--policy", "rbf", "--centres", "0"), "centres is 0; expected 1 to 100000"),
    (("run", "--goal-grip", "fist"), "unknown grip 'fist'; known are index+thumb"),
    (
        ("run", "--task", "juggling"),
        "unknown task 'juggling'; known are finger-gait, fragile-bar, turning, gym, or",
    ),
    (
        ("run", "--task", "gym:Swimmr-v5"),
        "task gym:Swimmr-v5: Environment `Swimmr` doesn't exist. Did you mean: `Swimmer`?",
    ),
    (
        ("run", "--task", "gym:os:Swimmer-v5"),
        "task 'gym:os:Swimmer-v5' names a module to import, which is refused",
    ),
    (("run", "again"), "unexpected: again (see farm run --help-all)"),
    (("run", "--sed", "3"), "unexpected: --sed, 3; did you mean --seed? (see"),
    (("stress",), "missing from farm stress: PATH Folder of the run (see farm stress --help)"),
    (
        ("run", "--task", "gym:Swimmer"),
        "task 'gym:Swimmer' is no environment's name; expected gym:NAME-vN",
    ),
    (("run", "--task", "gym:Pendulum-v1"), "task gym:Pendulum-v1: not an environment of MuJoCo"),
    (
        ("run", "--task", "gym:Swimmer-v5", "--preset", "thesis"),
        "unknown preset 'thesis' of task gym:Swimmer-v5; known are default",
    ),
    (
        ("run", "--task", "gym:Swimmer-v5", "--state", "tactile"),
        "unexpected: --state, tactile",
    ),
    (
        ("run", "--task", "gym:Swimmer-v5", "--stop-when-solved", "1"),
        "gym:Swimmer-v5 knows returns, but no success",
    ),
    (
        ("run", "--task", "gym:Swimmer-v5", "--steps", "10001"),
        "steps is 10001; expected 0 to 10000",
    ),
    (("run", "--pairs", "-3"), "pairs is -3; expected 1 or more"),
    (("run", "--pairs", "many"), "--pairs 'many': expected a whole number"),
    (("run", "--episodes", "0"), "episodes is 0; expected 1 to 1000"),
    (
        ("run", "--episodes", "2", "--no-perturb"),
        "--episodes 2 and --no-perturb exclude each other",
    ),
    (("run", "--policy", "rnn", "--units", "0"), "units is 0; expected 1 to 10000"),
    (("run", "--gamma", "1.5"), "gamma is 1.5; expected a positive number, at most 1"),
    (("run", "--workers", "-1"), "workers is -1; expected 0 to 1024"),
    (("run", "--pears", "3"), "did you mean --pairs"),
    (("run", "--no-quiet"), "--quiet is off unless it is given: leave --no-quiet out"),
    (("rnu",), "unknown command 'rnu'; did you mean run?"),
    (("run", "--serve", "here"), "is not of the form [HOST:]PORT"),
    (("run", "--name", "a/b"), "run 'a/b' is not a name"),
    (("run", "--config", "nowhere.json"), "cannot read nowhere.json"),
    (("run", "--preset", "thesis", "--resume", "x"), "--preset and --resume exclude each other"),
    (("run", "--resume", "nowhere"), "nowhere is not a run's folder"),
    (("run", "--init-from", "nowhere"), "nowhere is not a run's folder"),
    (("run", "--log-level", "LOUD"), "unknown log level 'LOUD'"),
    (("learner", "--listen", "tcp/x"), "is not of the form tcp/HOST:PORT"),
    (
        ("learner", "--listen", "tcp/a:1", "--connect", "tcp/b:2"),
        "--listen and --connect exclude each other",
    ),
    (("worker", "--connect", "udp/1.2.3.4:5"), "is not of the form tcp/HOST:PORT"),
    (("worker", "--workers", "0"), "workers is 0; expected 1 to 4096"),
    (("worker", "--backend", "gpu"), "unknown backend 'gpu'; known are cpu"),
    (("evaluate", "nowhere"), "nowhere is not a run's folder"),
    (("evaluate", "nowhere", "--rollouts", "0"), "rollouts is 0; expected 1"),
    (("replay", "nowhere"), "nowhere is not a run's folder"),
    (("replay", "nowhere", "--dropped", "2"), "nowhere is not a run's folder"),
    (("play", "nowhere", "--friction", "0.5"), "nowhere is not a run's folder"),
    (("chain",), "a chain needs policies: give one run or more"),
    (
        ("worker", "--tls", "nowhere"),
        "--tls nowhere: there is no such folder; expected the",
    ),
    (("view", "nowhere"), "no recording in nowhere"),
    (("runs", "nowhere"), "there is no folder nowhere"),
]


@pytest.fixture
def logging_as_before() -> Iterator[None]:
    """Commands set up the root logger for a process of their own."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.usefixtures("logging_as_before")
@pytest.mark.parametrize(
    ("words", "line"),
    MISTAKES,
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_mistakes(
    words: tuple[str, ...],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """In this process: separate programs would take as long as all other tests together."""
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    output = "".join(capfd.readouterr())
    assert line.lower() in output.lower()
    assert len(output.strip().splitlines()) == 1
    assert not (tmp_path / "runs").exists()


def test_a_mistake_of_a_program(farm: Farm) -> None:
    output = farm.call("run", "--seed", "-1", status=2, timeout=60)
    assert output == "farm: seed is -1; expected 0 to 4294967295\n"


SHELL = [
    (
        "{farm} --help > /dev/full",
        1,
        "No space left on device; make room|cannot write to standard output: No space",
    ),
    (
        "{farm} tasks > /dev/full",
        1,
        "No space left on device; make room|cannot write to standard output: No space",
    ),
    ("{farm} runs >&-", 1, "standard output is closed; > /dev/null discards it"),
    ("{farm} runs 2>&- >&-", 1, ""),
    ("mkfifo p; exec 3<>p 4>p 3<&-; {farm} --help >&4", 141, ""),
    ("mkfifo p; exec 3<>p 4>p 3<&-; {farm} tasks >&4", 141, ""),
    ("mkdir d; cd d; rmdir ../d; {farm} new-task T", 2, "cannot write"),
    (
        "mkdir d; cd d; rmdir ../d; {farm} run",
        1,
        "No such file or directory; the working folder is gone, change to an",
    ),
    (
        "unset MUJOCO_GL; ulimit -n 5; {farm} tasks",
        1,
        "Too many open files; allow more of them: ulimit -n 1024",
    ),
    (
        "ulimit -n 20; {farm} run --no-record",
        1,
        "a process may open 20 files here, 64 are needed: ulimit -n 1024",
    ),
    (
        "ulimit -n 20; {farm} status",
        1,
        "a process may open 20 files here, 64 are needed: ulimit -n 1024",
    ),
    ("ln -s nowhere/x l; {farm} run --out l", 2, "l is a link to nowhere/x, which is no folder"),
    ("touch f; {farm} run --out f/x", 2, "f is a file"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("line", "status", "words"), SHELL, ids=[line for line, _, _ in SHELL])
def test_a_place_where_little_is_possible(line: str, status: int, words: str, farm: Farm) -> None:
    process = farm.start_program("bash", "-c", line.format(farm=f"{sys.executable} -P -m farm"))
    output, _ = process.communicate(timeout=60)
    assert process.returncode == status, output
    assert len(output.splitlines()) == bool(words), output
    assert re.search(words, output), output
    assert not (farm.folder / "runs").exists()


INTERRUPTED = """
import os, signal, sys

for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)  # ignored in the background

def hook(event, arguments):
    if event == "import" and arguments[0] == MODULE:
        os.kill(os.getpid(), NUMBER)

sys.addaudithook(hook)
from farm.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", ["farm.plugins", "numpy", "rich.console", "mujoco"])
def test_ended_among_imports(module: str, number: int, farm: Farm) -> None:
    """Send the signal when this module is being imported.

    The command itself imports the last one.
    """
    code = INTERRUPTED.replace("MODULE", repr(module)).replace("NUMBER", str(int(number)))
    process = farm.start_python("-P", "-c", code, "tasks")
    output, _ = process.communicate(timeout=60)
    assert (output, process.returncode) in [("", -number), ("farm: stopped before the end\n", 130)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "words", "said"),
    [
        ("learner", ("--listen", "tcp/127.0.0.1:PORT"), "cannot listen on tcp/127.0.0.1:PORT"),
        ("run", ("--serve", "PORT"), "cannot serve the recording at 127.0.0.1:PORT"),
    ],
)
def test_a_port_in_use(command: str, words: tuple[str, ...], said: str, farm: Farm) -> None:
    """Said before the pilot, which would take its time."""
    farm.call("new-task", "hop")
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = str(server.getsockname()[1])
        words = tuple(word.replace("PORT", port) for word in words)
        output = farm.call(command, "--task", "hop.py:Hop", *words, status=2)
    assert said.replace("PORT", port) in output
    assert "pilot" not in output
    assert "Traceback" not in output
    assert not (farm.folder / "runs").exists()


@pytest.mark.slow
def test_no_answer(farm: Farm) -> None:
    endpoint = free_endpoint()
    output = farm.call(
        "worker", "--connect", endpoint, "--workers", "1", "--timeout", "4", status=1
    )
    assert f"no answer from {endpoint} yet, trying again" in output
    assert f"no answer from {endpoint} after 4 s: nothing listens on port" in output
    assert "start a learner there (it listens after its pilot), or check --connect" in output
    assert "Traceback" not in output


@pytest.mark.slow
def test_run_folders_and_checkpoints(farm: Farm) -> None:
    farm.call("run", "--name", "r", "--generations", "2", *SMALL)
    runs = farm.folder / "runs"
    checkpoint = (runs / "r" / "checkpoint").read_bytes()

    assert "exists and is never overwritten" in farm.call("run", "--name", "r", *SMALL, status=2)
    assert "--seed is 0 in the run and 4 here" in farm.call(
        "run", "--resume", "runs/r", "--seed", "4", status=2
    )
    assert "the run has already done 2" in farm.call(
        "run", "--resume", "runs/r", "--generations", "1", status=2
    )
    output = farm.call(
        "run", "--init-from", "runs/r", "--policy", "cosine", "--features", "9", status=2
    )
    assert "its parameters mean something else" in output

    def refused(content: bytes, expected: str) -> None:
        shutil.rmtree(runs / "broken", ignore_errors=True)
        shutil.copytree(runs / "r", runs / "broken")
        (runs / "broken" / "checkpoint").write_bytes(content)
        for words in (
            ("run", "--resume", "runs/broken", "--generations", "5"),
            ("evaluate", "runs/broken"),
        ):
            output = farm.call(*words, status=2)
            assert expected in output
            assert len(output.strip().splitlines()) == 1

    refused(checkpoint[:-10], "is truncated or damaged")
    refused(b"", "is not a checkpoint")
    refused(
        checkpoint.replace(b"checkpoint 2", b"checkpoint 9"), "is a checkpoint of another version"
    )
    assert (runs / "r" / "checkpoint").read_bytes() == checkpoint

    config = json.loads((runs / "r" / "config.json").read_text())
    (farm.folder / "c.json").write_text(json.dumps({**config, "version": 99}))
    assert "not a configuration of version 2 (found '99')" in farm.call(
        "run", "--config", "c.json", status=2
    )
    (farm.folder / "c.json").write_text(json.dumps({**config, "colour": "red"}))
    assert "unknown setting colour" in farm.call("run", "--config", "c.json", status=2)
    (farm.folder / "c.json").write_text("{")
    assert "is not JSON" in farm.call("run", "--config", "c.json", status=2)


@pytest.mark.slow
def test_a_checkpoint_of_another_configuration(farm: Farm) -> None:
    farm.call("run", "--name", "a", "--generations", "1", *SMALL)
    farm.call("run", "--name", "b", "--generations", "1", "--seed", "3", *SMALL)
    runs = farm.folder / "runs"
    shutil.copy(runs / "a" / "checkpoint", runs / "b" / "checkpoint")
    output = farm.call("run", "--resume", "runs/b", "--generations", "2", status=2)
    assert "is of another configuration: --seed is 0 there and 3 in config.json" in output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ("--policy", "direct", "--features", "2000000"),
            "16000000 parameters; at most 4194304 fit into a message",
        ),
        (
            ("--policy", "projected", "--features", "600000"),
            "the policy's constants take 41 MiB; at most 32 fit",
        ),
    ],
)
def test_a_policy_too_large_for_a_message_is_refused_before_the_run_begins(
    words: tuple[str, ...],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(("run", "--no-record", *words)) == 2
    assert line in "".join(capfd.readouterr())
    assert not (tmp_path / "runs").exists()
