"""A cart on a rail balances a pole of random mass."""

import numpy as np

from farm import Task


class Cart(Task):
    """One per step while the pole stands and the cart is on its rail."""

    xml = """<mujoco>
      <option timestep="0.01"/>
      <worldbody>
        <geom type="capsule" fromto="-2 0 0 2 0 0" size="0.02" contype="0" conaffinity="0"/>
        <body name="cart">
          <joint name="rail" type="slide" axis="1 0 0" damping="0.1"/>
          <geom type="box" size="0.1 0.08 0.05" mass="1" contype="0" conaffinity="0"/>
          <body name="pole">
            <joint name="hinge" axis="0 1 0" damping="0.002"/>
            <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.02" mass="0.1"
              contype="0" conaffinity="0"/>
          </body>
        </body>
      </worldbody>
      <actuator><motor joint="rail" ctrlrange="-5 5"/></actuator>
    </mujoco>"""
    steps, substeps = 250, 2  # 5 s
    ending = "fell"

    def reset(self, sim, row, rng):
        sim.qpos[row] = [0.0, 0.05] if rng is None else rng.uniform([-0.5, -0.1], [0.5, 0.1])
        if rng is not None:
            sim.expand("body_mass")[row, 2] *= rng.uniform(0.5, 2.0)

    def reward(self, sim, action):
        return 1.0 - 0.1 * sim.qpos[:, 0] ** 2 - 0.01 * action[:, 0] ** 2

    def ended(self, sim):
        return (np.abs(sim.qpos[:, 1]) > 0.5) | (np.abs(sim.qpos[:, 0]) > 2.0)
