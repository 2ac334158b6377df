"""A task whose rollouts take almost no time, for measuring the farm's overhead: one physics step of
one body.
"""

import numpy as np

from farm import Task


class ZeroCost(Task):
    """One step; the reward is the action."""

    xml = """<mujoco><option timestep="0.01"/><worldbody><body>
      <joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body></worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
    steps = 1

    def reward(self, sim, action):  # noqa: ANN001, ANN201, ARG002  as users write it
        """Rewards (B,)."""
        return np.array(action[:, 0])
