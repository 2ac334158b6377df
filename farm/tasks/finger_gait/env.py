"""The task as a Gymnasium environment, on the same physics as the farm's rollouts.

    import gymnasium
    env = gymnasium.make("farm.tasks.finger_gait.env:rolloutfarm/FingerGait-v0", state="joints", perturb=True)

Driven by the same controller it gives the farm's numbers bit for bit (docs/gymnasium.md).
"""

from typing import Any, Final, Literal

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box

from farm.arrays import AnyArray, FloatArray
from farm.policies.fourier import Features, Policy, PolicyConfig
from farm.tasks.finger_gait.hand import FINGERS, JOINTS, LOWER, UPPER
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.physics import Simulation
from farm.tasks.finger_gait.rewards import TERMS
from farm.tasks.finger_gait.task import (
    CONTROL_PERIOD,
    SUBSTEPS,
    SUCCESS_STEPS,
    Frames,
    Perturbation,
    TaskConfig,
    touching,
)
from farm.tasks.finger_gait.touch import TAXELS

ID: Final = "rolloutfarm/FingerGait-v0"
"""The environment's name in Gymnasium's registry."""

REACH: Final = 1.0
"""Actions that are no joint positions lie in [-REACH, REACH] [rad]."""

JOINT_BOUND: Final = 2.0 * np.pi
"""Joint readings are clipped here; the joints end far below [rad]."""

FORCE_BOUND: Final = 1000.0
"""A taxel's force is clipped here [N]."""

_ONE: Final = np.zeros(1, dtype=np.int64)  # the only simulation
_SIZE: Final = (480, 640)  # height and width of a picture


class FingerGaitEnv(gymnasium.Env[FloatArray, FloatArray]):
    """One rollout an episode; settings are those of `farm run`.

    The observation is the state base's x, (d,). The discounted sum of an episode's rewards is the farm's return.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / CONTROL_PERIOD)}

    def __init__(
        self,
        render_mode: Literal["rgb_array"] | None = None,
        action: Literal["offset", "absolute", "increment"] = "offset",
        **task: Any,  # noqa: ANN401  fields of TaskConfig, checked there
    ) -> None:
        """Close the grips once.

        Args:
          render_mode: rgb_array, or None for no pictures.
          action: what an action is, see PolicyConfig.
          task: settings of TaskConfig.

        Raises:
          ConfigError: a setting makes no sense.
        """
        config = TaskConfig(**task)
        # The controller is outside; of a policy there is only what an action means, and a size that fits.
        kernel = PolicyConfig(controller="kernel", action=action)
        nothing = Features(frequencies=np.empty((0, 0)), phases=np.empty(0))
        self._policy = Policy(kernel, STATES[config.state].size, nothing)
        self._simulation = Simulation(config, self._policy, capacity=1)
        self.render_mode = render_mode
        self._low, self._high = _observed(config)
        self.observation_space = Box(self._low, self._high, dtype=np.float64)
        limits = (LOWER, UPPER) if action == "absolute" else (-REACH, REACH)
        self.action_space = Box(*limits, shape=(len(JOINTS),), dtype=np.float64)
        self._renderer: mujoco.Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Release the object; with perturb=True under conditions of its own, drawn from the seed."""
        super().reset(seed=seed, options=options)
        config = self._simulation.task.config
        # One row more than the farm draws: there is an observation after the last step, too.
        perturbation = Perturbation.draw(self.np_random, config.steps + 1) if config.perturb else None
        self._stepper, start, noise = self._simulation.begin([perturbation])
        self._noise = None if noise is None else noise[0]
        self._start, self._now = start.frames.pose, start.frames
        self._last = self._simulation.task.commands[None]
        self._steps = 0
        self._history: list[tuple[Frames, FloatArray]] = []
        return self._observation(), _info(np.zeros(len(TERMS)), success=False)

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Move for one control step of 0.1 s."""
        task, stepper = self._simulation.task, self._stepper
        raw = np.asarray(action, dtype=float)[None]
        self._last = self._policy.targets(raw, task.commands, self._last)
        stepper.ctrl[_ONE] = self._last
        stepper.step(_ONE, SUBSTEPS)
        self._now = stepper.frames(_ONE)
        failed = stepper.blown_up(_ONE)
        if failed[0]:
            self._now = Frames(*(np.zeros_like(part) for part in (self._now.qpos, self._now.force, self._now.place)))
        self._steps += 1
        self._history = [*self._history[1 - SUCCESS_STEPS :], (self._now, raw)]
        ended = bool(failed[0] or not touching(self._now.force)[0])
        over = self._steps >= task.config.steps
        # The task judges rollouts that are over: here of the last steps, of which it wants to see so many.
        frames, actions = zip(*self._history, strict=True)
        outcome = task.judge(_in_row(frames), np.stack(actions, axis=1), self._start, np.array([len(frames)]), failed)
        terms = outcome.terms[0, -1]
        info = _info(terms, success=bool(over and outcome.success[0]))
        return self._observation(), task.config.return_scale * float(terms.sum()), ended, over and not ended, info

    def render(self) -> AnyArray | None:  # type: ignore[override]  (Gymnasium's may be a list as well)
        """A picture of 480 x 640 pixels, None without a render mode."""
        if self.render_mode is None:
            return None
        model = self._simulation.scene.model
        if self._renderer is None:
            self._renderer = mujoco.Renderer(model, *_SIZE)
        data = mujoco.MjData(model)
        data.qpos[:] = self._now.qpos[0]
        mujoco.mj_forward(model, data)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = (0.025, 0.009, -0.006)
        camera.distance, camera.azimuth, camera.elevation = 0.4, 158.0, -12.0
        self._renderer.update_scene(data, camera)
        return self._renderer.render()

    def close(self) -> None:
        """Give back the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _observation(self) -> FloatArray:
        noise = None if self._noise is None else self._noise[self._steps][None]
        x = self._simulation.task.observe(self._now, noise)[0]
        return np.clip(x, self._low, self._high)


def _observed(config: TaskConfig) -> tuple[FloatArray, FloatArray]:
    """Least and greatest observation, (d,)."""

    def x(joint: float, force: float, point: float) -> FloatArray:
        joints = np.full((1, len(JOINTS)), joint * config.joints_scale)
        images = np.full((1, len(FINGERS), TAXELS), force * config.tactile_scale)
        points = np.full((1, len(FINGERS), 3), point * config.contacts_scale)
        return STATES[config.state].observe(joints, images, points)[0]

    return x(-JOINT_BOUND, 0.0, -1.0), x(JOINT_BOUND, FORCE_BOUND, 1.0)


def _in_row(frames: tuple[Frames, ...]) -> Frames:
    """Moments of one rollout behind each other, (1,) each -> (1, T)."""
    return Frames(*(np.stack([getattr(f, name) for f in frames], axis=1) for name in ("qpos", "force", "place")))


def _info(terms: FloatArray, *, success: bool) -> dict[str, Any]:
    return {"is_success": success, "reward_terms": dict(zip(TERMS, terms.tolist(), strict=True))}


# Gymnasium has no other way in: it imports the module that an id names in front of a colon.
gymnasium.register(ID, entry_point="farm.tasks.finger_gait.env:FingerGaitEnv")
