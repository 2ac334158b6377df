"""Exported policies name their numbers, with units and ranges, in both kinds of file."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from robot import robot

from farm.errors import ConfigError
from farm.policies.normalised import Normalised
from farm.sim import quantities
from farm.sim.channels import Quantity
from farm.tasks.finger_gait.observations import STATES
from learner.run.config import configure
from learner.run.setup import start
from learner.tools.export import npz, onnx
from learner.tools.export.command import listed
from learner.tools.export.interface import interface
from learner.tools.replay.loaded import LoadedPolicy

EXAMPLES = Path(__file__).parents[5] / "examples" / "tasks"
NAMED = """from cart import Cart as Base

import farm


class Cart(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="hinge" range="-90 90" limited="true"/>
        <geom size="1"/></body>
      </worldbody><actuator><position joint="hinge" kp="2" ctrlrange="-1 1"/></actuator></mujoco>'''
    observations = {observations}

    def observe(self, sim):
        return sim.qpos * 2.0

    def reward(self, sim, action):
        return sim.qpos[:, 0]
""".replace("from cart import Cart as Base\n\n", "")


def exported(task: str, **settings: Any) -> LoadedPolicy:
    problem, _ = start(configure(task, policy="linear", **settings), "r")
    return LoadedPolicy(problem, 3, np.zeros(problem.policy.size))


def cart_with(folder: Path, observations: str) -> LoadedPolicy:
    (folder / "named.py").write_text(NAMED.format(observations=observations))
    return exported(f"{folder}/named.py:Cart")


def test_a_task_without_methods_is_named_after_its_joints_and_actuators() -> None:
    of = interface(exported(f"{EXAMPLES}/cart.py:Cart"))
    names = [(each["name"], each["unit"]) for each in of["observations"]]
    assert names == [
        ("rail", "m"),
        ("hinge", "rad"),
        ("rail velocity", "m/s"),
        ("hinge velocity", "rad/s"),
    ]
    assert of["actions"] == [{"name": "rail", "unit": "", "low": -1.0, "high": 1.0}]
    assert of["controls"] == [
        {"name": "rail", "unit": "N", "low": -5.0, "high": 5.0, "moves": "rail"}
    ]
    assert [(each["name"], each["kind"], each["qpos"]) for each in of["joints"]] == [
        ("rail", "slide", 0),
        ("hinge", "hinge", 1),
    ]
    assert set(of["code"]) == {"task", "policy", "simulation"}
    assert all(len(each) == 64 for each in of["code"].values())


def test_a_task_names_its_own_observations(tmp_path: Path) -> None:
    of = interface(cart_with(tmp_path, '(farm.Quantity("twice the angle", "0.5 rad", low=-3.2),)'))
    assert of["observations"] == [
        {"name": "twice the angle", "unit": "0.5 rad", "low": -3.2, "high": None}
    ]
    assert of["controls"][0]["unit"] == "rad"
    assert of["joints"][0]["low"] == pytest.approx(-np.pi / 2)


@pytest.mark.parametrize(
    ("observations", "line"),
    [
        (
            '(farm.Quantity("a"), farm.Quantity("b"))',
            "task Cart: observations names 2 numbers; there are 1",
        ),
        (
            '("angle",)',
            r"task Cart: observations is \('angle',\); expected a tuple of farm.Quantity",
        ),
        (
            '(farm.Quantity("a", low=1.0, high=0.0),)',
            r"quantity a: 1.0 to 0.0; expected rising numbers",
        ),
        ("(farm.Quantity(3),)", r"quantity 3 \[''\]: expected a name and a unit as texts"),
    ],
)
def test_wrong_names_are_refused_before_anything_is_learnt(
    observations: str, line: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=line):
        cart_with(tmp_path, observations)


@pytest.mark.parametrize("state", STATES)
def test_the_hand_names_each_number_of_a_state(state: str) -> None:
    numbers = STATES[state].quantities((2.0, 1.0, 1.0))
    assert len(numbers) == len({each.name for each in numbers}) == STATES[state].size
    assert {each.unit for each in numbers if each.name == "index_1"} <= {"0.5 rad"}


@pytest.mark.parametrize("state", ["phase", "phase+joints+forces"])
def test_so_does_the_turning_hand(state: str) -> None:
    of = interface(exported("turning", state=state))
    assert (
        len({each["name"] for each in of["observations"]})
        == {"phase": 6, "phase+joints+forces": 17}[state]
    )


@pytest.mark.parametrize(
    ("actuator", "unit"),
    [
        ('<motor joint="h"/>', "N m"),
        ('<motor joint="h" gear="120"/>', "120 N m"),
        ('<motor joint="s"/>', "N"),
        ('<position joint="h" kp="3"/>', "rad"),
        ('<position joint="h" kp="3" kv="0.1" gear="2"/>', "0.5 rad"),
        ('<position joint="s" timeconst="0.1"/>', "m"),
        ('<velocity joint="h" kv="2"/>', "rad/s"),
        ('<intvelocity joint="h" kp="2" actrange="-1 1"/>', "rad/s"),
        ('<motor tendon="fixed"/>', ""),
        ('<motor tendon="spatial"/>', "N"),
        ('<muscle joint="h"/>', ""),
        ('<motor site="a"/>', ""),
        ('<general joint="h" gainprm="2" biastype="affine" biasprm="0 -1 0"/>', ""),
    ],
)
def test_what_a_control_of_one_is(actuator: str, unit: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><site name="b" pos="0 0 2"/><body>
            <joint name="h" range="-1 1" limited="true"/>
        <geom size="1"/><site name="a"/><body><joint name="s" type="slide"/>
        <geom size="1"/></body></body></worldbody>
        <tendon><fixed name="fixed"><joint joint="h" coef="1"/></fixed>
        <spatial name="spatial"><site site="a"/><site site="b"/></spatial></tendon>
        <actuator>{actuator}</actuator></mujoco>"""
    )
    assert [each.unit for each in quantities.controls(model)] == [unit]


def test_free_and_ball_joints_have_several_numbers() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint name='box'/><geom size='1'/></body>"
        "<body><joint type='ball'/><geom size='1'/></body></worldbody></mujoco>"
    )
    numbers = quantities.states(model)
    assert len(numbers) == model.nq + model.nv
    assert numbers[2] == Quantity("box z", "m")
    assert numbers[6].name == "box quaternion z"
    assert numbers[-1] == Quantity("joint 1 velocity about z", "rad/s")


def test_both_files_are_listed_alike_and_as_the_run_would_be(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    policy = exported(f"{robot(tmp_path / 'mine')}:Reach")
    normaliser = np.stack(
        [
            np.arange(policy.problem.spec.observation, dtype=float),
            np.ones(policy.problem.spec.observation),
        ]
    )
    policy = replace(
        policy,
        problem=replace(policy.problem, policy=Normalised(policy.problem.policy, normaliser)),
    )
    npz.write(tmp_path / "p.npz", policy)
    onnx.write(tmp_path / "p.onnx", policy)
    first, second = listed(tmp_path / "p.npz"), listed(tmp_path / "p.onnx")
    assert first[:-1] == second[:-2]
    assert first[0].endswith(
        f"after generation 3; a control step takes {policy.problem.spec.period:g} s"
    )
    assert "normaliser: mean and deviation of each observation" in first
    assert first[-1].startswith("arrays: ")
    assert second[-2:] == [
        f"takes observation (N, {policy.problem.spec.observation})",
        f"gives action (N, {policy.problem.spec.action})",
    ]
    with np.load(tmp_path / "p.npz", allow_pickle=False) as file:
        assert json.loads(file["interface"].item())["normaliser"]["mean"] == normaliser[0].tolist()


@pytest.mark.parametrize("name", ["p.npz", "p.onnx"])
def test_other_files_are_named_in_one_line(name: str, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    with pytest.raises(ConfigError, match=f"there is no file .*{name}"):
        listed(tmp_path / name)
    (tmp_path / name).write_bytes(b"something else")
    with pytest.raises(ConfigError, match=rf"{name} is no (ONNX model|.npz) of farm export"):
        listed(tmp_path / name)
    np.savez(tmp_path / "old.npz", version=2)
    with pytest.raises(
        ConfigError,
        match=r"old.npz does not name its numbers: it is no file of this release's farm",
    ):
        listed(tmp_path / "old.npz")
