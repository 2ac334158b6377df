"""A task in MuJoCo's interactive viewer, in real time."""

import threading
import time
import warnings
from collections.abc import Callable
from typing import Any, Final

import mujoco
import mujoco.viewer

from farm.errors import RunError
from farm.sim import paint
from farm.sim.engines import DataEngine
from farm.sim.framing import View
from farm.sim.rendering import aimed
from farm.sim.sim import Sim

_CLOSING: Final = 10.0  # [s]
# Stiffness of the mouse's spring, for each kg: MuJoCo's 100 are lost on an object of 50 g in a
# firm grip
_PUSH: Final = 2000.0


def watch(
    model: mujoco.MjModel,
    play: Callable[[Sim], int],
    wait: Callable[[float], bool],
    say: Callable[[str], object],
    *,
    view: View,
    speed: float,
    hold: float,
) -> int:
    """Open the viewer and play rollouts, one after another, until its window is closed.

    Args:
      model: what is simulated; its look may be changed.
      play: runs one rollout in a simulation that is shown, and returns the control steps it lasted.
      wait: sleeps this number of seconds; true when it is time to end.
      say: called with a message after the first rollout.
      view: point of view; the mouse moves it as well.
      speed: 1 is real time.
      hold: pause after a rollout [s].

    Returns:
      control steps played.

    Raises:
      RunError: no window can be opened.
    """
    _check_window()
    others = set(threading.enumerate())
    model.vis.map.stiffness = _PUSH
    model.geom_rgba[:] = paint.colours(model)
    engine = DataEngine(model)
    played = 0
    with mujoco.viewer.launch_passive(
        model, engine.data, show_left_ui=False, show_right_ui=False
    ) as viewer:
        with viewer.lock():
            aimed(viewer.cam, view.camera)
        clock = _Clock(viewer, engine.data, view, wait, float(model.opt.timestep) / speed)
        engine.pace = clock.step
        while clock.going:
            with viewer.lock():
                viewer.cam.lookat += view.back()
            steps = play(Sim(engine))
            if not played:
                say(f"the first rollout ended after {steps} control steps, and is repeated")
            played += steps
            for _ in range(round(hold / model.opt.timestep)):
                if not clock.step():
                    break
    for drawing in set(threading.enumerate()) - others:
        drawing.join(_CLOSING)  # a process that ends while it draws ends with an error of X
    return played


class _Clock:
    """Steps the physics at the requested speed, with forces from the mouse."""

    def __init__(
        self,
        viewer: mujoco.viewer.Handle,
        data: mujoco.MjData,
        view: View,
        wait: Callable[[float], bool],
        period: float,
    ) -> None:
        self._viewer = viewer
        self._data = data
        self._view = view
        self._wait = wait
        self._period = period
        self._next = time.monotonic()
        self.going = True

    def step(self) -> bool:
        """One physics step, shown; false when the viewer was closed or it is time to end."""
        viewer, data = self._viewer, self._data
        with viewer.lock():
            forces = data.xfrc_applied.copy()  # the task's
            data.xfrc_applied[:] = 0.0
            mujoco.mjv_applyPerturbForce(viewer.m, data, viewer.perturb)
            data.xfrc_applied += forces
            mujoco.mj_step(viewer.m, data)
            data.xfrc_applied[:] = forces
            if self._view.mover is not None:
                viewer.cam.lookat += self._view.moved(data.xpos[self._view.mover.index])
        viewer.sync()
        # No race after a pause
        self._next = max(self._next + self._period, time.monotonic() - 10 * self._period)
        over = self._wait(max(0.0, self._next - time.monotonic()))
        self.going = not over and viewer.is_running()
        return self.going


def _check_window() -> None:
    """Check that a window can be opened: the viewer's own thread would fail silently."""
    import glfw

    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        window: Any = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, 0)
            window = glfw.create_window(64, 64, "", None, None)
            if window:
                glfw.destroy_window(window)
            glfw.terminate()
    if not window:
        why = f": {' '.join(str(messages[-1].message).split())}" if messages else ""
        raise RunError(
            f"cannot open a window{why}. Check DISPLAY, or draw without one: farm replay RUN"
            " --video"
        )
