"""A pole on a cart with something of everything, a runner for it, and rollouts compared to the last
bit.
"""

from dataclasses import dataclass, fields

import numpy as np

from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner
from farm.settings import setting
from farm.tasks.base import Channel, Task, TaskConfig
from farm.tasks.probe import specification
from farm.tasks.rollouts import Rollouts

XML = """<mujoco><option timestep="0.01"/><worldbody>
  <body pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
  <geom name="cart" size="0.1" mass="1"/>
  <body><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02" mass="0.1"/></body>
  </body></worldbody><actuator><motor joint="slide" ctrlrange="-3 5"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor></mujoco>"""


class Pole(Task):
    """A pole on a cart, with something of everything."""

    @dataclass(frozen=True, kw_only=True)
    class Config(TaskConfig):
        """Its own settings."""

        width: float = setting(0.6, above=0.0)
        """Angle at which it has fallen [rad]."""

    xml = XML
    steps, substeps = 12, 4
    channels = (Channel(name="angle", kind="scalars", shape=(1,), unit="rad", trace=True),)

    def reset(self, sim, row, rng):
        """Lean it, and load it with a mass of its own."""
        sim.qpos[row, 1] = 0.05
        if rng is not None:
            sim.qpos[row, 1] = rng.uniform(-0.4, 0.4)
            sim.expand("body_mass")[row, 2] *= rng.uniform(0.5, 2.0)

    def prepare(self, sim, rngs):
        """Draw a goal that is remembered."""
        super().prepare(sim, rngs)
        sim.own["goal"] = np.array([0.0 if rng is None else rng.uniform() for rng in rngs])

    def observe(self, sim):
        """Angle, by the sensor, and how far the goal is."""
        return np.concatenate(
            [sim.sensordata, sim.qvel, (sim.qpos[:, 0] - sim.own["goal"])[:, None]], axis=1
        )

    def reward(self, sim, action):
        """Upright, near the goal, lazy."""
        return {
            "upright": np.cos(sim.qpos[:, 1]),
            "near": -np.abs(sim.qpos[:, 0] - sim.own["goal"]),
        }

    def ended(self, sim):
        """It fell."""
        return np.abs(sim.qpos[:, 1]) > self.config.width

    def success(self, sim):
        """It stands at the end."""
        return np.abs(sim.qpos[:, 1]) < 0.3

    def measure(self, sim):
        """The angle."""
        return {"angle": sim.sensordata}


def new_runner(kind: type[Task] = Pole, **settings) -> Runner:
    task = kind(kind.Config(**settings))
    spec, config = specification(task), FeaturesConfig(features=10)
    return Runner(task, Direct(config, spec, Direct.draw(config, spec, np.random.default_rng(0))))


def thetas(runner: Runner, count: int, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(1).normal(0.0, scale, (count, runner.policy.size))


def arrays(rollouts: Rollouts) -> dict[str, np.ndarray]:
    out = {}
    for each in fields(rollouts):
        value = getattr(rollouts, each.name)
        out |= (
            {f"{each.name} {k}": v for k, v in value.items()}
            if isinstance(value, dict)
            else {each.name: value}
        )
    return out


def same(one: Rollouts, row: int, other: Rollouts, at: int) -> None:
    for name, values in arrays(one).items():
        assert values[row].tobytes() == arrays(other)[name][at].tobytes(), name
