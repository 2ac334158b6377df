"""A LEAP hand turns a can in its palm, clockwise, on and on: a rhythm of its 16 joints, learnt from
nothing, and what a linear policy adds to it by where the can is.

    pip install --no-deps playground     # the model: MuJoCo Playground's, Apache 2.0
    farm run --task leap.py:Turn --policy linear --algorithm snes --initial-sigma 0.5 -g 60

The policy sees a clock of 1 Hz and the can's place in the palm, and moves each joint's target by at
most 0.6 rad around a half closed hand, 20 times per second.
"""

import re

import numpy as np

import farm

# [rad] index, middle and ring finger, then thumb: the package's own tasks begin so
POSE = [0.8, 0.0, 0.8, 0.8] * 3 + [0.8, 0.8, 0.8, 0.0]
RADIUS, HALF = 0.035, 0.03  # of the can, and half its height [m]
PLACE = np.array([0.095, 0.0])  # of the can in the palm [m]


class Turn(farm.Task):
    """Turn the can about the vertical; its place, mass and friction are drawn for each rollout."""

    package = "mujoco_playground"
    root = "_src/manipulation/leap_hand/xmls"
    xml = "leap_rh_mjx.xml"
    steps, substeps = 200, 5  # 10 s at 20 Hz
    ending = "lost"
    actions = farm.Clock(1.0, of=farm.Offsets(POSE, 0.6))
    camera = farm.Camera(lookat=(0.1, 0.0, 0.01), distance=0.36, azimuth=60.0, elevation=-60.0)
    measures = (farm.Measure(name="turned", low=-100.0, high=100.0, unit="rad"),)

    def files(self):
        """The package's hand, of boxes: the meshes that it names for pictures are not in there."""
        text = (self.model_folder / self.root / self.xml).read_text("utf-8")
        text = re.sub("<mesh .*?/>", "", text)
        text = re.sub('<geom [^>]*?class="visual"[^>]*?/>', "", text)
        return {self.xml: text}

    def mjcf(self):
        """The hand, palm up and level, and in it a can, as slippery as the package's own cube."""
        text = super().mjcf().replace('group="3"', 'group="0" rgba="0.55 0.6 0.68 1"', 1)
        text = text.replace('rgba=".5 .5 .5 .3"', 'rgba="0.84 0.37 0 1"')
        option = '<option timestep="0.01" integrator="implicitfast" cone="elliptic"/>'
        text = re.sub("<option.*?</option>", option, text, flags=re.DOTALL)
        text = text.replace('quat="0 1 0 -0.175"', 'quat="0 1 0 0"')
        look = (
            '<visual><headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/></visual>'
        )
        sun = (
            '<light directional="true" dir="0.2 0.2 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"'
            ' castshadow="false"/>'
        )
        can = f"""
          <body name="can">
            <freejoint name="can"/>
            <geom name="can" type="cylinder" size="{RADIUS} {HALF}" mass="0.08" friction="0.3"
              rgba="0.9 0.62 0 1"/>
            <geom name="mark" type="box" size="{RADIUS / 6.0} {RADIUS / 2.0} 0.0003" mass="0"
              pos="0 {RADIUS / 2.0} {HALF}" contype="0" conaffinity="0" rgba="0 0.45 0.7 1"/>
          </body>"""
        text = re.sub("<light.*?/>", sun, text).replace("<worldbody>", f"{look}<worldbody>")
        text = text.replace("</worldbody>", f"{can}</worldbody>")
        sensor = '<frameangvel name="spin" objtype="body" objname="can"/>'
        return text.replace("</mujoco>", f"<sensor>{sensor}</sensor></mujoco>")

    def reset(self, sim, row, rng):
        place = PLACE
        sim.qpos[row, :16] = POSE
        if rng is not None:
            place = PLACE + rng.uniform(-0.005, 0.005, 2)
            sim.qpos[row, :16] += rng.uniform(-0.05, 0.05, 16)
            sim.expand("body_mass")[row, self.model.body("can").id] *= rng.uniform(0.8, 1.2)
            sim.expand("geom_friction")[row, :, 0] *= rng.uniform(0.8, 1.2)
        sim.joint("can").qpos[row] = [*place, HALF - 0.024, 1.0, 0.0, 0.0, 0.0]

    # 2 numbers: how far the can is off its place, towards the fingers and away from the thumb
    # [2 cm]; the clock adds its sine and cosine
    def observe(self, sim):
        return 50.0 * self._off(sim)

    def reward(self, sim, action):
        spin = sim.sensor("spin").data[:, 2]  # [rad/s]
        return {
            "turn": np.clip(-spin, -2.0, 2.0),
            "centre": -20.0 * (self._off(sim) ** 2).sum(axis=1),
        }

    def ended(self, sim):
        upright = self._axes(sim)[:, 8]
        return (upright < 0.7) | (abs(self._off(sim)) > 0.03).any(axis=1)

    def measure(self, sim):
        return {"heading": self._axes(sim)[:, [0, 3]]}  # of the can's x axis, seen from above

    def outcomes(self, record):  # the angles between two steps are small: nearly their sines
        x, y = record.frames["heading"].transpose(2, 0, 1)
        sine = (y[:, :-1] * x[:, 1:] - x[:, :-1] * y[:, 1:]) / np.maximum(x**2 + y**2, 0.1)[:, 1:]
        here = np.arange(1, x.shape[1]) < record.steps[:, None]
        return {"turned": np.clip((sine * here).sum(axis=1), -100.0, 100.0)}

    def _axes(self, sim):
        """The can's axes, (B, 9)."""
        return sim.body("can").xmat.reshape(len(sim), 9)

    def _off(self, sim):
        """How far the can is off its place in the palm [m], (B, 2)."""
        return sim.joint("can").qpos[:, :2] - PLACE
