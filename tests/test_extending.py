"""The examples of docs/extending.md, run from a folder of their own as a reader would."""

import json
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import farm as public
from farm import Task
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks import loop
from farm.tasks.actions.space import ActionSpace
from farm.tasks.probe import specification
from learner.tools.tasks import new_task

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs/extending.md").read_text("utf-8")
SECTIONS = {part.partition("\n")[0]: part for part in re.split(r"^## ", PAGE, flags=re.M)}
_FILE = re.compile(r"`(\w+\.(?:py|toml))`[^`]*?:\n\n```(?:python|toml)\n(.*?)```", re.S)


def files(section: str) -> dict[str, str]:
    """The files that a section tells to write."""
    return dict(_FILE.findall(SECTIONS[section]))


def commands(section: str, *names: str) -> list[list[str]]:
    """Its commands, in order."""
    lines = re.findall(r"^    (farm .*)$", SECTIONS[section], re.M)
    return [shlex.split(line)[1:] for line in lines if line.split()[1] in names]


def farm(folder: Path, *words: str, status: int = 0) -> str:
    command = [sys.executable, "-P", "-m", "farm", *words]
    process = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=170, check=False
    )
    assert process.returncode == status, process.stderr
    return process.stdout + process.stderr


def write(folder: Path, *sections: str) -> None:
    for section in sections:
        for name, text in files(section).items():
            (folder / name).write_text(text)


def summary(folder: Path, name: str) -> dict[str, object]:
    return json.loads((folder / "runs" / name / "summary.json").read_text())


TASK = "A task in a file"


def test_the_page_shows_the_file_that_new_task_writes() -> None:
    text = (Path(new_task.__file__).with_name(new_task.TEMPLATE)).read_text("utf-8")
    assert files(TASK)["pendulum.py"] == text
    assert len(text.splitlines()) <= 31


def test_every_section_has_its_example() -> None:
    examples = {
        "A policy": "linear.py",
        "An algorithm": "elite.py",
        "A backend": "threads.py",
        "A channel": "swing.py",
    }
    examples |= {"A logger": "lines.py", "A policy with memory": "leaky.py"}
    for section, name in examples.items():
        assert list(files(section)) == [name]
        assert commands(section, "run")


def test_what_the_page_says_of_sim() -> None:
    """`own` is created as the page shows, only `act` can write states, and outputs are one physics
    step late.
    """
    [create] = re.findall(r"`(sim\.own\.setdefault.*?)`", SECTIONS[TASK])
    write = textwrap.dedent("".join(re.findall(r"^    (?:now|sim\.).*\n", SECTIONS[TASK], re.M)))
    assert len(write.splitlines()) == 3
    record: dict[str, np.ndarray] = {}

    class Slides(Task):
        xml = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
            <geom size="1"/></body>
          <body name="goal" mocap="true"/></worldbody><actuator>
              <motor joint="x"/></actuator></mujoco>"""
        steps, substeps = 3, 5

        def reset(self, sim: Any, row: int, rng: np.random.Generator | None) -> None:
            exec(create, {"sim": sim, "row": row, "rng": rng, "np": np})
            sim.own["when"] = np.array([1, 2])

        def observe(self, sim: Any) -> np.ndarray:
            if sim.t == 0:
                record["goal"] = sim.own["goal"].copy()
                np.testing.assert_array_equal(sim.xpos[:, 1, 0], sim.qpos[:, 0])
            else:
                lag = sim.qpos[:, 0] - sim.xpos[:, 1, 0]
                np.testing.assert_allclose(lag, sim.qvel[:, 0] * sim.model.opt.timestep, rtol=1e-9)
            for name in ("qpos", "mocap_pos", "xfrc_applied", "ctrl"):
                with pytest.raises(ValueError, match="read-only"):
                    getattr(sim, name)[:] = 0.0
            return sim.qpos

        def act(self, sim: Any, action: np.ndarray) -> np.ndarray:
            exec(write, {"sim": sim})
            assert sim.xfrc_applied[:, 1, 0].tolist() == [5.0 * (sim.t >= 1), 5.0 * (sim.t >= 2)]
            assert sim.mocap_pos[:, 0, 0].tolist() == [0.01 * sim.t] * 2
            return np.ones((len(sim), 1))

        def reward(self, sim: Any, action: np.ndarray) -> np.ndarray:
            return sim.qpos[:, 0]

    task = Slides()
    sim = Sim(BatchEngine(task.model, 2))
    batch = loop.again(lambda: loop.Batch(task, sim, [None, (1,)]))
    for _ in range(task.steps):
        loop.again(batch.observe)
        batch.step(np.zeros((2, 1)))
    assert record["goal"].shape == (2, 2)
    assert (record["goal"][0] == 0.0).all()
    assert (record["goal"][1] != 0.0).all()


PUCK = '<body name="puck"><freejoint/><geom size=".1"/></body>'
MODELS = {
    "Dragged": (
        f"""<worldbody><body name="target" mocap="true"/>{PUCK}</worldbody>
      <equality><weld body1="target" body2="puck"/></equality>"""
    ),
    "Pushed": f"<worldbody>{PUCK}</worldbody>",
}
"""A model for each of the page's actions."""


