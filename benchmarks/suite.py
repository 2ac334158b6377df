"""Tasks on other people's models, for own_tasks.py. Needs dm_control and gymnasium.

The models are files of the DeepMind Control Suite (Tassa 2018, arXiv:1801.00690) and of Gymnasium
(Towers 2024, arXiv:2407.17032). Starts, observations and rewards are written here, as a user would
who has a model and wants something of it: observations of about 1, smooth rewards of about 1 per
control step at best, 100 to 250 steps.
"""

import importlib.util
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from farm import Task
from farm.elementary import cos, exp, sin


@cache
def _mjcf(name: str) -> str:
    """One of the suite's models, with its includes."""
    package = importlib.util.find_spec("dm_control")
    if package is None or package.origin is None:
        raise ImportError("dm_control is not installed: pip install dm_control")
    spec = mujoco.MjSpec.from_file(str(Path(package.origin).parent / "suite" / f"{name}.xml"))
    spec.compile()
    return spec.to_xml()


class Suite(Task):
    """A model of the suite."""

    name = ""

    def files(self):
        return {"model.xml": _mjcf(self.name)}


class Swingup(Suite):
    """A cart swings a pole up and keeps it there."""

    name = "cartpole"
    steps, substeps = 200, 2

    def reset(self, sim, row, rng):
        sim.qpos[row] = [0.0, np.pi]
        if rng is not None:
            sim.qpos[row] += rng.uniform(-0.3, 0.3, 2)

    def observe(self, sim):
        angle = sim.qpos[:, 1:]
        return np.concatenate([sim.qpos[:, :1], sin(angle), cos(angle), sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.5 * (1.0 + cos(sim.qpos[:, 1])) * (1.0 - 0.2 * sim.qpos[:, 0] ** 2)


class Cheetah(Suite):
    """A planar cheetah runs."""

    name = "cheetah"
    steps, substeps = 250, 2

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 3:] += rng.uniform(-0.1, 0.1, 6)
            sim.qpos[row, 2] += rng.uniform(-0.1, 0.1)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 1:], sim.qvel], axis=1)

    def reward(self, sim, action):
        return np.clip(sim.qvel[:, 0] / 10.0, -1.0, 1.0)


class Catch(Suite):
    """A cup catches a ball that hangs on a string."""

    name = "ball_in_cup"
    steps, substeps = 150, 10

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 2] = rng.uniform(-0.1, 0.1)

    def observe(self, sim):
        return np.concatenate([sim.qpos, sim.qvel], axis=1)

    def reward(self, sim, action):
        apart = sim.qpos[:, 2:] + [0.0, 0.2] - sim.qpos[:, :2] - [0.0, 0.55]
        return exp(-((apart / 0.1) ** 2).sum(axis=1))


class Walker(Suite):
    """A planar biped walks at 1 m/s."""

    name = "walker"
    steps, substeps = 200, 10
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 3:] += rng.uniform(-0.1, 0.1, 6)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, [0, *range(2, 9)]], sim.qvel], axis=1)

    def reward(self, sim, action):
        upright = 0.5 * (1.0 + cos(sim.qpos[:, 2]))
        return upright * (0.5 + 0.5 * np.clip(sim.qvel[:, 1], -1.0, 1.0))

    def ended(self, sim):
        return sim.qpos[:, 0] < -0.5  # the torso is half a metre lower


