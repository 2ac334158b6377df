"""A task as environments of Gymnasium: one, or several that share engines."""

from collections.abc import Callable
from typing import Any, Final, Literal, TypeAlias

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from farm.arrays import AnyArray, BoolArray, FloatArray
from farm.errors import ConfigError, TaskError
from farm.seeds import SEEDS, evaluation_start
from farm.sim.rendering import Painter
from farm.tasks.actions import numbers
from farm.tasks.base import Task
from farm.tasks.episodes import Episodes
from farm.tasks.loop import scores
from farm.tasks.probe import specification
from farm.tasks.rollouts import Seed

Infos: TypeAlias = dict[str, Any]

_SIZE: Final = (480, 360)  # width and height of a picture


class _Interface:
    """What one environment and several have in common: spaces, starts, and checks of actions."""

    def __init__(self, task: Task, count: int) -> None:
        """Find the task's sizes; a ConfigError if no control step has a reward."""
        if scores(task):
            raise ConfigError(
                f"task {type(task).__name__} scores whole rollouts (score), so a control step has "
                "no reward of its own: an environment needs reward(self, sim, action)"
            )
        self.task = task
        self.spec = specification(task)
        self.success = self.spec.success or type(task).success is not Task.success
        self.observations = Box(-np.inf, np.inf, (self.spec.observation,), np.float64)
        bounds = [(each.low, each.high) for each in numbers.described(task, self.spec.action)]
        limits = [each if np.isfinite(each).all() else (-1.0, 1.0) for each in bounds]
        self.actions = Box(*np.array(limits).T, dtype=np.float64)
        self.episodes = Episodes(task, count, self.spec.observation, len(self.spec.terms))
        self._closed = False

    def close(self) -> None:
        """Release the engines."""
        self._closed = True
        self.episodes.close()

    def check(self) -> None:
        """Check that it is not closed; a TaskError otherwise."""
        if self._closed:
            raise TaskError("the environment is closed; make another one")

    def start(self, seed: int | None, rng: np.random.Generator) -> Seed:
        """Which start an episode has: a seed's, as `farm evaluate` counts, or one that is drawn."""
        if not self.task.config.perturb:
            return None
        return evaluation_start(0, int(rng.integers(SEEDS)) if seed is None else seed % SEEDS)

    def taken(self, action: object, shape: tuple[int, ...], over: BoolArray) -> FloatArray:
        """Actions (B, A) from an array of this shape; 0 where the episode is over, (B,).

        Raises:
          TaskError: the shape is another, or a number that counts is not finite.
        """
        try:
            values = np.asarray(action).astype(np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        fits = values.shape == shape
        values = np.where(over[:, None], 0.0, values) if fits else values
        if not fits or not np.isfinite(values).all():
            text = " ".join(repr(action).split())
            raise TaskError(f"action is {text:.60}; expected {shape} finite numbers")
        return values


class FarmEnv(gymnasium.Env[FloatArray, FloatArray]):
    """A task as an environment: an episode is a rollout of the farm, to the last bit.

    `reset(seed=7)` is start 7 of `farm evaluate`, and of `farm.Farm`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(self, task: Task, render_mode: Literal["rgb_array"] | None = None) -> None:
        """Find the task's sizes."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode is {render_mode!r:.40}; expected 'rgb_array' or None")
        self._is = _Interface(task, 1)
        self.observation_space = self._is.observations
        self.action_space = self._is.actions
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self._is.spec.period))}
        self._going = False
        self._painter: Painter | None = None

    @property
    def name(self) -> str:
        """Name of the task's class."""
        return type(self._is.task).__name__

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, Infos]:
        """Begin a rollout from the start for a seed, or one that `np_random` draws.

        If nothing perturbs (the task's setting `perturb`), all have the nominal start.
        """
        self._is.check()
        super().reset(seed=seed, options=options)
        self._is.episodes.stop()
        self._is.episodes.begin(np.arange(1), [self._is.start(seed, self.np_random)])
        self._going = True
        self._forget()
        return self._is.episodes.last.observation[0].copy(), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, Infos]:
        """Take one control step.

        Raises:
          TaskError: before `reset`, or after the episode's end.
        """
        self._is.check()
        if not self._going:
            raise TaskError("no episode is on its way: call reset()")
        last = self._is.episodes.last
        action = self._is.taken(action, (self._is.spec.action,), np.zeros(1, dtype=bool))
        self._is.episodes.step(action)
        terminated = bool(last.terminated[0])
        truncated = bool(last.truncated[0])
        self._going = not (terminated or truncated)
        reward_terms = dict(zip(self._is.spec.terms, last.terms[0].tolist(), strict=True))
        info: Infos = {"reward_terms": reward_terms, "failed": bool(last.failed[0])}
        if self._is.success:
            info["is_success"] = bool(last.success[0])
        reward = float(last.terms.sum(axis=-1)[0])
        return last.observation[0].copy(), reward, terminated, truncated, info

    def render(self) -> AnyArray | None:  # type: ignore[override]  (Gymnasium's may be a list)
        """A picture with the task's channels, (360, 480, 3); None without a render mode."""
        self._is.check()
        if self.render_mode is None:
            return None
        task = self._is.task
        frame, which = self._is.episodes.frame(0)
        mocap = frame.get("mocap")
        if self._painter is None:
            self._painter = Painter(
                task.simulated[which],
                frame["qpos"],
                _SIZE,
                camera=task.camera,
                mocap=mocap,
                channels=task.channels,
            )
        arrays = task.show({name: values[None] for name, values in frame.items()})
        values = {each.name: arrays[each.name][0] for each in task.channels}
        return self._painter.picture(frame["qpos"], mocap, values)

    def close(self) -> None:
        """Release the simulation and the renderer."""
        self._forget()
        self._is.close()

    def _forget(self) -> None:
        """The next picture is framed anew: a camera follows what moves from where it starts."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None


class FarmVectorEnv(gymnasium.vector.VectorEnv[FloatArray, FloatArray, AnyArray]):
    """Environments of a task, stepped together: those that began together share an engine.

    Each gives the numbers of a `FarmEnv`. One that has ended begins anew in the next step, which
    ignores its action.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}

    def __init__(self, task: Task, num_envs: int) -> None:
        """Find the task's sizes."""
        self._is = _Interface(task, num_envs)
        self.num_envs = num_envs
        self.single_observation_space = self._is.observations
        self.single_action_space = self._is.actions
        self.observation_space = batch_space(self._is.observations, num_envs)
        self.action_space = batch_space(self._is.actions, num_envs)
        self._rngs: list[np.random.Generator] = []
        self._over: BoolArray | None = None

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002  there are none
    ) -> tuple[FloatArray, Infos]:
        """Begin all: a number is the first's seed, the next has the next one; or one for each."""
        self._is.check()
        seeds = [seed] * self.num_envs if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            expected = f"{self.num_envs}, one for each environment"
            raise ConfigError(f"{len(seeds)} seeds; expected {expected}")
        old = self._rngs or [None] * self.num_envs
        self._rngs = [
            rng if rng is not None and each is None else seeding.np_random(each)[0]
            for rng, each in zip(old, seeds, strict=True)
        ]
        starts = [self._is.start(each, rng) for each, rng in zip(seeds, self._rngs, strict=True)]
        self._is.episodes.stop()
        self._is.episodes.begin(np.arange(self.num_envs), starts)
        self._over = np.zeros(self.num_envs, dtype=bool)
        return self._is.episodes.last.observation.copy(), {}

    def step(
        self,
        actions: FloatArray,
    ) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, Infos]:
        """Take one control step in all environments; episodes that were over begin anew.

        Raises:
          TaskError: before `reset`.
        """
        self._is.check()
        if self._over is None:
            raise TaskError("no episode is on its way: call reset()")
        last = self._is.episodes.last
        anew = np.flatnonzero(self._over)
        shape = (self.num_envs, self._is.spec.action)
        self._is.episodes.step(self._is.taken(actions, shape, self._over))
        if len(anew):
            starts = [self._is.start(None, self._rngs[i]) for i in anew.tolist()]
            self._is.episodes.begin(anew, starts)
        self._over = last.terminated | last.truncated
        stepped = np.ones(self.num_envs, dtype=bool)
        stepped[anew] = False
        terms = dict(zip(self._is.spec.terms, last.terms.T.copy(), strict=True))
        details: Infos = {"reward_terms": _of(terms, stepped), "failed": last.failed.copy()}
        if self._is.success:
            details["is_success"] = last.success.copy()
        infos = _of(details, stepped)
        rewards = last.terms.sum(axis=-1)
        ends = last.terminated.copy(), last.truncated.copy()
        return last.observation.copy(), rewards, *ends, infos

    def close_extras(self, **_: Any) -> None:  # noqa: ANN401
        """Release the engines."""
        self._is.close()


def _of(infos: Infos, stepped: BoolArray) -> Infos:
    """Infos with a mask of the environments that they are of, as Gymnasium's vectors have them."""
    return infos | {f"_{name}": stepped.copy() for name in infos}


def described(name: str, make: Callable[..., FarmEnv]) -> EnvSpec:
    """What Gymnasium knows of an environment that is in no registry: how to make it again."""
    return EnvSpec(f"rolloutfarm/{name}-v0", entry_point=make)
