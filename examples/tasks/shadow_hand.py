"""The Shadow hand of gymnasium-robotics holds a block so that as many of its 92 touch sensors as
possible feel it.
"""

import gymnasium
import gymnasium_robotics
from gymnasium_robotics.utils import mujoco_utils

from farm.tasks.gymnasium import Environment

gymnasium.register_envs(gymnasium_robotics)

# Those of release 1.4.2 assert something of a joint's kind that does not hold with MuJoCo 4.
mujoco_utils.get_joint_qpos = lambda model, data, name: data.joint(name).qpos.copy()
mujoco_utils.get_joint_qvel = lambda model, data, name: data.joint(name).qvel.copy()


class Hold(Environment):
    """The number of sensors that feel something, per step.

    The environment's own reward would be `sim.reward`.
    """

    # without `normalise`: what a sensor feels for the first time would be huge in its standard
    # deviations
    presets = {
        "default": {
            **Environment.presets["default"],
            "normalise": False,
            "initial_sigma": 0.02,
            "learning_rate_mu": 0.02,
        }
    }

    def __init__(self, config=None, variant="", files=None):
        super().__init__(config, "HandManipulateBlock_BooleanTouchSensorsDense-v1", files)

    def reward(self, sim, action):
        return sim.observation[:, -92:].sum(axis=1)