class Spin(Suite):
    """A finger spins a body by hitting it."""

    name = "finger"
    steps, substeps = 200, 2

    def reset(self, sim, row, rng):
        sim.qpos[row] = [-1.0, 0.0, 0.0]
        if rng is not None:
            sim.qpos[row] = rng.uniform([-1.5, -1.0, -3.0], [-0.5, 1.0, 3.0])

    def observe(self, sim):
        angle = sim.qpos[:, 2:]
        return np.concatenate([sim.qpos[:, :2], sin(angle), cos(angle), 0.1 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return np.clip(np.abs(sim.qvel[:, 2]) / 15.0, 0.0, 1.0)


class Acrobot(Suite):
    """Two links, driven at the elbow only, swing up."""

    name = "acrobot"
    steps, substeps = 200, 4

    def reset(self, sim, row, rng):
        sim.qpos[row] = [np.pi, 0.0] if rng is None else [np.pi, 0.0] + rng.uniform(-0.3, 0.3, 2)

    def observe(self, sim):
        return np.concatenate([sin(sim.qpos), cos(sim.qpos), 0.2 * sim.qvel], axis=1)

    def reward(self, sim, action):
        first = sim.qpos[:, 0]
        height = cos(first) + cos(first + sim.qpos[:, 1])  # of the tip above the shoulder [m]
        return 0.25 * (height + 2.0)


class Reach(Suite):
    """An arm of two links reaches a point, another one in every rollout."""

    name = "reacher"
    steps, substeps = 100, 1

    def reset(self, sim, row, rng):
        goal = sim.own.setdefault("goal", np.zeros((len(sim), 2)))
        polar = (0.5, 0.15) if rng is None else rng.uniform((-np.pi, 0.05), (np.pi, 0.2))
        goal[row] = polar[1] * cos(np.array([polar[0], polar[0] - 0.5 * np.pi]))

    def _apart(self, sim):
        first = sim.qpos[:, 0]
        second = first + sim.qpos[:, 1]
        tip = 0.12 * np.stack([cos(first) + cos(second), sin(first) + sin(second)], axis=1)
        return sim.own["goal"] - tip

    def observe(self, sim):
        angles = [sin(sim.qpos), cos(sim.qpos)]
        return np.concatenate([*angles, 0.1 * sim.qvel, 5.0 * self._apart(sim)], axis=1)

    def reward(self, sim, action):
        return exp(-((self._apart(sim) / 0.05) ** 2).sum(axis=1))


class Point(Suite):
    """A mass in the plane goes to the middle, wherever it begins."""

    name = "point_mass"
    steps, substeps = 100, 1

    def reset(self, sim, row, rng):
        sim.qpos[row] = [0.2, -0.1] if rng is None else rng.uniform(-0.25, 0.25, 2)

    def observe(self, sim):
        return np.concatenate([sim.qpos, sim.qvel], axis=1)

    def reward(self, sim, action):
        return exp(-((sim.qpos / 0.05) ** 2).sum(axis=1))


class Upright(Suite):
    """A pendulum whose motor cannot lift it at once stands upright."""

    name = "pendulum"
    steps, substeps = 250, 1

    def reset(self, sim, row, rng):
        sim.qpos[row] = np.pi if rng is None else np.pi + rng.uniform(-1.0, 1.0)

    def observe(self, sim):
        return np.concatenate([sin(sim.qpos), cos(sim.qpos), 0.2 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.5 * (1.0 + cos(sim.qpos[:, 0]))


class Fish(Suite):
    """A fish in water turns its back up."""

    name = "fish"
    steps, substeps = 150, 10

    def reset(self, sim, row, rng):
        turn = np.array([0.0, 1.0, 0.0, 0.0]) if rng is None else rng.standard_normal(4)
        sim.qpos[row, 3:7] = turn / np.sqrt((turn**2).sum())

    def _up(self, sim):
        return sim.body("torso").xmat.reshape(len(sim), 9)[:, 6:]

    def observe(self, sim):
        return np.concatenate([self._up(sim), sim.qpos[:, 7:], sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.5 * (1.0 + self._up(sim)[:, 2])


class Hop(Suite):
    """A planar hopper with a foot hops forward."""

    name = "hopper"
    steps, substeps = 200, 4
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 3:] += rng.uniform(-0.1, 0.1, 4)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 1:], sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.2 + 0.8 * np.clip(sim.qvel[:, 0] / 2.0, -0.25, 1.0)

    def ended(self, sim):
        return (sim.body("torso").xpos[:, 2] < 0.5) | (abs(sim.qpos[:, 2]) > 1.2)


class Asset(Task):
    """A model of Gymnasium."""

    package, root = "gymnasium", "envs/mujoco/assets"


class Swim(Asset):
    """A chain of three links swims forward."""

    xml = """<mujoco>
      <include file="swimmer.xml"/>
      <option integrator="implicitfast"/>
      <sensor><subtreelinvel name="velocity" body="torso"/></sensor>
    </mujoco>"""
    steps, substeps = 150, 4

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 2:] = rng.uniform(-0.2, 0.2, 3)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 2:], sim.qvel], axis=1)

    def reward(self, sim, action):
        return sim.sensor("velocity").data[:, 0] / 0.4  # of all three together


