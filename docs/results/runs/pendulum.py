"""A task in one file: the model, the observation of the policy, and the reward."""

import numpy as np

from farm import Task


class Pendulum(Task):
    """Swing a pendulum up and keep it there, with a motor too weak to lift it at once."""

    xml = """<mujoco>
      <option timestep="0.01"/>
      <worldbody>
        <body>
          <joint name="hinge" axis="0 1 0" damping="0.05"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.2"/>
          <geom type="sphere" pos="0 0 0.5" size="0.05" mass="0.3"/>
        </body>
      </worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1.5 1.5"/></actuator>
    </mujoco>"""
    steps, substeps = 100, 5  # control steps of a rollout; physics steps in each

    def reset(self, sim, row, rng):  # one rollout's start: it hangs; rng is None for nominal conditions
        sim.qpos[row] = np.pi + (0.0 if rng is None else rng.uniform(-0.1, 0.1))

    def observe(self, sim):  # (B, 3)
        return np.concatenate([np.sin(sim.qpos), np.cos(sim.qpos), 0.1 * sim.qvel], axis=1)

    def reward(self, sim, action):  # (B,), 1 where it is upright
        return np.cos(sim.qpos[:, 0])
