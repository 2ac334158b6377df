"""Tasks as environments of Gymnasium, for other learners: `farm.environment`."""

from typing import TYPE_CHECKING, Any, Literal, overload

from farm.errors import ConfigError
from farm.runner import task_of
from farm.tasks.base import Task

if TYPE_CHECKING:
    from farm.tasks.environment import FarmEnv, FarmVectorEnv

MOST = 4096
"""Environments that are stepped together, at most."""


@overload
def environment(
    task: str | type[Task] | Task,
    *,
    num_envs: None = None,
    render_mode: Literal["rgb_array"] | None = None,
    **settings: Any,  # noqa: ANN401  of the task
) -> "FarmEnv": ...


@overload
def environment(
    task: str | type[Task] | Task,
    *,
    num_envs: int,
    **settings: Any,  # noqa: ANN401  of the task
) -> "FarmVectorEnv": ...


def environment(
    task: str | type[Task] | Task,
    *,
    num_envs: int | None = None,
    render_mode: Literal["rgb_array"] | None = None,
    **settings: Any,
) -> "FarmEnv | FarmVectorEnv":
    """A task as an environment of Gymnasium: the farm's rollouts to the last bit.

    Args:
      task: its name, FILE.py:CLASS, its class, or an object of it with settings of its own.
      num_envs: this number of environments that are stepped together, a
        `gymnasium.vector.VectorEnv`; None: one.
      render_mode: "rgb_array" for pictures by `render`; of one environment only.
      settings: of the task, such as perturb=False; others are those of `farm run`.

    Raises:
      ConfigError: gymnasium is missing, a setting is invalid, or the task scores whole rollouts.

    Example:
      ```python
      import farm

      class Hinge(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body><joint name="hinge" axis="0 1 0"/><geom size="0.1" pos="0 0 0.5"/></body>
            </worldbody>
            <actuator><motor joint="hinge"/></actuator>
          </mujoco>'''
          steps, substeps = 50, 10

          def reward(self, sim, action):  # (B,)
              return -abs(sim.qpos[:, 0])

      env = farm.environment(Hinge)
      x, info = env.reset(seed=7)
      x, reward, terminated, truncated, info = env.step(env.action_space.sample())
      assert info["reward_terms"] == {"reward": reward}
      ```
    """
    try:
        from farm.tasks.environment import FarmEnv, FarmVectorEnv, described
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "gymnasium":
            raise
        remedy = "pip install 'rolloutfarm[gym]'"
        raise ConfigError(f"farm.environment needs gymnasium: {remedy}") from None
    if num_envs is not None:
        if type(num_envs) is not int or not 1 <= num_envs <= MOST:
            expected = f"a whole number from 1 to {MOST}, or None"
            raise ConfigError(f"num_envs is {num_envs!r:.40}; expected {expected}")
        if render_mode is not None:
            raise ConfigError("render_mode is for one environment: leave out num_envs")
        return FarmVectorEnv(task_of(task, preset=True, **settings), num_envs)

    def make(render_mode: Literal["rgb_array"] | None = None) -> "FarmEnv":
        return FarmEnv(task_of(task, preset=True, **settings), render_mode)

    env = make(render_mode)
    env.spec = described(env.name, make)
    return env
