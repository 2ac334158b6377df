"""A planar arm of two links follows a ball that goes round, at another pace in every rollout."""

import numpy as np

from farm import Camera, Task
from farm.elementary import cos, exp, sin


class Arm(Task):
    """One per step while the tip is at the ball."""

    xml = """<mujoco>
      <option timestep="0.005"/>
      <worldbody>
        <geom type="plane" size="0.5 0.5 0.1" pos="0 0 -0.05"/>
        <body name="ball" mocap="true" pos="0.3 0 0">
          <geom type="sphere" size="0.02" rgba="0.9 0.5 0.1 1" contype="0" conaffinity="0"/>
        </body>
        <body>
          <joint name="shoulder" axis="0 0 1" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" contype="0" conaffinity="0"/>
          <body pos="0.25 0 0">
            <joint name="elbow" axis="0 0 1" range="0 160" damping="0.1"/>
            <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.015" contype="0" conaffinity="0"/>
            <site name="tip" pos="0.25 0 0" size="0.01"/>
          </body>
        </body>
      </worldbody>
      <actuator>
        <motor joint="shoulder" ctrlrange="-1 1"/>
        <motor joint="elbow" ctrlrange="-0.5 0.5"/>
      </actuator>
    </mujoco>"""
    steps, substeps = 100, 5  # 2.5 s
    camera = Camera(lookat=(0.15, 0.0, 0.0), distance=1.3, azimuth=90.0, elevation=-65.0)

    def reset(self, sim, row, rng):
        sim.qpos[row] = [0.0, 1.0]
        # Radius [m], angle [rad] and speed [rad/s] of each rollout's circle
        circle = sim.own.setdefault("circle", np.zeros((len(sim), 3)))
        circle[row] = (
            [0.35, 0.5, 1.0] if rng is None else rng.uniform([0.25, -1.0, -1.5], [0.45, 1.0, 1.5])
        )
        sim.mocap_pos[row, 0] = self.ball(circle[row, None], 0.0)[0]

    def ball(self, circle, seconds):  # where it is, (B, 3) -> (B, 3)
        angle = circle[:, 1] + circle[:, 2] * seconds
        return np.stack(
            [circle[:, 0] * cos(angle), circle[:, 0] * sin(angle), np.zeros(len(circle))], axis=1
        )

    def act(self, sim, action):
        sim.mocap_pos[:, 0] = self.ball(sim.own["circle"], sim.t * self.period)
        return super().act(sim, action)

    def apart(self, sim):  # from tip to ball [m], (B, 2)
        first, second = sim.qpos[:, 0], sim.qpos[:, 0] + sim.qpos[:, 1]
        tip = 0.25 * np.stack([cos(first) + cos(second), sin(first) + sin(second)], axis=1)
        return sim.mocap_pos[:, 0, :2] - tip

    def observe(self, sim):
        return np.concatenate(
            [sin(sim.qpos), cos(sim.qpos), 0.2 * sim.qvel, 4.0 * self.apart(sim)], axis=1
        )

    def reward(self, sim, action):
        return exp(-((self.apart(sim) / 0.1) ** 2).sum(axis=1))
