"""A Kinova Jaco arm of dm_control, with its meshes, reaches for a ball that moves.

pip install --no-deps dm_control     # the model and its meshes: Kinova's, in third_party
"""

import numpy as np

from farm import Task


class Jaco(Task):
    """Keep the wrist at the ball."""

    package = "dm_control"
    root = "third_party"
    xml = """<mujoco>
      <include file="kinova/jaco_arm.xml"/>
      <compiler meshdir="kinova/meshes_decimated"/>
      <option timestep="0.005" integrator="implicitfast"><flag contact="disable"/></option>
      <worldbody>
        <light pos="1 -1 2"/>
        <geom type="plane" size="1 1 0.1" rgba="0.85 0.85 0.85 1"/>
        <body name="ball" mocap="true" pos="0.3 -0.3 0.5">
          <geom type="sphere" size="0.03" rgba="0.9 0.5 0.1 1"/>
        </body>
      </worldbody>
      <actuator>
        <position joint="joint_1" kp="60" kv="25" ctrlrange="-3 3"/>
        <position joint="joint_2" kp="60" kv="25" ctrlrange="0.9 5.4"/>
        <position joint="joint_3" kp="60" kv="25" ctrlrange="0.4 5.9"/>
      </actuator>
    </mujoco>"""
    steps, substeps = 60, 10  # 3 s

    def reset(self, sim, row, rng):
        sim.qpos[row] = [0.0, 3.14, 3.14, 0.0, 0.0, 0.0]
        angle = sim.own.setdefault("angle", np.zeros(len(sim)))
        angle[row] = -0.8 if rng is None else rng.uniform(-1.2, -0.4)

    def act(self, sim, action):
        turn = sim.own["angle"] + 0.4 * np.sin(0.05 * sim.t)  # the ball goes to and fro on an arc
        sim.mocap_pos[:, 0] = np.stack(
            [0.45 * np.cos(turn), 0.45 * np.sin(turn), np.full(len(sim), 0.5)], axis=1
        )
        return super().act(sim, action)

    def observe(self, sim):
        return np.concatenate(
            [sim.qpos[:, :3] - [0.0, 3.14, 3.14], 0.2 * sim.qvel[:, :3], self._way(sim)], axis=1
        )

    def reward(self, sim, action):
        return {
            "near": -np.sqrt((self._way(sim) ** 2).sum(axis=1)),
            "calm": -0.01 * (sim.qvel[:, :3] ** 2).sum(axis=1),
        }

    def _way(self, sim):
        """From the wrist to the ball [m], (B, 3)."""
        return sim.mocap_pos[:, 0] - sim.body("b_6").xpos