class Balance(Asset):
    """A cart balances two poles, one on top of the other."""

    xml = "inverted_double_pendulum.xml"
    steps, substeps = 100, 5
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row] = rng.uniform(-0.1, 0.1, 3)

    def observe(self, sim):
        return np.concatenate([2.0 * sim.qpos, 0.3 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return sim.site("tip").xpos[:, 2] / 1.2 - 0.2 * sim.qpos[:, 0] ** 2

    def ended(self, sim):
        return sim.site("tip").xpos[:, 2] < 1.0


class Push(Asset):
    """An arm of seven joints pushes a puck to the middle, from another place in every rollout."""

    xml = "pusher_v5.xml"
    steps, substeps = 100, 5

    def reset(self, sim, row, rng):
        sim.qpos[row, 7:9] = (-0.25, 0.0)
        if rng is not None:
            sim.qpos[row, 7:9] = rng.uniform((-0.3, -0.1), (-0.15, 0.1))

    def _apart(self, sim):
        return sim.body("object").xpos - sim.body("tips_arm").xpos

    def observe(self, sim):
        arm = [sim.qpos[:, :7], 0.3 * sim.qvel[:, :7], 2.0 * self._apart(sim)]
        return np.concatenate([*arm, 4.0 * sim.qpos[:, 7:9], sim.qvel[:, 7:9]], axis=1)

    def reward(self, sim, action):
        touching = exp(-((self._apart(sim) / 0.3) ** 2).sum(axis=1))
        return 0.3 * touching + 0.7 * exp(-((sim.qpos[:, 7:9] / 0.15) ** 2).sum(axis=1))


class Ant(Asset):
    """A robot with four legs walks at 1 m/s."""

    xml = """<mujoco>
      <include file="ant.xml"/>
      <option integrator="implicitfast"/>
    </mujoco>"""
    steps, substeps = 100, 5
    ending = "fell"

    def reset(self, sim, row, rng):
        sim.qpos[row, 2] = 0.55
        sim.qpos[row, 7:] = [0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]
        if rng is not None:
            sim.qpos[row, 7:] += rng.uniform(-0.1, 0.1, 8)

    def _up(self, sim):
        return sim.body("torso").xmat.reshape(len(sim), 9)[:, 8]

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 2:], 0.3 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.2 + 0.8 * np.clip(sim.qvel[:, 0], -0.25, 1.0)

    def ended(self, sim):
        return (sim.qpos[:, 2] < 0.2) | (self._up(sim) < 0.2)


class Stand(Asset):
    """A humanoid stays on its feet, and where it is."""

    xml = """<mujoco>
      <include file="humanoid.xml"/>
      <option integrator="implicitfast"/>
    </mujoco>"""
    steps, substeps = 150, 5
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 7:] += rng.uniform(-0.1, 0.1, 17)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 2:], 0.1 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.5 + 0.5 * exp(-(sim.qvel[:, :2] ** 2).sum(axis=1))

    def ended(self, sim):
        return sim.qpos[:, 2] < 1.0


class Stride(Asset):
    """A planar biped with feet walks at 1 m/s."""

    xml = """<mujoco>
      <include file="walker2d_v5.xml"/>
      <option integrator="implicitfast"/>
    </mujoco>"""
    steps, substeps = 150, 8
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row, 3:] = rng.uniform(-0.1, 0.1, 6)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 1:], 0.2 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.2 + 0.8 * np.clip(sim.qvel[:, 0], -0.25, 1.0)

    def ended(self, sim):
        return (sim.qpos[:, 1] < 0.8) | (np.abs(sim.qpos[:, 2]) > 1.0)


class Turn(Suite):
    """A finger turns a body to an angle, another one in every rollout."""

    name = "finger"
    steps, substeps = 200, 2

    def reset(self, sim, row, rng):
        goal = sim.own.setdefault("goal", np.zeros(len(sim)))
        sim.qpos[row], goal[row] = [-1.0, 0.0, 0.0], 1.5
        if rng is not None:
            sim.qpos[row] = rng.uniform([-1.5, -1.0, -3.0], [-0.5, 1.0, 3.0])
            goal[row] = rng.uniform(-3.0, 3.0)

    def _off(self, sim):
        return sim.qpos[:, 2] - sim.own["goal"]

    def observe(self, sim):
        off = self._off(sim)[:, None]
        return np.concatenate([sim.qpos[:, :2], sin(off), cos(off), 0.1 * sim.qvel], axis=1)

    def reward(self, sim, action):
        return 0.5 * (1.0 + cos(self._off(sim)))