@pytest.mark.parametrize("name", MODELS)
def test_an_action_of_the_page_moves_the_model(name: str) -> None:
    [source] = re.findall(r"### What an action is\n.*?```python\n(.*?)```", PAGE, re.S)
    classes: dict[str, Any] = {}
    exec(source, classes)
    assert {
        each
        for each, value in classes.items()
        if isinstance(value, type) and value.__module__ != "farm"
    } >= {name}
    attributes = {
        "xml": f"<mujoco><option gravity='0 0 0'/>{MODELS[name]}</mujoco>",
        "reward": lambda self, sim, action: np.zeros(len(sim)),
        "steps": 5,
        "substeps": 10,
    }
    task = type(name, (classes[name],), attributes)()
    size = specification(task).action
    assert size == (3 if name == "Dragged" else 2)
    sim = Sim(BatchEngine(task.model, 2))

    def moved() -> np.ndarray:
        batch = loop.Batch(task, sim, [None, None])
        for _ in range(task.steps):
            batch.observe()
            batch.step(np.array([np.zeros(size), np.full(size, 0.5)]))
        return abs(sim.qvel).max(axis=1)

    still, moving = loop.again(moved)
    assert still == 0.0
    assert moving > 1e-3


def test_each_action_space_of_the_page_is_a_public_class() -> None:
    table = PAGE.partition("### What an action is")[2].partition("They nest")[0]
    cells = re.findall(r"^\| `(farm\..*?)` \|", table, re.M)
    spaces = [eval(cell, {"farm": public}) for cell in cells]
    kinds = {type(each) for each in spaces}
    names = [getattr(public, name) for name in public.__all__]
    known = {each for each in names if isinstance(each, type) and issubclass(each, ActionSpace)}
    assert kinds == known - {ActionSpace}


def test_a_keyframe_of_the_page_is_the_start() -> None:
    [source] = re.findall(r"A \*\*keyframe\*\*.*?\n\n((?:    .*\n)+)", PAGE)
    methods: dict[str, Any] = {}
    exec(textwrap.dedent(source), methods)
    attributes = {
        "xml": (
            """<mujoco><worldbody><body><joint name="x"/><geom size="1"/></body></worldbody>
          <actuator><muscle name="m" joint="x" ctrlrange="0 1" lengthrange="0 1"/>
          <motor joint="x"/></actuator>
          <keyframe><key name="home" qpos="0.3" qvel="0.1" act="0.5"/></keyframe></mujoco>"""
        ),
        "reset": methods["reset"],
        "observe": lambda self, sim: np.concatenate([sim.qpos, sim.qvel, sim.act], axis=1),
        "reward": lambda self, sim, action: np.zeros(len(sim)),
    }
    task = type("Home", (Task,), attributes)()
    assert specification(task).observation == 3
    sim = Sim(BatchEngine(task.model, 1))
    start = loop.again(lambda: loop.Batch(task, sim, [None]).observe())
    np.testing.assert_array_equal(start, [[0.3, 0.1, 0.5]])
    np.testing.assert_array_equal(task.limits, [[0.0, -1.0], [1.0, 1.0]])


