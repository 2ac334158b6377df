"""A run's recordings, figures and tables, read back and compared with computed values."""

import contextlib
import json
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import Farm, children
from recordings import generations, read, rows, texts
from rerun.chunk import RrdReader

from farm import seeds
from farm.net.work import Jobs
from learner.run.folder import RunFolder
from learner.run.setup import start

pytestmark = pytest.mark.slow

GENERATIONS = 4
SMALL = ("--name", "r", "--pairs", "3", "--generations", str(GENERATIONS))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """A small run that keeps all its traces, served while it was learnt."""
    farm = Farm(tmp_path_factory.mktemp("recorded"))
    farm.call("run", "--traces", "all", *SMALL)
    yield farm
    farm.close()


def test_traces_are_those_of_the_simulation(recorded: Farm) -> None:
    folder = RunFolder.open(recorded.folder / "runs" / "r")
    tensors = rows(read(folder.recording)["/traces/all"], "data")
    assert sorted(tensors) == list(range(1, GENERATIONS + 1))

    config = folder.read_config()
    problem, at = start(config, "r")
    runner, algorithm = problem.runner(), config.algorithm_config
    state = algorithm.restore(at.state)
    for generation in range(GENERATIONS):
        eps = algorithm.ask(state, seeds.exploration(config.seed, generation))
        starts = [seeds.training(config.seed, generation, i) for i in range(len(eps))]
        results = runner.run(state.mu, Jobs.exploring(eps, (1, -1), starts), "all")
        (tensor,) = tensors[generation + 1]
        assert tensor_of(tensor).tobytes() == results.traces.tobytes()
        state = algorithm.tell(state, eps, results.returns.reshape(-1, 2))
    assert state.mu.tobytes() == folder.parameters.rows()["mu"][-1].tobytes()


def test_new_bests_are_in_the_log(recorded: Farm) -> None:
    bests = {
        line["generation"]: line["best"]
        for line in recorded.progress("r")
        if line["return_max"] == line["best"]
    }
    lines = {}
    for batch in read(recorded.folder / "runs/r/run.rrd")["/log"]:
        [text] = [name for name in batch.schema.names if name.endswith(":text")]
        numbers = batch.column("generation").cast("int64").to_pylist()
        for generation, [line] in zip(numbers, batch.column(text).to_pylist(), strict=True):
            if "new best" in line:
                lines[generation] = line
    assert bests
    assert lines == {
        generation: f"new best rollout: return {best:.3f}" for generation, best in bests.items()
    }


def tensor_of(value: dict[str, Any]) -> np.ndarray[Any, Any]:
    """A Rerun tensor as an array of float32."""
    buffer = value["buffer"]
    values = (
        np.array(buffer, np.float32)
        if isinstance(buffer, list)
        else np.frombuffer(buffer, np.float32)
    )
    return values.reshape(value["shape"])


def test_a_recording_and_the_replays(recorded: Farm) -> None:
    folder = recorded.folder / "runs" / "r"
    (recording,) = RrdReader(folder / "run.rrd").recordings()
    assert recording.recording_id == "r"
    assert sorted(path.name for path in folder.glob("*.rrd")) == ["replay.rrd", "run.rrd"]
    captions = texts(folder / "replay.rrd", "/rollout")
    assert any("best rollout, generation" in text for text in captions)
    assert any(f"mean policy after generation {GENERATIONS}" in text for text in captions)


def test_figures_are_the_same_everywhere(recorded: Farm) -> None:
    summary = recorded.summary("r")
    figures = json.loads(recorded.call("evaluate", "runs/r", "--json"))
    assert figures["perturbed"]["success_rate"] == summary["robust_success_rate"]
    assert figures["nominal"]["return_mean"] == summary["mean_policy_return"]
    assert figures["generation"] == GENERATIONS
    assert json.loads(recorded.call("runs", "--json")) == [summary]
    table = recorded.call("runs")
    assert "finished" in table
    assert summary["parameters_sha256"][:8] in table
    output = recorded.call("replay", "runs/r", "--to", "again.rrd")
    assert f"return {summary['mean_policy_return']:.3f}" in output
    assert "written to again.rrd; look at it with: farm view again.rrd" in output
    assert [r.recording_id for r in RrdReader(recorded.folder / "again.rrd").recordings()] == [
        "r-replay"
    ]


