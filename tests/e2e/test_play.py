"""`farm play`: what is played is the replay, and the window that it needs."""

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from finished import stored
from processes import Farm

from farm.policies.recurrent import Rnn, RnnConfig
from farm.sim.engines import DataEngine
from farm.sim.sim import Sim
from learner.tools.replay.loaded import LoadedPolicy
from learner.tools.replay.play import rollout

pytestmark = pytest.mark.usefixtures("grips_found_once")


@pytest.mark.parametrize("memory", [False, True])
def test_what_is_played_is_the_replay_bit_for_bit(done: Farm, memory: bool) -> None:
    policy = stored(done)
    if memory:
        other = Rnn(RnnConfig(units=4), policy.problem.spec, {})
        mu = other.start(np.random.default_rng(0))
        policy = LoadedPolicy(replace(policy.problem, policy=other), policy.generation, mu)
    replay = policy.rollout()
    task, poses = policy.problem.task, [replay.frames["qpos"][0]]
    engine = DataEngine(task.model)
    task.setup(Sim(engine))

    def step() -> bool:
        mujoco.mj_step(task.model, engine.data)
        poses.append(engine.data.qpos.copy())
        return True

    engine.pace = step
    for _ in range(2):  # nothing of one rollout is left in the next
        del poses[1:]
        assert rollout(policy)(Sim(engine)) == replay.rollouts.steps[0]
        assert np.stack(poses).tobytes() == replay.frames["qpos"].tobytes()


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
def test_play_on_a_display(
    done: Farm, screen: str, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setenv("DISPLAY", screen)
    process = done.start("play", "runs/a", "--speed", "10", "--hold", "0")
    assert process.stdout is not None
    assert "double-click a body" in process.stdout.readline()
    assert "the first rollout ended after" in process.stdout.readline()
    process.send_signal(number)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130, output
    assert int(output.splitlines()[-1].split()[0]) >= 15
    assert "Traceback" not in output
    assert "X Error" not in output


@pytest.mark.slow
def test_play_needs_a_display(done: Farm, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    output = done.call("play", "runs/a", status=2)
    assert (
        "no display to open a window on: farm replay runs/a --video rollout.gif draws without one"
        in output
    )
    monkeypatch.setenv("DISPLAY", ":987")
    assert "cannot open a window" in done.call("play", "runs/a", status=1)
