"""A planar hopper runs forward on one leg, with random weight, on random ground."""

import numpy as np

from farm import Task


class Hopper(Task):
    """Forward speed, as long as the body stays up."""

    xml = """<mujoco>
      <option timestep="0.004"/>
      <default>
        <joint type="hinge" axis="0 -1 0" damping="1" armature="0.5"/>
        <geom density="900" friction="1.2 0.1 0.1"/>
        <motor ctrlrange="-1 1"/>
      </default>
      <worldbody>
        <geom name="ground" type="plane" size="40 2 0.1"/>
        <body name="body" pos="0 0 1.15">
          <joint name="x" type="slide" axis="1 0 0" damping="0" armature="0"/>
          <joint name="z" type="slide" axis="0 0 1" damping="0" armature="0"/>
          <joint name="pitch" damping="0" armature="0"/>
          <geom type="capsule" fromto="0 0 0.35 0 0 0" size="0.05"/>
          <body pos="0 0 0">
            <joint name="hip" range="-100 20" limited="true"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.45" size="0.045"/>
            <body pos="0 0 -0.45">
              <joint name="knee" range="-120 0" limited="true"/>
              <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.04"/>
              <body pos="0 0 -0.5">
                <joint name="ankle" range="-45 45" limited="true"/>
                <geom name="foot" type="capsule" fromto="-0.1 0 -0.1 0.2 0 -0.1" size="0.05"/>
              </body>
            </body>
          </body>
        </body>
      </worldbody>
      <actuator>
        <motor joint="hip" gear="120"/>
        <motor joint="knee" gear="150"/>
        <motor joint="ankle" gear="80"/>
      </actuator>
    </mujoco>"""
    steps, substeps = 250, 4  # 4 s
    ending = "fell"

    def reset(self, sim, row, rng):
        if rng is not None:
            sim.qpos[row] += rng.uniform(-0.02, 0.02, 6)
            sim.expand("body_mass")[row] *= rng.uniform(0.8, 1.2)
            sim.expand("geom_friction")[row] *= rng.uniform(0.8, 1.2)

    def observe(self, sim):
        return np.concatenate([sim.qpos[:, 1:], np.clip(sim.qvel, -10.0, 10.0)], axis=1)

    def reward(self, sim, action):
        return {
            "forward": sim.qvel[:, 0],
            "up": np.ones(len(sim)),
            "effort": -0.001 * (action**2).sum(axis=1),
        }

    def ended(self, sim):
        return (sim.qpos[:, 1] < -0.4) | (np.abs(sim.qpos[:, 2]) > 0.5)