def test_a_window_needs_a_display(recorded: Farm, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    output = recorded.call("view", "runs/r", status=2)
    assert (
        "no display to open a window on: farm view runs/r --web serves a browser, or copy" in output
    )
    assert len(output.splitlines()) == 1


def test_interrupted_renamed_and_resumed(farm: Farm) -> None:
    """There is one recording in the end, with every generation once."""
    process = farm.start("run", *SMALL[:-1], "30")
    farm.wait_for(lambda: len(farm.progress("r")) >= 3)
    process.terminate()
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130, output
    (farm.folder / "runs" / "r").rename(farm.folder / "runs" / "s")
    output = farm.call("run", "--resume", "runs/s/")
    assert farm.summary("s")["run"] == "s"
    folder = farm.folder / "runs" / "s"
    assert sorted(path.name for path in folder.glob("*.rrd")) == ["replay.rrd", "run.rrd"]
    (recording,) = RrdReader(folder / "run.rrd").recordings()
    assert recording.recording_id == "r"
    assert generations(folder / "run.rrd") == list(range(1, 31))


def test_a_killed_run_has_the_curves_of_every_generation_once(farm: Farm) -> None:
    """The last half second's generations are lost with the process, and written when the run
    continues.
    """
    process = farm.start("run", *SMALL[:-1], "30")
    farm.wait_for(lambda: len(farm.progress("r")) >= 5)
    process.kill()
    process.wait()
    farm.call("run", "--resume", "runs/r")
    assert generations(farm.folder / "runs" / "r" / "run.rrd") == list(range(1, 31))


def test_a_run_that_is_first_recorded_later_has_the_curves_of_its_beginning(farm: Farm) -> None:
    farm.call("run", *SMALL, "--no-record")
    farm.call("run", "--resume", "runs/r", "--generations", "6")
    norms = rows(read(farm.folder / "runs/r/run.rrd")["/learning/mean_norm"], "scalars")
    assert sorted(norms) == [1, 2, 3, 4, 5, 6]
    assert {generation: value for generation, [value] in norms.items()} == {
        line["generation"]: line["mean_norm"] for line in farm.progress("r")
    }


def test_a_run_that_is_over_is_shown_again(recorded: Farm) -> None:
    before = recorded.summary("r")
    output = recorded.call("run", "--resume", "runs/r")
    assert f"continuing after generation {GENERATIONS}" in output
    after = recorded.summary("r")
    again = {"reissued": 0, "checks": {}}  # its last answers are checked again
    assert {**after, **again} == {**before, **again}
    folder = recorded.folder / "runs" / "r"
    captions = texts(folder / "replay.rrd", "/rollout")
    assert [text.split(",")[0].split(" after")[0] for text in captions] == [
        "### best rollout",
        "### mean policy",
    ]
    assert generations(folder / "run.rrd") == list(range(1, GENERATIONS + 1))


def listeners(port: int) -> set[str]:
    """Addresses of this machine on which a program listens at this port."""
    hosts = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            host, _, at = address.partition(":")
            if state == "0A" and int(at, 16) == port:
                hosts.add(host)
    return hosts


def test_the_stream_stays_on_this_machine(farm: Farm) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = farm.start("run", *SMALL[:-1], "1000", "--serve", str(port))
    farm.wait_for(lambda: farm.progress("r"))
    assert listeners(port) == {"0100007F"}
    socket.create_connection(("127.0.0.1", port), timeout=5).close()
    process.terminate()
    output, _ = process.communicate(timeout=30)
    assert f"live: farm view rerun+http://127.0.0.1:{port}/proxy   (--web for a browser)" in output
    assert f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}" in output
    assert listeners(port) == set()


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_view_takes_its_viewer_with_it(recorded: Farm, ending: signal.Signals) -> None:
    process = recorded.start("view", "runs/r", "--web")

    def viewers() -> list[int]:
        pids = []
        for pid in children(process.pid):
            with contextlib.suppress(FileNotFoundError):  # a child that has just ended
                pids += [pid] if Path(f"/proc/{pid}/exe").resolve().name == "rerun" else []
        return pids

    recorded.wait_for(viewers)
    [viewer] = viewers()
    process.send_signal(ending)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 130, output
    assert not Path(f"/proc/{viewer}").exists()
    assert "Traceback" not in output
