"""The task as a Gymnasium environment, on the same physics as the farm's rollouts.

    import gymnasium
    env = gymnasium.make(
        "farm.tasks.finger_gait.env:rolloutfarm/FingerGait-v0", state="joints", perturb=True
    )

Driven by the same controller it gives the farm's numbers bit for bit (docs/gymnasium.md).
"""

from typing import Any, Final, Literal

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box

from farm.arrays import AnyArray, FloatArray
from farm.errors import ConfigError
from farm.sim.channels import Camera
from farm.sim.engines import DataEngine
from farm.sim.rendering import aimed
from farm.sim.scene import quiet
from farm.sim.sim import Sim
from farm.tasks.finger_gait.hand import FINGERS, JOINTS, LOWER, UPPER
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from farm.tasks.finger_gait.observations import STATES, Felt
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.finger_gait.touch import TAXELS
from farm.tasks.loop import Batch

ID: Final = "rolloutfarm/FingerGait-v0"
"""The environment's name in Gymnasium's registry."""

REACH: Final = 1.0
"""Actions that are no joint positions lie in [-REACH, REACH] [rad]."""

JOINT_BOUND: Final = 2.0 * np.pi
"""Joint readings are clipped here, far above the joints' limits [rad]."""

FORCE_BOUND: Final = 1000.0
"""A taxel's force is clipped here [N]."""

_SIZE: Final = (480, 640)  # height and width of a picture
_CAMERA: Final = Camera(lookat=(0.025, 0.009, -0.006), distance=0.4, azimuth=158.0, elevation=-12.0)


class FingerGaitEnv(gymnasium.Env[FloatArray, FloatArray]):
    """One rollout per episode; settings are those of `farm run`.

    The observation is the state base's x, (d,); at a drop, which ends an episode, it is that of the
    step before. The discounted sum of an episode's rewards is the farm's return.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        render_mode: Literal["rgb_array"] | None = None,
        action: Literal["offset", "absolute", "increment"] = "offset",
        **task: Any,  # noqa: ANN401  fields of TaskConfig, checked there
    ) -> None:
        """Close the grips once; action and others are settings of the task.

        Raises:
          ConfigError: a setting makes no sense.
        """
        config = FingerGaitConfig(action=action, **task)
        if not isinstance(config.object, str):
            raise ConfigError(
                f"object is {', '.join(config.object)}; an environment has one: make one for each"
            )
        quiet()
        self._task = FingerGait(config)
        self._sim = Sim(DataEngine(self._task.model))
        self._task.setup(self._sim)
        self._terms = self._task.spec().terms
        self.render_mode = render_mode
        self._low, self._high = _observed(config)
        self.observation_space = Box(self._low, self._high, dtype=np.float64)
        limits = (LOWER, UPPER) if action == "absolute" else (-REACH, REACH)
        self.action_space = Box(*limits, shape=(len(JOINTS),), dtype=np.float64)
        self._renderer: mujoco.Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Release the object; with perturb=True under conditions drawn from the seed."""
        super().reset(seed=seed, options=options)
        start = None
        if self._task.config.perturb:  # as the farm has seeds: four words
            start = tuple(self.np_random.integers(0, 2**32, 4).tolist())
        self._batch = Batch(self._task, self._sim, [start])
        self._x = self._look()
        return self._x.copy(), self._info(np.zeros(len(self._terms)), success=False)

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Move for one control step of 0.1 s."""
        batch, t = self._batch, self._sim.t
        batch.step(np.asarray(action, dtype=float)[None])
        terminated, over = not len(batch.active), self._sim.t >= self._task.steps
        if not terminated:
            self._x = self._look()
        score = self._task.score(batch.record())
        assert score.success is not None
        terms = score.terms[0, t]
        info = self._info(terms, success=bool(over and score.success[0]))
        return (
            self._x.copy(),
            self._task.return_scale * float(terms.sum()),
            terminated,
            over and not terminated,
            info,
        )

    def render(self) -> AnyArray | None:  # type: ignore[override]  (Gymnasium's may be a list as well)
        """A picture of 480 x 640 pixels, None without a render mode."""
        if self.render_mode is None:
            return None
        model = self._task.model
        if self._renderer is None:
            self._renderer = mujoco.Renderer(model, *_SIZE)
        data = mujoco.MjData(model)
        data.qpos[:] = self._sim.engine.field("qpos")[0]
        mujoco.mj_forward(model, data)
        self._renderer.update_scene(data, aimed(mujoco.MjvCamera(), _CAMERA))
        return self._renderer.render()

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _look(self) -> FloatArray:
        return np.clip(self._batch.observe()[0], self._low, self._high)

    def _info(self, terms: FloatArray, *, success: bool) -> dict[str, Any]:
        return {
            "is_success": success,
            "reward_terms": dict(zip(self._terms, terms.tolist(), strict=True)),
        }


def _observed(config: FingerGaitConfig) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest observation, (d,)."""

    def x(joint: float, force: float, point: float) -> FloatArray:
        joints = np.full((1, len(JOINTS)), joint * config.joints_scale)
        images = np.full((1, len(FINGERS), TAXELS), force * config.tactile_scale)
        points = np.full((1, len(FINGERS), 3), point * config.contacts_scale)
        return STATES[config.state].observe(Felt(joints, images, points, behind=joints))[0]

    return x(-JOINT_BOUND, 0.0, -1.0), x(JOINT_BOUND, FORCE_BOUND, 1.0)


# Gymnasium has no other way in: it imports the module that an id names in front of a colon.
gymnasium.register(ID, entry_point="farm.tasks.finger_gait.env:FingerGaitEnv")