@pytest.mark.slow
def test_a_task_in_a_file(tmp_path: Path) -> None:
    assert "farm check pendulum.py:Pendulum" in farm(tmp_path, "new-task", "pendulum")
    output = farm(tmp_path, *commands(TASK, "check")[0])
    assert "same bits together, in another order, one by one, and in another process" in output
    [learn] = commands(TASK, "run")
    farm(tmp_path, *learn)
    learnt = summary(tmp_path, "pendulum")
    assert learnt["state"] == "finished"
    assert learnt["mean_policy_return"] > 50, "swung up; hanging is -100"
    assert (tmp_path / "runs/pendulum/run.rrd").stat().st_size > 50_000
    farm(
        tmp_path,
        "run",
        "--config",
        "runs/pendulum/config.json",
        "--name",
        "again",
        "--workers",
        "1",
        "--no-record",
    )
    assert summary(tmp_path, "again")["parameters_sha256"] == learnt["parameters_sha256"]
    assert f"return {learnt['mean_policy_return']:.3f}" in farm(
        tmp_path, *commands(TASK, "replay")[0]
    )
    text = (tmp_path / "pendulum.py").read_text()
    (tmp_path / "pendulum.py").write_text(
        text.replace("np.cos(sim.qpos[:, 0])", "2 * np.cos(sim.qpos[:, 0])")
    )
    output = farm(tmp_path, "run", "--resume", "runs/pendulum", "--generations", "90", status=2)
    assert "the code of its task has changed since the run began" in output


@pytest.mark.slow
def test_a_policy_an_algorithm_a_backend_and_a_channel(tmp_path: Path) -> None:
    write(
        tmp_path, TASK, "A policy", "A policy with memory", "An algorithm", "A backend", "A channel"
    )
    for section in ("A policy", "A policy with memory", "An algorithm", "A backend", "A channel"):
        for words in commands(section, "run"):
            farm(tmp_path, *words, *([] if section == "A channel" else ["--no-record"]))
    assert summary(tmp_path, "linear")["rollouts"] == 320
    assert summary(tmp_path, "leaky")["state"] == "finished"
    words = commands("A policy with memory", "check")[0]
    assert "same bits together, in another order" in farm(tmp_path, *words)
    assert summary(tmp_path, "elite")["generations"] == 8
    farm(
        tmp_path,
        "run",
        "--task",
        "pendulum.py:Pendulum",
        "--generations",
        "2",
        "--name",
        "plain",
        "--no-record",
    )
    same = [summary(tmp_path, name)["parameters_sha256"] for name in ("threads", "plain")]
    assert same[0] == same[1]
    from recordings import read

    entities = read(tmp_path / "runs/swing/run.rrd")
    assert {"/energy", "/world/torque", "/traces/best"} <= set(entities)


@pytest.mark.slow
def test_a_logger(tmp_path: Path) -> None:
    write(tmp_path, TASK, "A logger")
    [words] = commands("A logger", "run")
    farm(tmp_path, *words, "--no-record", "--pairs", "2")
    lines = [json.loads(line) for line in (tmp_path / "runs/all.jsonl").read_text().splitlines()]
    assert [(line["run"], line["generation"]) for line in lines] == [
        ("logged", 1.0),
        ("logged", 2.0),
    ]
    assert list((tmp_path / "runs/logged/tensorboard").iterdir())


@pytest.mark.slow
def test_a_task_in_a_package(tmp_path: Path) -> None:
    write(tmp_path, "A task in a package")
    (tmp_path / "swings.py").write_text(files(TASK)["pendulum.py"])
    (tmp_path / "pyproject.toml").write_text((tmp_path / "pyproject.toml").read_text())
    site = tmp_path / "site"
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        site,
        ".",
    ]
    quiet = ["--disable-pip-version-check", "--no-build-isolation"]
    subprocess.run([*install, *quiet], cwd=tmp_path, check=True, timeout=170)
    code = (
        f"import sys; sys.path.insert(0, {str(site)!r}); from farm.__main__ import main;"
        " sys.exit(main(sys.argv[1:]))"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def call(*words: str) -> str:
        command = [sys.executable, "-P", "-c", code, *words]
        environment = {"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin"}
        process = subprocess.run(
            command,
            cwd=elsewhere,
            capture_output=True,
            text=True,
            env=environment,
            timeout=120,
            check=False,
        )
        assert process.returncode == 0, process.stderr
        return process.stdout

    assert re.search(r"--task +pendulum +swings 1\.0", call("tasks"))
    [learn] = commands("A task in a package", "run")
    call(*learn, "--no-record", "--name", "packaged")
    assert summary(elsewhere, "packaged")["state"] == "finished"
