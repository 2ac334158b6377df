"""MuJoCo environments of Gymnasium as tasks: made by name, checked, measured; the door to gymnasium on either side.

Only registered names are taken. One that names a module to import (`module:Name-v0`) never comes this far:
`TaskConfig` refuses it.
"""

import warnings
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import mujoco

from farm.errors import ConfigError
from farm.sim import scene as scenes
from farm.sim.scene import Scene
from farm.tasks.base import Sizes
from farm.tasks.finger_gait.task import STEPS_LIMIT, TaskConfig

if TYPE_CHECKING:
    import gymnasium

TERMS: Final = ("reward",)
"""What a reward is made of."""

_LIMIT: Final = 100_000  # numbers of an observation
_UNSTABLE: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def make(config: TaskConfig) -> "gymnasium.Env[Any, Any]":
    """The environment, without a time limit of its own.

    Raises:
      ConfigError: gymnasium is not installed, there is no such environment, or it is none that can be learnt here.
    """
    try:
        import gymnasium
        from gymnasium.envs.mujoco import MujocoEnv
    except ImportError:
        raise ConfigError(f"task {config.task} needs gymnasium: pip install 'rolloutfarm[gym]'") from None
    scenes.quiet()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there is a newer version, mostly
            env = gymnasium.make(config.environment, max_episode_steps=-1, disable_env_checker=True)
    except Exception as error:  # whatever an environment may raise
        raise ConfigError(f"task {config.task}: {' '.join(str(error).split())}") from None
    space, actions = env.observation_space, env.action_space
    if not isinstance(env.unwrapped, MujocoEnv):
        raise ConfigError(f"task {config.task}: not an environment of MuJoCo")
    box = gymnasium.spaces.Box
    if not isinstance(space, box) or len(space.shape) != 1 or space.shape[0] > _LIMIT:
        raise ConfigError(f"task {config.task}: observations are {space}; expected a box of one dimension")
    if not isinstance(actions, box) or len(actions.shape) != 1 or not actions.is_bounded():
        raise ConfigError(f"task {config.task}: actions are {actions}; expected a bounded box of one dimension")
    return env


def blown_up(env: "gymnasium.Env[Any, Any]") -> bool:
    """Whether MuJoCo met numbers out of bounds since the last reset (it goes on from the start, as if nothing were)."""
    warned = env.unwrapped.data.warning  # type: ignore[attr-defined]
    return any(warned[kind].number for kind in _UNSTABLE)


@cache
def sizes(config: TaskConfig) -> Sizes:
    """How large the environment's numbers are.

    Raises:
      ConfigError: as `make`; or it has no horizon and none is given.
    """
    env = make(config)
    import gymnasium

    own = gymnasium.spec(config.environment).max_episode_steps
    steps = min(config.steps or STEPS_LIMIT, own or STEPS_LIMIT)
    if own and config.steps > own:
        raise ConfigError(f"--steps {config.steps}: task {config.task} ends after {own}")
    if not (own or config.steps):
        raise ConfigError(f"task {config.task} ends at no number of steps: give it one with --steps")
    low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)  # type: ignore[attr-defined]
    period = float(env.unwrapped.dt)  # type: ignore[attr-defined]
    size = env.observation_space.shape[0]  # type: ignore[index]
    env.close()
    return Sizes(
        observation=size, lower=low, upper=high, steps=steps, period=period, terms=TERMS, release=gymnasium.__version__
    )


def scene(config: TaskConfig) -> Scene:
    """What there is to draw.

    Raises:
      ConfigError: as `make`.
    """
    env = make(config)
    env.close()
    return Scene(env.unwrapped.model)  # type: ignore[attr-defined]
