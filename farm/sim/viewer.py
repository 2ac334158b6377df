"""A policy in MuJoCo's interactive viewer, in real time; a door to mujoco."""

import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import mujoco.viewer

from farm.arrays import FloatArray
from farm.errors import RunError
from farm.policies.fourier import Policy
from farm.sim.scene import STATE, HandScene
from farm.tasks.finger_gait.task import SUBSTEPS, TIMESTEP, FingerGait, Frames, touching

_CAMERA: Final = {"distance": 0.42, "azimuth": 150.0, "elevation": -14.0}
_LOOK_AT: Final = (0.035, 0.014, 0.0)
_CLOSING: Final = 10.0  # [s]
_PUSH: Final = 2000.0  # of the mouse's spring, for each kg: MuJoCo's 100 are lost on an object of 50 g in a firm grip


@dataclass(frozen=True)
class Player:
    """A policy and where its rollouts begin."""

    scene: HandScene
    task: FingerGait
    policy: Policy
    mu: FloatArray
    """(P,)"""
    state: FloatArray
    """The simulator's at the moment of release."""
    start: Frames
    """(1,) what is measured there."""

    def rollout(self, data: mujoco.MjData, step: Callable[[], bool]) -> int:
        """One closed-loop rollout.

        Args:
          data: of the scene's model; begins at the release, whatever it was before.
          step: advances it by one physics step; false ends the rollout.

        Returns:
          control steps begun; fewer than the task's where the object fell or `step` said so.
        """
        mujoco.mj_setState(self.scene.model, data, self.state, STATE)
        weights = self.policy.weights(self.mu[None])
        now, last = self.start, self.task.commands[None]
        for t in range(self.task.config.steps):
            actions = self.policy.actions(weights, self.task.observe(now, None))
            last = self.policy.targets(actions, self.task.commands, last)
            data.ctrl[:] = last[0]
            for _ in range(SUBSTEPS):
                if not step():
                    return t + 1
            now = self.scene.measure(data)
            if not touching(now.force)[0]:
                return t + 1
        return self.task.config.steps


def watch(
    player: Player, wait: Callable[[float], bool], say: Callable[[str], object], *, speed: float, hold: float
) -> int:
    """Open the viewer and play rollouts, one after the other, until its window is closed.

    Args:
      player: what is played.
      wait: sleeps so many seconds; true when it is time to end.
      say: told how the first rollout went.
      speed: 1 is real time.
      hold: how long the hand rests after a rollout [s].

    Returns:
      control steps played.

    Raises:
      RunError: no window can be opened.
    """
    _check_window()
    others = set(threading.enumerate())
    player.scene.model.vis.map.stiffness = _PUSH
    data = mujoco.MjData(player.scene.model)
    mujoco.mj_setState(player.scene.model, data, player.state, STATE)
    played = 0
    with mujoco.viewer.launch_passive(player.scene.model, data, show_left_ui=False, show_right_ui=False) as viewer:
        with viewer.lock():
            viewer.cam.lookat[:] = _LOOK_AT
            for name, value in _CAMERA.items():
                setattr(viewer.cam, name, value)
        clock = _Clock(viewer, data, wait, speed)
        while clock.going:
            steps = player.rollout(data, clock.step)
            if not played:
                say(f"the first rollout is over after {steps} control steps, others follow")
            played += steps
            for _ in range(round(hold / TIMESTEP)):
                if not clock.step():
                    break
    for drawing in set(threading.enumerate()) - others:
        drawing.join(_CLOSING)  # a process that ends while it draws ends with an error of X
    return played


class _Clock:
    """Steps the physics at the speed that is wanted, with the mouse's pushes."""

    def __init__(
        self, viewer: mujoco.viewer.Handle, data: mujoco.MjData, wait: Callable[[float], bool], speed: float
    ) -> None:
        self._viewer, self._data, self._wait = viewer, data, wait
        self._period = TIMESTEP / speed
        self._next = time.monotonic()
        self.going = True

    def step(self) -> bool:
        """One physics step, shown; false when the viewer was closed or it is time to end."""
        viewer, data = self._viewer, self._data
        with viewer.lock():
            data.xfrc_applied[:] = 0.0
            mujoco.mjv_applyPerturbForce(viewer.m, data, viewer.perturb)
            mujoco.mj_step(viewer.m, data)
        viewer.sync()
        self._next = max(self._next + self._period, time.monotonic() - 10 * self._period)  # no race after a pause
        ended = self._wait(max(0.0, self._next - time.monotonic()))
        self.going = not ended and viewer.is_running()
        return self.going


def _check_window() -> None:
    """Whether a window can be opened: the viewer's own thread would fail without a word.

    Raises:
      RunError: it cannot.
    """
    import glfw

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        window: Any = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, 0)
            window = glfw.create_window(64, 64, "", None, None)
            if window:
                glfw.destroy_window(window)
            glfw.terminate()
    if not window:
        why = f": {' '.join(str(said[-1].message).split())}" if said else ""
        raise RunError(f"cannot open a window{why}. Look at DISPLAY, or draw without one: farm replay RUN --video")
