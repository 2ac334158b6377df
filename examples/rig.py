"""A pendulum to balance: a task for simulating workers and for the rig of robot_worker.py."""

import numpy as np

from farm import Task


class Rig(Task):
    """Balance a pendulum that starts 0.3 rad from upright.

    Its motor is too weak to swing it up from below.
    """

    xml = """<mujoco>
      <option timestep="0.005"/>
      <worldbody>
        <body>
          <joint name="hinge" axis="0 1 0" damping="0.05"/>
          <inertial pos="0 0 0.5" mass="0.5" diaginertia="0.001 0.001 0.001"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02"/>
        </body>
      </worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1.5 1.5"/></actuator>
    </mujoco>"""
    steps, substeps = 50, 10  # 2.5 s
    presets = {
        "default": {
            "policy": "linear",
            "algorithm": "snes",
            "initial_sigma": 2.0,
            "generations": 25,
        }
    }

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.3 + (0.0 if rng is None else rng.uniform(-0.1, 0.1))

    def observe(self, sim):  # (B, 3)
        return np.concatenate([np.sin(sim.qpos), np.cos(sim.qpos), 0.1 * sim.qvel], axis=1)

    def reward(self, sim, action):  # (B,), 1 where it is upright
        return np.cos(sim.qpos[:, 0])
