"""A gripper of primitives lifts a box of unknown weight, with nine touch sensors on each pad."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import farm

PAD = "".join(
    f'<site name="{{side}}{3 * row + column}" type="box" size="0.005 0.007 0.007" '
    f'pos="{{inwards}} {0.014 * (column - 1)} {0.014 * (1 - row)}"/>'
    for row in range(3)
    for column in range(3)
)
SENSORS = "".join(
    f'<touch name="{side}{i}" site="{side}{i}"/>' for side in ("left", "right") for i in range(9)
)
PADS = {side: tuple(f"{side}{i}" for i in range(9)) for side in ("left", "right")}


class Gripper(farm.Task):
    """Lift the box by 10 cm without pressing hard: 3 N per pad is more than enough."""

    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TouchConfig):
        """The gripper's settings."""

        heaviest: float = farm.setting(0.12, above=0.04, most=1.0)
        """Largest weight of the box [kg]; the smallest is 0.04."""

    xml = f"""<mujoco>
      <option timestep="0.004" integrator="implicitfast" cone="elliptic" impratio="10"/>
      <default>
        <geom friction="1 0.01 0.001"/>
        <default class="pad">
          <joint type="slide" axis="1 0 0" damping="5"/>
          <geom type="box" size="0.005 0.02 0.02" mass="0.05"/>
        </default>
      </default>
      <worldbody>
        <light pos="0 -1 1"/>
        <geom name="ground" type="plane" size="0.5 0.5 0.1"/>
        <body name="box" pos="0 0 0.02">
          <freejoint/>
          <geom type="box" size="0.02 0.02 0.02" mass="0.08" rgba="0.9 0.5 0.1 1"/>
        </body>
        <body name="wrist" pos="0 0 0.022" gravcomp="1">
          <joint name="lift" type="slide" axis="0 0 1" damping="20"/>
          <geom type="box" size="0.06 0.01 0.01" pos="0 0 0.07" mass="0.2"
            contype="0" conaffinity="0"/>
          <body name="left" pos="-0.05 0 0" childclass="pad" gravcomp="1">
            <joint name="left" range="0 0.045" limited="true"/>
            <geom/>
            {PAD.format(side="left", inwards=0.005)}
          </body>
          <body name="right" pos="0.05 0 0" childclass="pad" gravcomp="1">
            <joint name="right" range="-0.045 0" limited="true"/>
            <geom/>
            {PAD.format(side="right", inwards=-0.005)}
          </body>
        </body>
      </worldbody>
      <actuator>
        <position joint="lift" kp="200" kv="20" ctrlrange="0 0.12"/>
        <motor tendon="close" ctrlrange="0 8"/>
      </actuator>
      <tendon>
        <fixed name="close">
          <joint joint="left" coef="1"/>
          <joint joint="right" coef="-1"/>
        </fixed>
      </tendon>
      <equality><joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/></equality>
      <sensor>{SENSORS}</sensor>
    </mujoco>"""
    steps, substeps = 60, 10  # 2.4 s

    @cached_property
    def touch(self):
        return farm.Touch(self.model, PADS, self.config, self.steps, shape=(3, 3), top=1.0)

    @cached_property
    def channels(self):
        return (self.touch.channel,)

    def reset(self, sim, row, rng):
        self.touch.reset(sim, row, rng)
        if rng is not None:
            weight = rng.uniform(0.04, self.config.heaviest)
            body = self.model.body("box").id
            sim.expand("body_mass")[row, body] = weight
            sim.expand("body_inertia")[row, body] *= weight / 0.08

    def observe(self, sim):  # joints of the gripper, and touch; never where the box is
        return np.concatenate(
            [20.0 * sim.qpos[:, 7:], sim.qvel[:, 6:], self.touch.felt(sim)], axis=1
        )

    def measure(self, sim):
        return {"touch": self.touch.true(sim)}

    def reward(self, sim, action):
        force = self.touch.true(sim).sum(axis=(2, 3)).max(axis=1)
        high = np.clip(sim.qpos[:, 2] - 0.02, 0.0, 0.1) / 0.1
        return {"high": high, "force": -0.1 * np.clip(force - 3.0, 0.0, 5.0)}
