"""`farm record`: a recording over the network equals the learner's own, even if programs start late
or stop.
"""

import itertools
import re
import signal
import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest
from processes import SMALL, Farm
from recordings import content, generations, has_generation
from rerun.chunk import RrdReader

from farm.errors import ConfigError
from farm.net import codec, keys, session
from farm.net.session import free_endpoint
from farm.net.telemetry import RunHistory
from learner.run.folder import RunFolder
from learner.tools.record.command import RecordCommand, record

pytestmark = pytest.mark.slow

FILE = Path("recordings/r/run.rrd")
Process = subprocess.Popen[str]


def learner(farm: Farm, endpoint: str, count: int) -> Process:
    return farm.start(
        "learner", "--name", "r", "--generations", str(count), "--listen", endpoint, *SMALL
    )


def hire(farm: Farm, endpoint: str) -> Process:
    return farm.start("worker", "--connect", endpoint, "--workers", "1")


def leave(worker: Process) -> None:
    worker.terminate()
    worker.communicate(timeout=30)


def recorder(farm: Farm, endpoint: str, *flags: str) -> Process:
    """A recorder that has found its run."""
    process = farm.start("record", "--connect", endpoint, *flags)
    until(process, "recording run r into recordings/r")
    return process


def until(process: Process, text: str) -> str:
    """Wait for the line with this text."""
    assert process.stdout
    lines = []
    for line in iter(process.stdout.readline, ""):
        lines.append(line)
        if text in line:
            return line
    raise AssertionError("".join(lines))


def finish(process: Process, status: int = 0) -> str:
    output, _ = process.communicate(timeout=120)
    assert process.returncode == status, output
    assert "Traceback" not in output
    return output


def files(farm: Farm) -> list[str]:
    return sorted(path.name for path in (farm.folder / "recordings/r").glob("*.rrd"))


def numbers(count: int) -> list[int]:
    return list(range(1, count + 1))


def test_the_same_recording_as_the_learners(farm: Farm) -> None:
    """A recorder that starts before the learner records the whole run."""
    endpoint = free_endpoint()
    process = farm.start("record", "--connect", endpoint)
    until(process, "no answer from")
    flags = (
        "--name",
        "r",
        "--pairs",
        "3",
        "--generations",
        "12",
        "--traces",
        "all",
        "--listen",
        endpoint,
    )
    farm.call("run", *flags)
    output = finish(process)
    assert "run over after generation 12, all recorded in recordings/r" in output
    original, other = farm.folder / "runs/r", farm.folder / "recordings/r"
    rest = content(other / "run.rrd")
    for key, values in content(original / "run.rrd").items():
        # Commands that show a generation again name the run's folder, which is not here.
        text = str(values).replace("runs/r", "RUN") if key[0] == "/again" else str(values)
        assert text == str(rest.pop(key)), key
    assert not rest
    names = {entity for entity, *_ in content(other / "run.rrd")}
    assert {"/learning/return", "/joints/position", "/traces/best", "/log"} <= names
    assert files(farm) == ["replay.rrd", "run.rrd"]
    captions = [
        [
            str(chunk.to_record_batch())
            for chunk in RrdReader(folder / "replay.rrd").stream()
            if "rollout" in str(chunk)
        ]
        for folder in (original, other)
    ]
    assert len(captions[0]) == len(captions[1]) > 0
    for name in ("config.json", "summary.json"):
        assert (original / name).read_bytes() == (other / name).read_bytes()


def test_a_late_recorder_has_everything(farm: Farm) -> None:
    endpoint = free_endpoint()
    learning = learner(farm, endpoint, 20)
    worker = hire(farm, endpoint)
    farm.wait_for(lambda: len(farm.progress("r")) >= 8)
    leave(worker)
    with session.connect((endpoint,), 5, lambda: False) as link:
        payload = link.ask(keys.history("farm", "r") + "?from=nonsense", 5)
        assert payload
        page = codec.decode(payload, RunHistory)
        assert [report.generation for report in page.reports] == numbers(page.generation)
        assert page.generation >= 8
    process = recorder(farm, endpoint, "--run", "r")
    hire(farm, endpoint)
    finish(learning)
    finish(process)
    assert generations(farm.folder / FILE) == numbers(20)
    rollouts = {
        generation
        for entity, _, generation, _ in content(farm.folder / FILE)
        if entity == "/joints/position"
    }
    assert rollouts == {0, *numbers(20)}, "rollouts from before are there too"


def test_a_recorder_killed_and_started_again(farm: Farm) -> None:
    endpoint = free_endpoint()
    learning = learner(farm, endpoint, 30)
    process = recorder(farm, endpoint)
    worker = hire(farm, endpoint)
    farm.wait_for(lambda: len(farm.progress("r")) >= 10)
    leave(worker)
    farm.wait_for(lambda: has_generation(farm.folder / FILE))
    process.kill()
    process.communicate(timeout=10)
    process = farm.start("record", "--connect", endpoint)
    line = until(process, "recording run r into recordings/r")
    match = re.search(r"continuing after generation (\d+)", line)
    assert match
    assert int(match[1]) >= 1
    hire(farm, endpoint)
    finish(learning)
    finish(process)
    assert generations(farm.folder / FILE) == numbers(30)
    assert files(farm) == ["replay.rrd", "run.rrd"]


