"""Uses of finished runs: replay, video, comparison, interactive play, export of the policy."""

import contextlib
import ctypes.util
import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from processes import Farm
from recordings import read
from rerun.chunk import RrdReader

from farm.__main__ import main
from farm.errors import ConfigError
from farm.policies.recurrent import Rnn, RnnConfig
from farm.sim import video
from farm.sim.engines import DataEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait import model
from learner.again.replay import LoadedPolicy, Replay, load
from learner.commands.play import rollout
from learner.export import npz as export
from learner.run.folder import RunFolder

pytestmark = pytest.mark.usefixtures("grips_found_once")
GENERATIONS = 6
PLAY_POLICY = Path(__file__).parents[2] / "examples" / "play_policy.py"


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """Two small runs, one of them without a recording and with another controller."""
    farm = Farm(tmp_path_factory.mktemp("done"))
    farm.call("run", "--name", "a", "--pairs", "4", "--generations", str(GENERATIONS))
    few = ("--pairs", "3", "--generations", "3", "--no-record")
    farm.call("run", "--name", "b", "--preset", "thesis", "--features", "60", "--seed", "5", *few)
    yield farm
    farm.close()


Say = Callable[..., str]


@pytest.fixture
def say(done: Farm, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Say:
    """What a command says, run in the folder of the runs; in this process, which has imported everything."""
    monkeypatch.chdir(done.folder)

    def call(*words: str, status: int = 0) -> str:
        assert main(words) == status
        said = capsys.readouterr()
        return said.out + said.err

    return call


def folder(farm: Farm, name: str = "a") -> RunFolder:
    return RunFolder.open(farm.folder / "runs" / name)


def stored(farm: Farm, name: str = "a", generation: int | None = None, **changed: object) -> LoadedPolicy:
    return load(folder(farm, name).path, generation, **changed)


def again(farm: Farm, name: str = "a", generation: int | None = None, **changed: object) -> Replay:
    return stored(farm, name, generation, **changed).rollout()


# ---------------------------------------------------------------- replay


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_last_policy_gives_the_runs_own_return(done: Farm, name: str) -> None:
    assert again(done, name).trajectory.value == done.summary(name)["mean_policy_return"]


def test_earlier_policies_give_what_their_generation_said(done: Farm) -> None:
    # A line of progress.jsonl has the return of the mean that was explored around: that of the generation before.
    for line in done.progress("a"):
        shown = again(done, generation=line["generation"] - 1)
        assert shown.trajectory.value == line["mean_policy_return"]
        assert shown.trajectory.success == line["mean_policy_success"]


def test_friction_changes_the_rollout_and_a_factor_of_one_does_not(done: Farm) -> None:
    nominal = again(done)
    assert again(done, friction=1.0).trajectory.value == nominal.trajectory.value
    assert again(done, friction=0.05).trajectory.value != nominal.trajectory.value


def test_another_object(done: Farm, tmp_path: Path) -> None:
    text = (model.folder() / "objects/bar.xml").read_text()
    (tmp_path / "thick.xml").write_text(text.replace('size="0.011 0.06 0.011"', 'size="0.015 0.045 0.015"'))
    (tmp_path / "cannonball.xml").write_text(text.replace('mass="0.05"', 'mass="50"'))
    shown = again(done, object=str(tmp_path / "thick.xml"))
    assert shown.trajectory.value != again(done).trajectory.value
    with pytest.raises(ConfigError, match=r"grip 'index\+thumb' does not hold object '.*cannonball.xml'"):
        again(done, object=str(tmp_path / "cannonball.xml"))


def test_a_policy_that_is_not_stored(done: Farm, say: Say, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder(done).path, copy)
    head, _, rows = (copy / "parameters").read_bytes().partition(b"\n")
    size = len(rows) // GENERATIONS
    kept = b"".join(rows[g * size : (g + 1) * size] for g in (1, 3))  # of every second generation
    (copy / "parameters").write_bytes(head.replace(b'"every": 1', b'"every": 2') + b"\n" + kept)
    said = say("replay", str(copy), "--generation", "3", status=2)
    assert "generation 3 is not stored" in said
    assert "stored are 2 to 4 in steps of 2, the nearest is 2" in said
    assert len(said.splitlines()) == 1
    assert load(copy, 6).generation == 6  # the checkpoint's is always there
    assert np.array_equal(load(copy, 4).mu, stored(done, generation=4).mu)


def test_a_replay_says_what_it_shows(done: Farm, tmp_path: Path) -> None:
    path = tmp_path / "again.rrd"
    done.call("replay", "runs/a", "--generation", "2", "--friction", "0.5", "--to", str(path))
    (batch,) = read(path)["/rollout"]
    (name,) = [n for n in batch.schema.names if n.endswith(":text")]
    assert "mean policy after generation 2, friction 0.5" in batch.column(name).to_pylist()[0][0]


# ---------------------------------------------------------------- rewind


def texts(path: Path, entity: str) -> list[str]:
    found = []
    for batch in read(path)[entity]:
        (name,) = [n for n in batch.schema.names if n.endswith(":text")]
        found += [text for (text,) in batch.column(name).to_pylist()]
    return found


def test_rollouts_side_by_side(done: Farm, say: Say, tmp_path: Path) -> None:
    path = tmp_path / "again.rrd"
    line = done.progress("a")[1]
    said = say("replay", "runs/a", "--generation", "2", "--worst", "2", "--best", "1", "--to", str(path))
    first, second, third, written = said.splitlines()
    assert f"return {line['return_max']:.3f}" in first
    assert f"return {line['return_min']:.3f}" in second
    assert written == f"written to {path}; look at it with: farm view {path}"
    (table,) = texts(path, "/table")
    for shown in (first, second, third):
        title, name, result = re.fullmatch(r"(generation 2), (rollout \d): (return .*)", shown).groups()  # type: ignore[union-attr]
        assert f"### {title} of a" in table
        assert f"| {name} | {result} |" in table
        assert f"/rollouts/{name.replace(' ', chr(92) + ' ')}/world/object" in read(path)
    assert "`farm replay runs/a --generation 2 --rollout I`" in table


def test_one_rollout_and_those_that_the_task_ended(
    done: Farm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, run = tmp_path / "again.rrd", str(folder(done).path)
    assert main(["replay", run, "--rollout", "3", "--to", str(path)]) == 0
    assert texts(path, "/rollout")[0].startswith(f"### rollout 3 of generation {GENERATIONS}\n\nreturn ")
    dropped = [line["ended"] for line in done.progress("a")]
    generation = str(1 + int(np.argmax(dropped)))
    status = main(["replay", run, "--generation", generation, "--dropped", "3", "--to", str(path)])
    said = capsys.readouterr()
    assert status == int(not any(dropped))
    assert said.out.count(f"generation {generation}, rollout") == min(3, max(dropped))
    assert (f"no rollout of generation {generation} dropped" in said.err) == (status == 1)


def test_the_recording_offers_the_commands(done: Farm) -> None:
    offered = texts(folder(done).recording, "/again")
    assert len(offered) == GENERATIONS
    assert "farm replay runs/a --generation 1\n" in offered[0]
    assert "farm replay runs/a --generation 1 --best 5\nfarm replay runs/a --generation 1 --worst 5" in offered[0]
    for line, text in zip(done.progress("a"), offered, strict=True):
        assert ("--dropped" in text) == bool(line["ended"])


# ---------------------------------------------------------------- video


def test_pictures_in_a_grid() -> None:
    assert [video.tiled([np.zeros((3, 4, 3), np.uint8)] * n).shape[:2] for n in (1, 2, 5)] == [(3, 4), (3, 8), (6, 12)]
    assert video.tiled([np.zeros((3, 4, 3), np.uint8)] * 5)[-1, -1].tolist() == [255] * 3


needs_drawing = pytest.mark.skipif(
    not any(ctypes.util.find_library(name) for name in ("OSMesa", "EGL")),
    reason="needs OSMesa or EGL (Debian: libosmesa6 or libegl1)",
)


def test_moments_last_as_long_as_they_should() -> None:
    times = np.arange(151) * 0.01
    shown = video.moments(times.tolist(), speed=0.25, rest=1.0)
    assert len(shown) == 1.5 / 0.25 * 30 + 1 + 30
    assert shown[0] == 0
    assert shown[-31:] == [150] * 31
    assert np.all(np.diff(shown) >= 0)
    assert len(video.moments([0.0, 0.1], speed=10.0, rest=0.0)) == 2


@needs_drawing
@pytest.mark.slow
def test_a_gif(done: Farm, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "a.gif"
    said = done.call("replay", "runs/a", "--to", str(tmp_path / "a.rrd"), "--speed", "1", "--video", str(path))
    assert f"video: {path}" in said
    assert path.stat().st_size < 1.5e6
    with Image.open(path) as gif:
        assert gif.size == video.SIZE
        pictures = []
        for i in range(gif.n_frames):
            gif.seek(i)
            pictures.append(np.array(gif.convert("RGB"), dtype=int))
            seconds = gif.info["duration"] / 1000
    assert 0.02 <= seconds <= 1.1
    changed = np.abs(pictures[0] - pictures[-1]).max(axis=-1) > 60
    assert 0.005 < changed.mean() < 0.5  # fingers moved, the rest stayed
    orange = (pictures[0][..., 0] > 180) & (pictures[0][..., 2] < 90) & (pictures[0][..., 1] > 90)
    assert 0.01 < orange.mean() < 0.2  # the bar is there, and no more than a part of the picture


@pytest.mark.slow
def test_nothing_to_draw_with(done: Farm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    said = done.call("replay", "runs/a", "--to", str(tmp_path / "a.rrd"), "--video", str(tmp_path / "a.gif"), status=1)
    assert "MuJoCo cannot draw here" in said.splitlines()[-1]
    assert len(said.splitlines()) == 3  # and what the replay itself gave
    assert not (tmp_path / "a.gif").exists()


@needs_drawing
@pytest.mark.slow
def test_an_mp4(done: Farm, tmp_path: Path) -> None:
    import imageio_ffmpeg

    path = tmp_path / "a.mp4"
    done.call("replay", "runs/a", "--to", str(tmp_path / "a.rrd"), "--speed", "2", "--video", str(path))
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(path)
    assert frames == round(1.5 / 2 * 30) + 1 + 30
    assert seconds == pytest.approx(frames / 30, abs=0.05)


# ---------------------------------------------------------------- compare


def test_a_comparison_holds_each_runs_numbers(done: Farm, say: Say) -> None:
    said = say("compare", "runs/a", "runs/b", "--to", "c.rrd")
    assert "written to c.rrd; look at it with: farm view c.rrd" in said
    path = done.folder / "c.rrd"
    (recording,) = RrdReader(path).recordings()
    assert (recording.application_id, recording.recording_id) == ("rolloutfarm comparison", "comparison")
    entities = read(path)
    for name in ("a", "b"):
        (batch,) = [b for b in entities[f"/runs/{name}/return"] if "generation" in b.schema.names]
        (column,) = [n for n in batch.schema.names if n.endswith("scalars")]
        lines = done.progress(name)
        returns = [*(p["mean_policy_return"] for p in lines), done.summary(name)["mean_policy_return"]]
        assert [v[0] for v in batch.column(column).to_pylist()] == returns
        assert batch.column("generation").cast("int64").to_pylist() == [0, *(p["generation"] for p in lines)]
        assert batch.column("rollouts").cast("int64").to_pylist() == [0, *(p["rollouts"] for p in lines)]
        frames = sum(b.num_rows for b in entities[f"/runs/{name}/world/object"] if "sim_time" in b.schema.names)
        assert frames == len(again(done, name).trajectory.times)
    (batch,) = entities["/table"]
    (column,) = [n for n in batch.schema.names if n.endswith(":text")]
    table = batch.column(column).to_pylist()[0][0]
    assert "| policy | kernel | projected |" in table
    assert "| seed | 0 | 5 |" in table
    assert (
        f"| hash | {done.summary('a')['parameters_sha256'][:8]} | {done.summary('b')['parameters_sha256'][:8]}" in table
    )


def test_a_recording_has_its_runs_properties(done: Farm) -> None:
    found = {}
    for entity, batches in read(folder(done).recording).items():
        if entity.startswith("/__properties/"):
            for batch in batches:
                for name in batch.schema.names:
                    found[f"{entity.rpartition('/')[2]} {name.rpartition(':')[2]}"] = batch.column(name).to_pylist()[0]
    summary = done.summary("a")
    assert found["run seed"] == [0]
    assert found["run policy"] == ["kernel"]
    assert found["run preset"] == ["own"]
    assert found["result return"] == [summary["mean_policy_return"]]
    assert found["result success"] == [summary["mean_policy_success"]]


@pytest.mark.slow
def test_several_recordings_are_a_table_in_the_viewer(done: Farm, tmp_path: Path) -> None:
    import rerun_cli
    from rerun.experimental import ViewerClient

    from learner.recording.viewing import free_port, once_loaded, show_table

    other = tmp_path / "other.rrd"
    done.call("replay", "runs/a", "--to", str(other))
    files = [str(folder(done).recording), str(other)]
    port = free_port()
    binary = Path(rerun_cli.__file__).with_name("rerun")  # `python -m rerun` would only be its parent
    command = [binary, *files, "--bind", "127.0.0.1", "--port", str(port), "--headless"]
    home = {name: str(tmp_path) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR")}
    with (tmp_path / "viewer.log").open("w+") as log:
        viewer = subprocess.Popen(command, env={**os.environ, **home}, stdout=log, stderr=log)
        try:
            shown = once_loaded(port, lambda: viewer.poll() is not None, show_table)
            if viewer.poll() is not None:
                log.seek(0)
                pytest.skip(f"the viewer needs Vulkan (Debian: mesa-vulkan-drivers libvulkan1): {log.read()[-200:]}")
            assert shown
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            columns: set[str] = set()

            def drawn() -> bool:
                client.take_screenshot()  # a viewer without a window draws when it is asked
                with contextlib.suppress(ConnectionError):  # not drawn yet
                    columns.update(column.name for column in client.get_table_schema())
                return bool(columns)

            done.wait_for(drawn)
        finally:
            viewer.terminate()
            viewer.wait(20)
    assert {"property:run:seed", "property:run:preset", "property:result:return", "property:result:success"} <= columns


# ---------------------------------------------------------------- export


def bare(farm: Farm, path: Path) -> str:
    """The example's output, in an interpreter in which importing this project raises."""
    code = (
        "import runpy, sys\n"
        "for package in ('farm', 'learner', 'workers'): sys.modules[package] = None\n"
        f"sys.path.append({str(Path(mujoco.__file__).parents[1])!r})\n"
        f"sys.argv = ['play_policy.py', {str(path)!r}]\n"
        f"runpy.run_path({str(PLAY_POLICY)!r}, run_name='__main__')\n"
    )
    command = [sys.executable, "-I", "-S", "-c", code]
    ended = subprocess.run(command, cwd=farm.folder, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def returned(said: str) -> float:
    return float(said.splitlines()[-1].removeprefix("return "))


@pytest.mark.parametrize("name", ["a", "b"])
def test_an_exported_policy_gives_the_same_return_to_the_last_bit(done: Farm, say: Say, name: str) -> None:
    path = done.folder / f"{name}.npz"
    said = say("export", f"runs/{name}", str(path))
    assert f"written to {path}" in said
    with np.load(path, allow_pickle=False) as file:
        assert file["mu"].tobytes() == stored(done, name).mu.tobytes()
        assert "file=" not in str(file["mjcf"])
    assert returned(bare(done, path)) == done.summary(name)["mean_policy_return"]


def test_a_policy_is_exported_for_other_runtimes(done: Farm, say: Say, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    say("export", "runs/a", str(tmp_path / "p.onnx"))
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    policy, mu = load(folder(done).path).problem.policy, stored(done).mu
    x = np.full((1, policy.spec.observation), 0.5)
    (action,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(action, policy.act(policy.prepare(mu[None]), x), rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_an_exported_policy_in_an_environment_of_its_own(done: Farm, tmp_path: Path) -> None:
    done.call("export", "runs/a", str(tmp_path / "p.npz"))
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    wanted = [f"{name}=={importlib.metadata.version(name)}" for name in ("mujoco", "numpy")]
    quiet = ("--quiet", "--disable-pip-version-check")
    subprocess.run([python, "-m", "pip", "install", *quiet, *wanted], check=True, timeout=170)
    assert subprocess.run([python, "-c", "import farm"], cwd=tmp_path, capture_output=True, check=False).returncode == 1
    command = [python, PLAY_POLICY, tmp_path / "p.npz"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True).stdout
    assert returned(said) == done.summary("a")["mean_policy_return"]


# ---------------------------------------------------------------- play


@pytest.mark.parametrize("memory", [False, True])
def test_what_is_played_is_the_replay_bit_for_bit(done: Farm, memory: bool) -> None:
    policy = stored(done)
    if memory:
        other = Rnn(RnnConfig(units=4), policy.problem.spec, {})
        mu = other.start(np.random.default_rng(0))
        policy = LoadedPolicy(replace(policy.problem, policy=other), policy.generation, mu)
    shown = policy.rollout()
    task, seen = policy.problem.task, [shown.frames["qpos"][0]]
    engine = DataEngine(task.model)
    task.setup(Sim(engine))

    def step() -> bool:
        mujoco.mj_step(task.model, engine.data)
        seen.append(engine.data.qpos.copy())
        return True

    engine.pace = step
    for _ in range(2):  # nothing of one rollout is left in the next
        del seen[1:]
        assert rollout(policy)(Sim(engine)) == shown.rollouts.steps[0]
        assert np.stack(seen).tobytes() == shown.frames["qpos"].tobytes()


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[str]:
    """A display of our own without a screen."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb (Debian: xvfb, libgl1-mesa-dri)")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "900x700x24", "-nolisten", "tcp"]
    with (tmp_path / "xvfb.log").open("w") as log:
        process = subprocess.Popen(command, pass_fds=(writing,), stdout=log, stderr=log)
    os.close(writing)
    with os.fdopen(reading) as number:
        yield f":{number.readline().strip()}"
    process.terminate()
    process.wait(10)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_play_on_a_display(done: Farm, screen: str, monkeypatch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    monkeypatch.setenv("DISPLAY", screen)
    process = done.start("play", "runs/a", "--speed", "10", "--hold", "0")
    assert process.stdout is not None
    assert "double-click a body" in process.stdout.readline()
    assert "the first rollout ended after" in process.stdout.readline()
    process.send_signal(number)
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 130, said
    assert int(said.splitlines()[-1].split()[0]) >= 15
    assert "Traceback" not in said
    assert "X Error" not in said


@pytest.mark.slow
def test_play_needs_a_display(done: Farm, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    said = done.call("play", "runs/a", status=2)
    assert "no display to open a window on: farm replay runs/a --video rollout.gif draws without one" in said
    monkeypatch.setenv("DISPLAY", ":987")
    assert "cannot open a window" in done.call("play", "runs/a", status=1)


# ---------------------------------------------------------------- mistakes

MISTAKES = [
    (("replay", "runs/a", "--generation", "99"), 2, "generation 99 is not stored"),
    (("replay", "runs/a", "--generation", "0", "--best", "1"), 2, "generation 0 of the run in runs/a has no rollouts"),
    (("replay", "runs/a", "--rollout", "8"), 2, "generation 6 has no rollout 8: there are 0 to 7"),
    (("replay", "runs/a", "--worst", "13"), 2, "worst is 13; expected 1 to 12"),
    (("replay", "runs/a", "--generation", "-1"), 2, "generation is -1; expected 0 to 10000000"),
    (("replay", "runs/a", "--object", "cat"), 2, "unknown object 'cat'; known are bar"),
    (("replay", "runs/a", "--friction", "0"), 2, "friction is 0.0; expected a positive number"),
    (("replay", "runs/a", "--friction", "nan"), 2, "friction is nan; expected a finite number"),
    (("replay", "runs/a", "--speed", "0"), 2, "speed is 0.0; expected 0.01 to 10"),
    (("replay", "runs/a", "--video", "a.avi"), 2, "--video a.avi: expected a name that ends in .gif or .mp4"),
    (("replay", "runs/a", "--video", "none/a.gif"), 2, "cannot write none/a.gif: there is no folder none"),
    (("replay", "runs/a", "--to", "/proc/a.rrd"), 1, "cannot write /proc/a.rrd"),
    (("replay", "runs/a", "--to", "runs/a/run.rrd"), 2, "--to runs/a/run.rrd would replace the run's own recording"),
    (("replay", "runs/a", "--to", "runs/a/replay.rrd"), 2, "--to runs/a/replay.rrd would replace the run's own"),
    (("replay", "runs/a", "--to", "runs/a/checkpoint"), 2, "--to runs/a/checkpoint: a recording's name ends in .rrd"),
    (("compare", "runs/a", "runs/b", "--to", "runs/a/config.json"), 2, "a recording's name ends in .rrd"),
    (("view", "runs/a/config.json", "--web"), 2, "runs/a/config.json is not a recording"),
    (("compare", "runs/a"), 2, "farm compare takes 2 to 7 runs, not 1"),
    (("compare", "runs/a", "runs/../runs/a"), 2, "is there twice"),
    (("compare", "runs/a", "nowhere"), 2, "nowhere is not a run's folder"),
    (("compare", "runs/a", "runs/b", "--to", "/proc/c.rrd"), 1, "cannot write /proc/c.rrd"),
    (("view", "runs/a", "nowhere"), 2, "no recording in nowhere"),
    (("runs", "--serve", "0"), 2, "--serve '0' is no port; take one from 1 to 65535"),
    (("runs", "--serve", "9876", "--csv"), 2, "--json, --csv and --serve exclude each other"),
    (("export", "nowhere", "p.npz"), 2, "nowhere is not a run's folder"),
    (("export", "runs/a", "p.zip"), 2, "p.zip: expected a name that ends in .npz or .onnx"),
    (("export", "runs/a", "no/p.npz"), 1, "cannot write no/p.npz: No such file or directory"),
    (("export", "runs/a", "p.npz", "--generation", "99"), 2, "generation 99 is not stored"),
    (("play", "nowhere"), 2, "nowhere is not a run's folder"),
    (("play", "runs/a", "--hold", "-1"), 2, "hold is -1.0; expected 0 to 3600"),
]


@pytest.mark.parametrize(
    ("words", "status", "line"), MISTAKES, ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_mistakes(
    done: Farm, words: tuple[str, ...], status: int, line: str, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(done.folder)
    assert main(words) == status
    said = "".join(capfd.readouterr())
    assert line in said
    assert len(said.strip().splitlines()) == 1, said


@pytest.mark.slow
def test_a_summary_that_is_not_there_yet(done: Farm, tmp_path: Path) -> None:
    shutil.copytree(folder(done).path, tmp_path / "a")
    (tmp_path / "a" / "summary.json").unlink()
    done.call("compare", "runs/a", str(tmp_path / "a"), "--to", str(tmp_path / "c.rrd"))
    (batch,) = read(tmp_path / "c.rrd")["/table"]
    (column,) = [n for n in batch.schema.names if n.endswith(":text")]
    figure = f"{done.summary('a')['mean_policy_return']:.3f}"
    assert f"| return of the final policy | {figure} | - |" in batch.column(column).to_pylist()[0][0]


def test_the_exported_numbers_are_plain(done: Farm) -> None:
    values = export.contents(stored(done))
    assert json.dumps(sorted(values))
    assert all(np.asarray(value).dtype.kind in "fiU" for value in values.values())
