"""`farm check`: which word is the task, and settings with the same name as a flag of the
command.
"""

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from farm import plugins
from farm.__main__ import main
from learner.run.config import configure
from learner.run.setup import problem
from learner.tools.check import check, command
from learner.tools.tasks import new_task

TASK = """import farm
from dataclasses import dataclass

class Mine(farm.Task):
    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        speed: float = 1.0
"""


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["--picture", "x.png", "mine.py:Mine"], "mine.py:Mine"),
        (["--torque", "2", "finger-gait", "--picture", "x.png"], "finger-gait"),
        (["nonsense", "--steps", "3"], "nonsense"),
        (["--policy", "own.py:Own", "--backend", "own.py:Other", "mine.py:Mine"], "mine.py:Mine"),
        (["--steps=3"], None),
    ],
)
def test_the_task_may_stand_anywhere(words: list[str], name: str | None) -> None:
    assert command.task_name(words) == name


def test_a_setting_that_a_command_has_as_well_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(TASK)
    assert main(["check", f"{path}:Mine"]) == 2
    assert (
        capsys.readouterr().err
        == "farm: --speed of farm replay is also a setting of Mine.Config: rename that\n"
    )


LEAVES = """
import sys
import numpy as np
import farm

class Leaves(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="j"/></actuator></mujoco>'''
    steps = 3
    channels = (farm.Channel(name="angle", kind="scalars", shape=(1,)),)

    def reset(self, sim, row, rng):
        pass

    def reward(self, sim, action):
        return np.cos(sim.qpos[:, 0])

    def success(self, sim):
        return sim.qpos[:, 0] > 0

    def measure(self, sim):
        return {"angle": sim.qpos}
"""


