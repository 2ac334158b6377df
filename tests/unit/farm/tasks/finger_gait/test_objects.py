"""One policy for several objects: each rollout is the one with its object alone, and names that
make no sense.
"""

import mujoco
import numpy as np
import pytest
from learning import learnt

from farm import command_line, settings
from farm.errors import ConfigError
from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.env import FingerGaitEnv
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.probe import tried
from learner.run.config import configure
from learner.run.evaluation import evaluation_jobs
from learner.tools.replay.loaded import load

OBJECTS = ("bar", "bolt")
"""The second has more geometries."""


class Undrawn(FingerGait):
    """Draws its object from its seed without taking a number of the generator: the others are those
    of one object.
    """

    def which(self, rng):
        """By the generator's state."""
        return int(rng.bit_generator.state["state"]["state"] % len(self.simulated))


def new_runner(kind, names):
    task = kind(FingerGaitConfig(object=names, state="joints+tactile", motion=0.3, steps=5))
    config = FeaturesConfig(features=10)
    return Runner(
        task,
        Direct(config, task.spec(), Direct.draw(config, task.spec(), np.random.default_rng(0))),
    )


@pytest.mark.slow
def test_each_rollout_has_the_bits_of_its_object_alone():
    seeds = [None, (0,), (1,), (2,)]
    runner = new_runner(Undrawn, OBJECTS)
    theta = np.random.default_rng(1).normal(0.0, 0.1, (len(seeds), runner.policy.size))
    rollouts = runner.rollouts(theta, seeds)
    assert rollouts.which[0] == 0
    assert set(rollouts.which.tolist()) == {0, 1}
    for which, name in enumerate(OBJECTS):
        rows = np.flatnonzero(rollouts.which == which)
        alone = new_runner(FingerGait, name).rollouts(
            theta[rows], [seeds[row] for row in rows.tolist()]
        )
        for array in ("returns", "success", "terms", "actions"):
            assert getattr(rollouts, array)[rows].tobytes() == getattr(alone, array).tobytes()
        for array, values in alone.frames.items():
            assert rollouts.frames[array][rows].tobytes() == values.tobytes()


def test_one_name_is_a_text_and_several_are_flags():
    assert FingerGaitConfig(object=("bolt",)) == FingerGaitConfig(object="bolt")
    for words, expected in (
        ((), "bar"),
        (("--object", "bolt"), "bolt"),
        (("--object", "bolt", "--object", "bar"), ("bolt", "bar")),
    ):
        parsed = command_line.parse(FingerGaitConfig, words, "farm run", FingerGaitConfig())
        assert parsed.object == expected
        values = settings.to_dict(parsed)
        assert settings.from_dict(FingerGaitConfig, values, "task") == parsed
    two = FingerGaitConfig(object=("bolt", "bar"))
    assert (
        command_line.parse(FingerGaitConfig, ("--object", "thin-bar"), "farm replay", two).object
        == "thin-bar"
    )


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (
            ("bar", "bolt", "bar"),
            "object is bar, bolt, bar; expected one name, or several different ones",
        ),
        ((), "object is empty; expected one name"),
        (("bar", "spoon"), "unknown object 'spoon'; known are .*bar"),
    ],
)
def test_names_that_make_no_sense_are_one_line(names, words):
    with pytest.raises(ConfigError, match=words):
        FingerGait(FingerGaitConfig(object=names))


def test_an_environment_has_one_object():
    with pytest.raises(ConfigError, match="object is bar, bolt; an environment has one"):
        FingerGaitEnv(object=("bar", "bolt"))


LEVER = """<mujoco>{compiler}<worldbody><body name="object" pos="0.08 0.04 0.02">
    <freejoint name="object"/>
  <geom name="handle" type="box" size="0.011 0.06 0.011" euler="0 {turn} 0" mass="0.05"
    contype="2" conaffinity="1"/>
  <body name="lid"><joint name="lid" type="hinge" axis="0 1 0" range="{low} {high}"/>
  <geom name="lid" type="capsule" size="0.002 0.01" axisangle="0 0 2 {turn}" mass="0.001"/></body>
</body></worldbody></mujoco>"""


def test_angles_of_an_object_are_degrees_unless_its_file_says_radians(tmp_path):
    degrees = {"turn": 60, "low": -90, "high": 30}
    radians = {name: np.radians(angle) for name, angle in degrees.items()}
    poses = []
    for compiler, angles in (
        ("", degrees),
        ('<compiler angle="degree"/>', degrees),
        ('<compiler angle="radian"/>', radians),
    ):
        path = tmp_path / f"{len(poses)}.xml"
        path.write_text(LEVER.format(compiler=compiler, **angles))
        mj_model = mujoco.MjModel.from_xml_string(model.mjcf(model.files([str(path)], "opposed")))
        poses.append(
            [mj_model.geom("handle").quat, mj_model.geom("lid").quat, mj_model.joint("lid").range]
        )
        hand = mj_model.joint("index_1")
        assert hand.range == pytest.approx([-0.196, 1.61])
    for values in poses:
        assert values[0] == pytest.approx([np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6), 0.0])
        assert values[1] == pytest.approx([np.cos(np.pi / 6), 0.0, 0.0, np.sin(np.pi / 6)])
        assert values[2] == pytest.approx([-np.pi / 2, np.pi / 6])


def test_the_axes_of_cylinder_and_bolt_lie_across_the_fingers():
    for name, geom in (("cylinder", "cylinder"), ("bolt", "head")):
        mj_model = mujoco.MjModel.from_xml_string(model.mjcf(model.files([name], "opposed")))
        axis = np.zeros(9)
        mujoco.mju_quat2Mat(axis, mj_model.geom(geom).quat)
        assert np.abs(axis.reshape(3, 3)[:, 2]) == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


def test_an_object_that_a_grip_does_not_hold_is_named():
    task = FingerGait(FingerGaitConfig(object=("bar", "bolt"), start_grip="middle+thumb"))
    with pytest.raises(ConfigError, match="'middle.thumb' does not hold object 'bar'"):
        tried(task, 1, lambda sim: None)


@pytest.mark.slow
def test_one_policy_holds_five_objects_two_of_which_it_never_met(tmp_path):
    trained = ("bar", "thick-bar", "cylinder")
    learnt(configure("finger-gait", object=trained), tmp_path / "r", 2)
    for thing in (*trained, "thin-bar", "bolt"):
        policy = load(tmp_path / "r", object=thing)
        outcome = policy.runner.run(policy.mu, evaluation_jobs(100, 1))
        # Of 200 it is 0.91, and 1: docs/results/several-objects.md
        least = 0.8 if thing == "cylinder" else 0.95
        assert outcome.flags[:100, 0].mean() > least, thing
