"""A fingerprint of this machine's numbers: a few rollouts, compared bit for bit.

Processors, compilers and library versions may round differently. Machines with the same digest give
the same numbers for the same jobs; the rollouts go through contacts, constraints, actuators,
changed model fields, random starts, and every built-in policy's arithmetic.
"""

import hashlib
from collections.abc import Mapping
from functools import cache
from typing import Any, Final

import numpy as np

from farm import plugins, seeds
from farm.arrays import FloatArray
from farm.policies.base import Policy
from farm.runner import Runner
from farm.sim.sim import Sim
from farm.tasks.base import Task, TaskConfig
from farm.tasks.probe import specification

_FEATURES: Final = {"features": 300}
_SETTINGS: Final[Mapping[str, Mapping[str, Any]]] = {
    "direct": _FEATURES,
    "projected": _FEATURES,
    "cosine": _FEATURES,
    "mlp": {"layers": (16, 8)},
}
"""Settings of policies whose defaults would be too large here."""


class PushedBall(Task):
    """Two fingers that push a ball."""

    xml = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" condim="4"/>
    <body pos="0 0 0.06"><freejoint/>
      <geom type="ellipsoid" size="0.05 0.04 0.06" condim="4" mass="0.1"/></body>
    <body pos="0.12 0 0.05" euler="0 10 5">
      <joint name="a" axis="0 1 0" range="-60 60" damping="0.1"/>
      <geom type="capsule" size="0.01 0.05"/>
      <body pos="0 0 0.05"><joint name="b" axis="1 0 0" damping="0.1"/>
      <geom type="box" size="0.01 0.02 0.03"/></body>
    </body>
  </worldbody>
  <actuator><position joint="a" kp="3"/><position joint="b" kp="2"/></actuator>
  <sensor><framequat objtype="xbody" objname="world"/></sensor>
</mujoco>"""
    steps, substeps = 6, 10

    def reset(self, sim: Sim, row: int, rng: np.random.Generator | None) -> None:
        """Push the ball, and change its mass."""
        sim.qvel[row, :6] = (-0.8, 0.1, 0.0, 1.0, 2.0, 3.0)
        if rng is not None:
            sim.qvel[row, :3] += rng.normal(0.0, 0.2, 3)
            sim.expand("body_mass")[row, 1] *= rng.uniform(0.8, 1.2)
            sim.expand("geom_friction")[row] *= rng.uniform(0.8, 1.2)

    def reward(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Depends on the whole state, the constraint forces and the action."""
        squares = (sim.qpos * sim.qpos).sum(axis=1) + (
            sim.qfrc_constraint * sim.qfrc_constraint
        ).sum(axis=1)
        reward: FloatArray = np.sqrt(squares) - 0.1 * (action * action).sum(axis=1)
        return reward


@cache
def digest() -> str:
    """SHA-256 of the rollouts' results; takes less than a tenth of a second, once per process."""
    sha256 = hashlib.sha256()
    task = PushedBall(TaskConfig())
    spec, runner = specification(task), None
    for name in plugins.BUILT_IN["policies"]:
        kind: Any = plugins.find("policies", name).target
        config = kind.Config(**_SETTINGS.get(name, {}))
        constants = {
            key: _numbers(values.shape)
            for key, values in kind.draw(config, spec, seeds.features(0)).items()
        }
        if kind.standardised:
            constants |= {
                "origin": _numbers((spec.observation,)),
                "spread": 1.5 + _numbers((spec.observation,)),
            }
        policy: Policy = kind(config, spec, constants)
        runner = runner or Runner(task, policy)
        runner.policy = policy
        rollouts = runner.rollouts(
            0.3 * _numbers((2, policy.size)), [None, seeds.evaluation_start(0, 0)]
        )
        for values in (rollouts.returns, rollouts.actions, rollouts.frames["qpos"]):
            sha256.update(np.ascontiguousarray(values).tobytes())
    return sha256.hexdigest()


def _numbers(shape: tuple[int, ...]) -> FloatArray:
    """Values spread over (-1, 1), computed in integers so that every machine gets the same ones."""
    count = int(np.prod(shape))
    whole = (np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(
        12
    )
    return (whole.astype(np.float64) / 2.0**51 - 1.0).reshape(shape)