@pytest.mark.parametrize("method", ["reset", "reward", "success", "measure"])
def test_a_task_that_exits_is_a_failure_that_names_it(
    method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, head = tmp_path / "leaves.py", f"    def {method}("
    before, _, after = LEAVES.partition(head)
    first, _, rest = after.partition("\n")
    path.write_text(f"{before}{head}{first}\n        sys.exit(5)\n{rest}")
    assert main(["check", f"{path}:Leaves", "--picture", str(tmp_path / "x.png")]) == 1
    line = path.read_text().partition("sys.exit")[0].count("\n") + 1
    errors = capsys.readouterr().err
    assert errors == f"farm: sys.exit(5) in leaves.py, line {line}: raise an error instead\n"


SLIDES = """import random
import numpy as np
from farm import Task

DRAWN = random.random()
print("imported")


class Slides(Task):
    xml = \'\'\'<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
    <geom size="1"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>\'\'\'
    steps = 4
{}

    def reward(self, sim, action):
        return {}
"""


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo ends a process that tries twice to draw without a display."""
    monkeypatch.setattr(check, "_picture", lambda *_: "no picture")


def written(folder: Path, members: str = "", reward: str = "sim.qpos[:, 0]") -> str:
    """A task with these members and this reward."""
    (folder / "slides.py").write_text(SLIDES.format(members, reward))
    return f"{folder}/slides.py:Slides"


def checks(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    members: str = "",
    reward: str = "sim.qpos[:, 0]",
) -> str:
    """What `farm check` says of it, errors included."""
    status = main(["check", written(folder, members, reward)])
    output = capsys.readouterr()
    assert status == (1 if output.err else 0)
    return output.out + output.err


def warnings(name: str) -> list[str]:
    subject = problem(configure(name))
    return [
        *check.odd(subject.runner().rollouts(*check.batch(subject))),
        *check.unread(type(subject.task)),
    ]


@pytest.mark.usefixtures("no_picture")
def test_actuators_that_the_model_disables_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(written(tmp_path).partition(":")[0])
    disabled = (
        path.read_text()
        .replace("<mujoco>", '<mujoco><option actuatorgroupdisable="2"/>')
        .replace('<motor joint="x"/>', '<motor joint="x"/><motor name="off" joint="x" group="2"/>')
    )
    path.write_text(disabled)
    assert main(["check", f"{path}:Slides"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "warning: the model disables actuators, whose controls do nothing: off" in lines


@pytest.mark.usefixtures("no_picture")
def test_nothing_odd_is_said_of_a_sound_task_and_its_terms_move_no_cursor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = checks(tmp_path, capsys, reward="{'\\x1b[2J\\x9b1m': sim.qpos[:, 0]}")
    assert "warning" not in output
    assert "reward of \\x1b[2J\\x9b1m\n" in output
    assert "same bits together, in another order, one by one, and in another process" in output


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(
    ("memory", "act", "status", "line"),
    [
        ("np.zeros(2)", "x[:, :1] + memory[:, :1], memory + x", 0, ""),
        (
            "np.zeros((2, 1))",
            "x[:, :1], memory",
            2,
            "memory of own.py:Own gave an array of float64 (2, 1); expected a vec",
        ),
        (
            "np.zeros(2)",
            "x[:, :1], memory[:, 1]",
            1,
            "memory from act of the policy gave an array of shape (8,); expe",
        ),
        (
            "np.zeros(2)",
            "x[:, :1]",
            1,
            "act of the policy gave a ndarray; expected (action, memory), as the policy",
        ),
    ],
)
def test_a_policy_of_ones_own_is_checked(
    memory: str,
    act: str,
    status: int,
    line: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom farm import Policy\n\nclass Own(Policy):\n    size = 1\n"
        f"    memory = {memory}\n    def act(self, prepared, x, memory):\n        return {act}\n"
    )
    assert main(["check", "--policy", f"{tmp_path}/own.py:Own", written(tmp_path)]) == status
    output = capsys.readouterr()
    assert output.err.startswith(f"farm: {line}" if line else "")
    assert output.err.count("\n") == (1 if line else 0)
    assert (
        line
        or "same bits together, in another order, one by one, and in another process" in output.out
    )


@pytest.mark.usefixtures("no_picture")
def test_warnings_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = checks(tmp_path, capsys, "    step = 7", "np.ones(len(sim))")
    assert [line for line in output.splitlines() if line.startswith("warning: ")] == [
        "warning: all 8 rollouts have the same return, so that there is nothing to learn",
        "warning: Slides.step is not read by anything; is steps meant?",
    ]


WILD = """import numpy as np
from farm import Policy

class Wild(Policy):
    size = 1
    def act(self, prepared, x): return np.nan * prepared
"""


@pytest.mark.usefixtures("no_picture")
def test_actions_that_are_not_finite_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wild.py").write_text(WILD)
    assert main(["check", "--policy", f"{tmp_path}/wild.py:Wild", written(tmp_path)]) == 0
    said = "warning: act of the policy is not finite in 8 of 8 rollouts\n"
    assert said in capsys.readouterr().out


DEAF = """import numpy as np
from farm import Policy

class Deaf(Policy):
    size = 1
    def start(self, rng): return np.array([20.0])
    def act(self, prepared, x): return np.tanh(prepared)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(
    ("words", "policy", "advice"),
    [
        (("finger-gait", "--state", "tactile"), "kernel", "--start fitted"),
        (
            ("SLIDES", "--policy", "DEAF"),
            "DEAF",
            "a larger --initial-sigma, or another --policy, such as linear",
        ),
        (("finger-gait",), "", ""),
        (("SLIDES",), "", ""),
    ],
)
def test_perturbations_that_change_no_action_are_said(
    words: tuple[str, ...],
    policy: str,
    advice: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "deaf.py").write_text(DEAF)
    names = {"DEAF": f"{tmp_path}/deaf.py:Deaf", "SLIDES": written(tmp_path)}
    assert main(["check", *(names.get(word, word) for word in words)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "no perturbation" in line]
    assert len(lines) == (1 if policy else 0)
    for line in lines:
        assert line.startswith("warning: no perturbation changes any action: ")
        assert f"change those of policy {names.get(policy, policy)} by at most " in line
        assert line.endswith(f", so that a run learns nothing; try {advice}")


@pytest.mark.parametrize("task", ["finger-gait", "fragile-bar", "turning"])
def test_nothing_is_unread_in_our_own_tasks(task: str) -> None:
    assert list(check.unread(plugins.find("tasks", task).target)) == []


@pytest.mark.parametrize(
    ("members", "warning"),
    [
        (
            "    def ended(self, sim): return np.ones(len(sim), dtype=bool)",
            "every rollout ends in its first control step; is `ended` what you mean?",
        ),
        ("    sub_steps = 7", "Slides.sub_steps is not read by anything; is substeps meant?"),
        ("    def rewards(self): pass", "Slides.rewards is not read by anything; is reward meant?"),
        (
            "    step = 7\n    def prepare(self, sim, rngs): sim.step(1)",
            "Slides.step is not read by anything; is steps meant?",
        ),
    ],
)
def test_what_is_hardly_meant_is_said(members: str, warning: str, tmp_path: Path) -> None:
    assert warnings(written(tmp_path, members)) == [warning]


def test_an_attribute_that_the_task_reads_itself_is_no_mistake(tmp_path: Path) -> None:
    assert warnings(written(tmp_path, "    step = 7", "self.step * sim.qpos[:, 0]")) == []


@pytest.mark.parametrize(
    ("members", "reward", "name"),
    [
        ("", "sim.qpos[:, 0] + DRAWN", "terms"),
        (
            "    def act(self, sim, action): return action + hash('x') / 2**64",
            "sim.qpos[:, 0]",
            "actions",
        ),
    ],
)
@pytest.mark.usefixtures("no_picture")
def test_numbers_of_a_process_of_its_own_are_found(
    members: str,
    reward: str,
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Inherited, it would give the second process the same hashes
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    output = checks(tmp_path, capsys, members, reward).splitlines()[-1]
    assert output.startswith(
        f"farm: {name} differs when the same rollouts run in another process: numbers must not"
    )


@pytest.mark.usefixtures("no_picture")
def test_a_task_that_another_process_cannot_run_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    once = "    from pathlib import Path; Path(__file__).with_suffix('.once').touch(exist_ok=False)"
    output = checks(tmp_path, capsys, once).splitlines()[-1]
    assert output.startswith("farm: the same rollouts cannot be simulated in another process: ")
    assert "FileExistsError" in output


@pytest.mark.slow
@pytest.mark.skipif(
    not any(ctypes.util.find_library(name) for name in ("OSMesa", "EGL")),
    reason="needs OSMesa or EGL (Debian: libosmesa6 or libegl1)",
)
def test_a_picture_is_drawn_without_a_display(tmp_path: Path) -> None:
    text = Path(new_task.__file__).with_name(new_task.TEMPLATE).read_text("utf-8")
    (tmp_path / "pendulum.py").write_text(text)
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-P", "-m", "farm", "check", "pendulum.py:Pendulum"]
    process = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert process.stdout.splitlines()[-1] == "the start: pendulum.png"
    assert (tmp_path / "pendulum.png").stat().st_size > 1000
