"""A quadrotor flies to a point and hovers there, by the thrusts of its four rotors; without
feedback it tips over.
"""

import numpy as np

from farm import Task

ROTORS = "".join(
    f'<site name="rotor {i}" pos="{x} {y} 0" size="0.01"/><geom type="cylinder" size="0.08 0.005"'
    f' pos="{x} {y} 0.02" mass="0.001" contype="0" conaffinity="0" rgba="0.34 0.71 0.91 1"/>'
    for i, (x, y) in enumerate([(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)])
)
# Thrusts up to 5 N each; the quadrotor weighs 9.8 N
MOTORS = "".join(
    f'<motor site="rotor {i}" gear="0 0 1 0 0 {0.02 * (-1) ** i}" ctrlrange="0 5"/>'
    for i in range(4)
)


class Quadrotor(Task):
    """Fly to a point and hover there; the point is drawn, and the first pushes are."""

    xml = f"""<mujoco><option timestep="0.004"/><worldbody>
      <geom type="plane" size="3 3 0.1"/>
      <body name="goal" mocap="true" pos="0 0 1">
        <geom size="0.04" contype="0" conaffinity="0" rgba="0 0.62 0.45 1"/></body>
      <body name="frame" pos="0 0 1"><freejoint/>
        <geom type="box" size="0.22 0.03 0.015" euler="0 0 45" mass="0.4" rgba="0.2 0.2 0.2 1"/>
        <geom type="box" size="0.22 0.03 0.015" euler="0 0 -45" mass="0.4" rgba="0.2 0.2 0.2 1"/>
        <geom type="box" size="0.07 0.07 0.04" mass="0.2" rgba="0.9 0.62 0 1"/>{ROTORS}</body>
      </worldbody><actuator>{MOTORS}</actuator></mujoco>"""
    steps, substeps = 200, 5  # 4 s at 50 Hz
    ending = "crashed"

    def reset(self, sim, row, rng):
        goal = (0.4, -0.3, 0.3) if rng is None else rng.uniform(-0.5, 0.5, 3)
        sim.mocap_pos[row, 0] = goal + np.array([0.0, 0.0, 1.0])
        if rng is not None:
            sim.qvel[row] = rng.uniform(-0.3, 0.3, 6)

    def observe(self, sim):  # where the goal is, how it is turned, and its speeds: 18 numbers
        turned = sim.body("frame").xmat.reshape(len(sim), 9)
        return np.concatenate([sim.qpos[:, :3] - sim.mocap_pos[:, 0], turned, sim.qvel], axis=1)

    def reward(self, sim, action):
        away = np.linalg.norm(sim.qpos[:, :3] - sim.mocap_pos[:, 0], axis=1)
        spin = (sim.qvel[:, 3:] ** 2).sum(axis=1)
        return {"near": 1.0 / (1.0 + away**2), "calm": -0.02 * np.minimum(spin, 50.0)}

    def ended(self, sim):  # tipped over, on the floor, or gone
        upright = sim.body("frame").xmat.reshape(len(sim), 9)[:, 8]
        return (upright < 0.3) | (sim.qpos[:, 2] < 0.1) | (sim.qpos[:, 2] > 3.0)
