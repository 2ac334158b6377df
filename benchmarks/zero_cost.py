"""A task whose rollouts take next to nothing: one physics step of one body, for measuring what is around them."""

import numpy as np

from farm import Task


class ZeroCost(Task):
    """One step, and the reward is the action."""

    xml = """<mujoco><option timestep="0.01"/><worldbody><body>
      <joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body></worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
    steps = 1

    def reward(self, sim, action):  # noqa: ANN001, ANN201, ARG002  as an author would write it
        """(B,)."""
        return np.array(action[:, 0])