def test_a_learner_killed_and_resumed(farm: Farm) -> None:
    endpoint = free_endpoint()
    learning = learner(farm, endpoint, 30)
    process = recorder(farm, endpoint)
    hire(farm, endpoint)
    farm.wait_for(lambda: len(farm.progress("r")) >= 10)
    learning.kill()
    learning.communicate(timeout=10)
    until(process, "the learner of run r is gone, waiting for it to come back")
    farm.call("learner", "--resume", "runs/r", "--listen", endpoint, "--no-record")
    output = finish(process)
    assert "the learner of run r is back, after generation" in output
    assert generations(farm.folder / FILE) == numbers(30)


def test_stopped_and_gone_on(farm: Farm) -> None:
    endpoint = free_endpoint()
    learning = learner(farm, endpoint, 100_000)
    hire(farm, endpoint)
    process = recorder(farm, endpoint, "--serve", str(free_port()))
    until(process, "live: farm view rerun+http://127.0.0.1:")
    farm.wait_for(lambda: has_generation(farm.folder / FILE))
    process.send_signal(signal.SIGTERM)
    start = time.monotonic()
    output = finish(process, 130)
    assert time.monotonic() - start < 10
    match = re.search(
        r"recorded up to generation (\d+) in recordings/r; the same command continues", output
    )
    assert match
    assert generations(farm.folder / FILE) == numbers(int(match[1]))
    assert learning.poll() is None


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.slow
def test_a_frozen_recorder_delays_nothing(farm: Farm) -> None:
    endpoint = free_endpoint()
    learning = learner(farm, endpoint, 450)
    processes = [
        recorder(farm, endpoint),
        farm.start("record", "--connect", endpoint, "--out", "second"),
    ]
    until(processes[1], "recording run r into second/r")
    hire(farm, endpoint)
    farm.wait_for(lambda: len(farm.progress("r")) >= 10)
    processes[0].send_signal(signal.SIGSTOP)
    frozen = len(farm.progress("r"))
    farm.wait_for(lambda: len(farm.progress("r")) >= 150)
    thawed = len(farm.progress("r"))
    processes[0].send_signal(signal.SIGCONT)  # 300 generations are left for it to connect again
    finish(learning)
    for process in processes:
        finish(process)
    for folder in ("recordings", "second"):
        assert generations(farm.folder / folder / "r/run.rrd") == numbers(450)
    ends = [line["seconds"] for line in farm.progress("r")]
    still = max(b - a for a, b in itertools.pairwise(ends[frozen:thawed]))
    assert ends[thawed - 1] - ends[frozen] > 3.0, "frozen for longer than a session's lease"
    assert still < 1.5


def test_folders_and_runs_that_make_no_sense(farm: Farm) -> None:
    endpoint = free_endpoint()
    router = farm.start("router", "--listen", endpoint)
    until(router, "router at")
    for name in ("a", "b"):
        farm.start("learner", "--name", name, "--connect", endpoint, *SMALL)
    farm.wait_for(lambda: len(_runs(endpoint)) == 2)
    output = farm.call("record", "--connect", endpoint, status=2)
    assert output == "farm: this farm has several runs: a, b; choose one with --run\n"

    folder = farm.folder / "recordings/b"
    folder.mkdir(parents=True)
    RunFolder(folder).write_config(replace(RunFolder(farm.folder / "runs/b").read_config(), seed=7))
    strange = farm.folder / "strange/b"
    strange.mkdir(parents=True)
    (strange / "letter.txt").touch()
    for run, out, expected in (
        (
            "a",
            "runs",
            "runs/a is the learner's own folder, which it records itself: choose a different --out",
        ),
        (
            "b",
            "recordings",
            (
                "recordings/b holds another run of that name, with --seed 7 instead of 0: choose a"
                " different"
            ),
        ),
        (
            "b",
            "strange",
            "strange/b is no recording's folder, and not empty: choose a different --out",
        ),
        ("b", "runs/b/config.json", "cannot write to .*: Not a directory"),
    ):
        command = RecordCommand(connect=(endpoint,), run=run, out=farm.folder / out)
        with pytest.raises(ConfigError, match=expected):
            record(command, lambda: False)
    assert [path.name for path in strange.iterdir()] == ["letter.txt"]


def test_flags_that_make_no_sense(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for flags, expected in (
        ({"file": False}, "--no-file records nothing: add --serve PORT or --spawn"),
        ({"spawn": True}, "no display to open a window on: take --serve PORT"),
        ({"run": ".."}, "run '..' is not a name"),
        ({"serve": "here"}, "--serve 'here' is not of the form"),
    ):
        with pytest.raises(ConfigError, match=expected):
            RecordCommand(**flags)


def _runs(endpoint: str) -> list[str]:
    with session.connect((endpoint,), 5, lambda: False) as link:
        return link.tokens(keys.learner_token("farm", "*"), 2)
