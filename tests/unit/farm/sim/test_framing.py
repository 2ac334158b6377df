"""Whatever moves stays in the picture: swinging, travelling, thrown, and in every example."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest
from seen import inside

from farm import seeds
from farm.errors import ConfigError
from farm.sim.framing import View
from farm.sim.scene import Scene
from learner.run.config import configure
from learner.run.setup import problem

EXAMPLES = Path(__file__).parents[4] / "examples/tasks"
PENDULUM = """<mujoco><worldbody><body name="pole"><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .5" size=".02"/>
      <geom pos="0 0 .5" size=".05"/></body></worldbody></mujoco>"""
ROBOT = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body name="trunk" pos="0 0 .3">
    <freejoint/>
  <geom type="box" size=".2 .1 .05"/><body name="leg" pos=".2 0 0"><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body></body></worldbody></mujoco>"""


def scene_of(xml: str, qpos: list[float] | None = None) -> Scene:
    model = mujoco.MjModel.from_xml_string(xml)
    return Scene(model, None if qpos is None else np.array(qpos))


def swung(scene: Scene, angles: np.ndarray) -> np.ndarray:
    return scene.poses(angles[:, None])


def test_a_swing_is_in_view_and_not_followed():
    scene = scene_of(PENDULUM, [np.pi])
    way = swung(scene, np.linspace(np.pi, 0.0, 30))
    view = View(scene, None, [way])
    assert view.mover is None
    assert inside(scene, view, way).all()
    near = View(scene, None, [way[:5]])
    assert near.camera.distance < 0.8 * view.camera.distance, "a small swing is seen from nearer"


def test_before_anything_moves_whatever_the_joints_reach_is_in_view():
    scene = scene_of(PENDULUM, [np.pi])
    assert inside(scene, View(scene, None), swung(scene, np.linspace(0.0, 2.0 * np.pi, 60))).all()
    limited = scene_of(
        PENDULUM.replace("<joint ", '<joint limited="true" range="170 190" '), [np.pi]
    )
    assert View(limited, None).camera.distance < 0.8 * View(scene, None).camera.distance


def walk(scene: Scene, metres: float) -> np.ndarray:
    qpos = np.tile(scene.model.qpos0, (50, 1))
    qpos[:, 0] = np.linspace(0.0, metres, 50)
    qpos[:, 7] = np.sin(np.arange(50))
    return scene.poses(qpos)


def test_a_walker_is_followed():
    scene = scene_of(ROBOT)
    way = walk(scene, 20.0)
    view = View(scene, None, [way])
    assert view.mover is not None
    assert inside(scene, view, way).all()
    assert view.camera.distance < 4.0, "it is not seen from where all of the way is"
    shift = view.shifts(way[:, scene.bodies.index("trunk"), :3])
    assert 19.0 < shift[-1, 0] < 20.0


def test_several_rollouts_are_in_one_view():
    scene = scene_of(ROBOT)
    ways = [walk(scene, 20.0), walk(scene, -20.0), walk(scene, 0.1)]
    view = View(scene, None, ways)
    for way in ways:
        assert inside(scene, view, way).all()


def test_what_falls_for_ever_leaves_a_picture_of_what_stays():
    xml = ROBOT.replace(
        "</worldbody>", '<body name="ball"><freejoint/><geom size=".05"/></body></worldbody>'
    )
    scene = scene_of(xml)
    qpos = np.tile(scene.model.qpos0, (50, 1))
    qpos[:, 10] = -np.linspace(0.0, 500.0, 50)
    assert scene.mover is not None
    view = View(scene, None, [scene.poses(qpos)])
    shown = scene.poses(qpos)
    assert view.camera.distance < 4.0 * scene.mover.radius
    robot = [at for at, name in enumerate(scene.bodies) if name != "ball"]
    ball = scene.bodies.index("ball")
    shown[:, ball] = shown[:, robot[-1]]  # the others are in view
    assert inside(scene, view, shown).all()


def examples() -> list[str]:
    return [
        f"{path}:{name}"
        for path in sorted(EXAMPLES.glob("*.py"))
        for name in [path.stem.title().replace("_", "")]
        if f"class {name}(" in path.read_text("utf-8")
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", [*examples(), "finger-gait", "turning", "gym:Hopper-v5", "gym:Ant-v5", "gym:Reacher-v5"]
)
def test_all_that_moves_is_in_each_picture_of_an_example(task: str):
    if task.startswith("gym:"):
        pytest.importorskip("gymnasium")
    try:
        run = problem(configure(task))
    except (ConfigError, ImportError) as error:
        if importlib.util.find_spec("dm_control") and importlib.util.find_spec(
            "gymnasium_robotics"
        ):
            raise
        pytest.skip(f"another package is needed: {error}")
    runner, scene = run.runner(), run.scene
    theta = np.random.default_rng(0).normal(0.0, 0.5, (3, runner.size))
    rollouts = runner.rollouts(
        theta, [None, seeds.evaluation_start(0, 0), seeds.evaluation_start(0, 1)]
    )
    for row in range(3):
        bodies = runner.trajectory(rollouts, row).bodies
        start = rollouts.start["qpos"][row]
        mocap = rollouts.start.get("mocap")
        framed = Scene(scene.model, start, None if mocap is None else mocap[row])
        assert inside(framed, View(framed, run.task.camera, [bodies]), bodies).all()
