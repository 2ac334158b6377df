"""Environments of Gymnasium as tasks: which are taken, how large they are, what there is to draw."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from farm import gym, tasks
from farm.errors import ConfigError
from farm.sim.scene import Scene
from farm.tasks.finger_gait.task import TaskConfig


def test_sizes_are_the_environments():
    sizes = tasks.sizes(TaskConfig(task="gym:Pusher-v5"))
    assert (sizes.observation, sizes.steps, sizes.period, sizes.terms) == (23, 100, 0.05, ("reward",))
    assert (sizes.lower.tolist(), sizes.upper.tolist()) == ([-2.0] * 7, [2.0] * 7)
    assert not sizes.success
    assert sizes.shapes(12) == {
        "bodies": (12, 7), "joints": (0,), "targets": (7,), "images": (0, 18), "points": (0, 3), "terms": (1,),
    }  # fmt: skip


def test_sizes_of_the_hand_are_as_ever():
    sizes = tasks.sizes(TaskConfig(state="tactile", steps=4))
    assert (sizes.observation, len(sizes.lower), sizes.steps, sizes.success, sizes.release) == (54, 8, 4, True, "")
    assert sizes.period == pytest.approx(0.1)
    assert sizes.shapes(2) == {
        "bodies": (2, 7), "joints": (8,), "targets": (8,), "images": (3, 18), "points": (3, 3), "terms": (5,),
    }  # fmt: skip


@pytest.mark.parametrize(("steps", "expected"), [(0, 1000), (7, 7), (1000, 1000)])
def test_steps_may_shorten_a_rollout(steps, expected):
    assert tasks.sizes(TaskConfig(task="gym:Swimmer-v5", steps=steps)).steps == expected


def test_steps_lengthen_no_rollout():
    with pytest.raises(ConfigError, match="--steps 1001: task gym:Swimmer-v5 ends after 1000"):
        tasks.sizes(TaskConfig(task="gym:Swimmer-v5", steps=1001))


@pytest.mark.parametrize(
    ("task", "line"),
    [
        ("gym:Swimmr-v5", "Did you mean: `Swimmer`"),
        ("gym:Swimmer-v99", "`v5`"),
        ("gym:Pendulum-v1", "not an environment of MuJoCo"),
        ("gym:CartPole-v1", "not an environment of MuJoCo"),
        ("gym:Pusher-v2", "moved"),
    ],
)
def test_what_cannot_be_learnt_is_one_line(task, line):
    with pytest.raises(ConfigError, match=line) as said:
        gym.make(TaskConfig(task=task))
    assert str(said.value).startswith(f"task {task}: ")
    assert "\n" not in str(said.value)


@pytest.mark.parametrize(
    "name", ["os:Swimmer-v5", ":Swimmer-v5", "a:b:Swimmer-v5", "Swimmer", "Swimmer-v", "", "a/b/c-v1", "é-v1", "x-v1\n"]
)
def test_names_that_are_none_are_refused(name):
    with pytest.raises(ConfigError, match="expected gym:NAME-vN"):
        TaskConfig(task=f"gym:{name}")


def test_settings_of_the_hand_are_refused():
    for setting in ({"object": "ball"}, {"state": "tactile"}, {"joints_scale": 2.0}):
        with pytest.raises(ConfigError, match=f"--{next(iter(setting)).replace('_', '-')} is a setting of finger-gait"):
            TaskConfig(task="gym:Swimmer-v5", **setting)
    assert TaskConfig(task="gym:Swimmer-v5", gamma=1.0, perturb=True, steps=2).steps == 2


def test_without_gymnasium_it_says_what_to_install():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from farm.__main__ import main\n"
        "sys.exit(main(['run', '--task', 'gym:Swimmer-v5', '--no-record']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    line = "farm: task gym:Swimmer-v5 needs gymnasium: pip install 'rolloutfarm[gym]'\n"
    assert (ended.returncode, ended.stderr) == (2, line)


@pytest.mark.parametrize("name", ["Ant-v5", "Humanoid-v5", "Pusher-v5", "HalfCheetah-v5", "Reacher-v5"])
def test_a_scene_has_names_of_its_own_for_everything(name):
    scene = tasks.scene(TaskConfig(task=f"gym:{name}"))
    geometries = scene.geometries()
    assert len(geometries) == scene.model.ngeom
    assert len({geometry.name for geometry in geometries}) == len(geometries)
    assert len(set(scene.bodies)) == len(scene.bodies)
    assert {geometry.body for geometry in geometries} == set(scene.bodies)
    poses = scene.poses(scene.model.qpos0[None])
    assert poses.shape == (1, len(scene.bodies), 7)
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0)


def test_meshes_are_left_out_and_odd_names_are_mended():
    scene = Scene(
        mujoco.MjModel.from_xml_string(
            """<mujoco><asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
            <geom type="plane" size="0 0 1"/><body name="an odd/name"><freejoint/><geom name="e e" type="ellipsoid"
            size=".1 .2 .3"/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
        )
    )
    shapes = {(g.name, g.body): g.shape for g in scene.geometries()}
    assert shapes == {("geom_0", "world"): "plane", ("e_e", "an_odd_name"): "ellipsoid"}
    assert scene.fixed == {"world"}
