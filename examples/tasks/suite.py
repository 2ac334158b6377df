"""A task of dm_control's suite, by shimmy: a cart swings a pole up and balances it."""

import gymnasium
import mujoco
import shimmy
from dm_control.mujoco.wrapper.mjbindings import sizes

from farm.tasks.gymnasium import Environment

gymnasium.register_envs(shimmy)

# Release 1.0.50 lists fields that MuJoCo 4 does not have.
for name, kind in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
    for field in [each for each in sizes.array_sizes[name] if not hasattr(kind, each)]:
        del sizes.array_sizes[name][field]


class Swingup(Environment):
    """10 s, in which each of 1000 steps earns up to 1."""

    presets = {"default": {**Environment.presets["default"], "steps": 1000}}

    def __init__(self, config=None, variant="", files=None):
        super().__init__(config, "dm_control/cartpole-swingup-v0", files)
