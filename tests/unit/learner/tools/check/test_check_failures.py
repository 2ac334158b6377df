"""`farm check` on tasks whose rollouts fail: what it sees, what it tries, and its exit status."""

from pathlib import Path

import pytest

from farm.__main__ import main
from learner.tools.check import check


@pytest.fixture(autouse=True)
def _nothing_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "_picture", lambda *_: "no picture")


ARM = '''
import numpy as np
import farm

class Arm(farm.Task):
    """An arm."""

    xml = """<mujoco><option timestep="0.01"/><worldbody><body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-90 90" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="0.05"/></body></worldbody>
      <actuator><position joint="shoulder" kp="KP" ctrlrange="-1 1"/></actuator></mujoco>"""
    steps, substeps = 20, 2

    def reset(self, sim, row, rng):
        sim.qpos[row] = START

    def act(self, sim, action):
        WRITE
        return super().act(sim, action)

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0])
'''


def checked(
    folder: Path, capsys: pytest.CaptureFixture[str], kp: str, start: str, write: str
) -> tuple[int, str, str]:
    (folder / "arm.py").write_text(
        ARM.replace("KP", kp).replace("START", start).replace("WRITE", write)
    )
    status = main(["check", f"{folder / 'arm.py'}:Arm"])
    out, err = capsys.readouterr()
    return status, out, err


def test_all_unstable_is_a_failure_with_its_causes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = checked(tmp_path, capsys, "50000", "0.3", "pass")
    assert status == 1
    assert err == "farm: all 8 rollouts became unstable, so that nothing can be learnt: see above\n"
    assert "the simulation of 8 of 8 rollouts became unstable:\n" in out
    assert "joint 'shoulder' of body 'upper' left first" in out
    assert "too long for it; at most" in out
    assert '  tried armature="0.01" and damping="0.1" for each joint that has neither (1): ' in out
    assert "e+12" not in out + err


def test_degrees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = checked(tmp_path, capsys, "50000", "45.0", "pass")
    assert status == 1
    assert "starts at 45 rad, outside -1.57 to 1.57: 0.785 rad, if degrees were meant" in out


def test_some_unstable_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = checked(
        tmp_path, capsys, "1", "0.3", "sim.qvel[(action[:, 0] > 0.5) & (sim.t == 0)] = np.inf"
    )
    assert (status, err) == (0, "")
    [line] = [line for line in out.splitlines() if line.startswith("warning: the simulation of ")]
    assert 0 < int(line.split()[4]) < 8
    assert "so that commands do not use their full range: none is unstable" in out
    assert "e+12" not in out


def test_an_error_in_some_rollouts_is_a_warning_with_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = checked(
        tmp_path, capsys, "1", "0.3", "assert sim.t or (action[:, 0] < 0.5).all(), 'too fast'"
    )
    assert (status, err) == (0, "")
    assert "rollouts failed, the first with AssertionError: too fast" in out
    assert "in act" in out


def test_an_error_in_all_rollouts_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = checked(tmp_path, capsys, "1", "0.3", "assert sim.t < 3, 'too late'")
    assert status == 1
    assert "too late" in err
