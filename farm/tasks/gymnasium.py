"""MuJoCo environments of Gymnasium as tasks, by name: `--task gym:Swimmer-v5`.

Only registered names are accepted: a name with a module to import (`module:Name-v0`) is refused. An environment
steps its own simulation, so this task has its own engine; environments in `gymnasium_batched.py` are stepped in a
batch by the backend, with the same numbers.
"""

import json
import re
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.sim.engines import STATE
from farm.sim.interfaces import Engine, MakeEngine
from farm.sim.scene import quiet
from farm.sim.sim import Sim
from farm.tasks.base import STEPS_LIMIT, Task, TaskConfig, TaskSpec, rescaled
from farm.tasks.gymnasium_batched import batched

if TYPE_CHECKING:
    import gymnasium

NOMINAL: Final = 0
"""Seed of the reset under nominal conditions."""

_NAME: Final = re.compile(r"([\w.-]{1,60}/)?[\w.-]{1,60}-v\d{1,4}", re.ASCII)
_REFUSED: Final[Mapping[str, str]] = {
    "render_mode": "farm replay and farm play show rollouts",
    "xml_file": "a file does not travel to workers",
    "max_episode_steps": "--steps shortens rollouts",
}
_LIMIT: Final = 100_000  # numbers of an observation
_DIMENSIONS: Final = 2  # of a box of numbers; one of more is a picture
_ROWS: Final = 16  # environments that are stepped in turn
_UNSTABLE: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


@dataclass(frozen=True, kw_only=True)
class EnvironmentConfig(TaskConfig):
    """Settings of an environment."""

    env_arg: tuple[str, ...] = ()
    """Keyword argument of the environment, repeatable: NAME=VALUE as in JSON (terminate_when_unhealthy=false)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [_argument(said)[0] for said in self.env_arg]
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"env-arg: {name} is given twice")

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the environment."""
        return dict(_argument(said) for said in self.env_arg)


def _argument(said: object) -> tuple[str, Any]:
    """Name and value in NAME=VALUE."""
    name, equals, text = said.partition("=") if isinstance(said, str) else ("", "", "")
    if not (name.isidentifier() and equals):
        raise ConfigError(
            f"env-arg is {str(said)[:80]!r}; expected NAME=VALUE, for example terminate_when_unhealthy=false"
        )
    if name in _REFUSED:
        raise ConfigError(f"env-arg {name} is not taken: {_REFUSED[name]}")
    try:
        return name, json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigError(
            f"env-arg {name} is {text[:80]!r}; expected a value of JSON (texts in double quotes)"
        ) from None


class Environment(Task):
    """A MuJoCo environment of Gymnasium: its own physics, observations and rewards."""

    Config = EnvironmentConfig
    takes = "NAME"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "policy": "linear", "normalise": True, "algorithm": "ars", "initial_sigma": 0.05, "learning_rate_mu": 0.05,
        },
    }  # fmt: skip

    def __init__(self, config: Any = None, variant: str = "", files: Mapping[str, str] | None = None) -> None:  # noqa: ANN401
        """Check the environment's name and its spaces.

        Raises:
          ConfigError: gymnasium is not installed, there is no such environment, or it cannot be learnt here.
        """
        super().__init__(config, variant, files)
        if ":" in variant:
            raise ConfigError(f"task 'gym:{variant[:80]}' names a module to import, which is refused; take gym:NAME-vN")
        if not _NAME.fullmatch(variant):
            raise ConfigError(f"task 'gym:{variant[:80]}' is no environment's name; expected gym:NAME-vN")
        self.steps = self._horizon()
        self.batched = batched(self._first)
        if self.batched is not None:
            self.substeps = self.batched.env.frame_skip

    @cached_property
    def _first(self) -> "gymnasium.Env[Any, Any]":
        return make(self.variant, **self.config.arguments)

    def _horizon(self) -> int:
        wanted, _ = self.config.steps, self._first  # made first: it reports errors in the name
        import gymnasium

        own = gymnasium.spec(self.variant).max_episode_steps
        if own and wanted > own:
            raise ConfigError(f"--steps {wanted}: task gym:{self.variant} ends after {own}")
        if not (own or wanted):
            raise ConfigError(f"task gym:{self.variant} ends at no number of steps: give it one with --steps")
        return min(wanted or STEPS_LIMIT, own or STEPS_LIMIT)

    def compiled(self) -> mujoco.MjModel:
        """The environment's own model."""
        model: mujoco.MjModel = self._first.unwrapped.model  # type: ignore[attr-defined]
        return model

    def mjcf(self) -> str:
        """An environment has no text of its own: always a ConfigError."""
        raise ConfigError(f"gym:{self.variant} is made by gymnasium: there is no MJCF text to export")

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest action, (A,) each."""
        space: Any = self._first.action_space
        return space.low.astype(float), space.high.astype(float)

    @property
    def period(self) -> float:
        """A control step [s]."""
        return float(self._first.unwrapped.dt)  # type: ignore[attr-defined]

    def spec(self) -> TaskSpec:
        """The sizes of the environment's spaces."""
        import gymnasium

        return TaskSpec(
            observation=gymnasium.spaces.flatdim(self._first.observation_space), action=len(self.limits[0]),
            steps=self.steps, period=self.period, release=f"gymnasium {gymnasium.__version__}",
        )  # fmt: skip

    def engine(self, backend: MakeEngine) -> Engine:
        """The backend's engine, or an engine of environments that step themselves."""
        if self.batched is not None:
            return backend(self.model)
        return EnvironmentEngine(self.variant, **self.config.arguments)

    def prepare(self, sim: Sim, rngs: Sequence[np.random.Generator | None]) -> None:
        """Reset each environment with its own seed."""
        for row, rng in enumerate(rngs):
            seed = reset_seed(rng)
            if self.batched is None:
                assert isinstance(sim.engine, EnvironmentEngine)
                sim.engine.seed(row, seed)
            else:  # as in Gymnasium
                sim.qpos[row], sim.qvel[row] = self.batched.start(np.random.default_rng(seed))

    def observe(self, sim: Sim) -> FloatArray:
        """The environment's observation, (B, d)."""
        values: FloatArray = sim.observation if self.batched is None else self.batched.observe(sim)
        return values

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Actions rescaled to the environment's bounds and rounded to its precision, (B, A)."""
        if self.batched is not None:
            sim.own["before"] = self.batched.before(sim)
        return rescaled(action, *self.limits).astype(self._first.action_space.dtype).astype(float)

    def reward(self, sim: Sim, action: FloatArray) -> FloatArray:  # noqa: ARG002
        """The environment's reward, (B,)."""
        if self.batched is None:
            values: FloatArray = sim.reward
            return values
        with np.errstate(all="ignore"):  # of an unstable state
            return self.batched.reward(sim, sim.own["before"])

    def ended(self, sim: Sim) -> BoolArray:
        """Which environments terminated, (B,)."""
        return np.asarray(sim.terminated) if self.batched is None else self.batched.ended(sim)


def make(name: str, **arguments: Any) -> "gymnasium.Env[Any, Any]":  # noqa: ANN401  whatever it takes
    """The environment of this name, made with these arguments, without its own time limit.

    Raises:
      ConfigError: gymnasium is not installed, there is no such environment, or it cannot be learnt here.
    """
    try:
        import gymnasium
    except ImportError:
        raise ConfigError(f"task gym:{name} needs gymnasium: pip install 'gymnasium[mujoco]'") from None
    quiet()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # mostly about newer versions
            env = gymnasium.make(name, max_episode_steps=-1, disable_env_checker=True, **arguments)
            if arguments:  # an unusable value may fail only in a step
                env.reset(seed=NOMINAL)
                env.step(0.5 * (env.action_space.low + env.action_space.high))  # type: ignore[attr-defined]
    except Exception as error:  # an environment may raise anything
        said = " ".join(str(error).split()) or _place(error)
        raise ConfigError(f"task gym:{name}: {said}") from None
    space, actions, inner, box = env.observation_space, env.action_space, env.unwrapped, gymnasium.spaces.Box
    own = (("model", mujoco.MjModel), ("data", mujoco.MjData), ("dt", float))
    if not all(isinstance(getattr(inner, what, None), kind) for what, kind in own):
        raise ConfigError(f"task gym:{name}: not an environment of MuJoCo")
    for where, part in _leaves(space):
        if not isinstance(part, box) or len(part.shape) > _DIMENSIONS or part.dtype.kind == "u":
            picture = ", a picture" if isinstance(part, box) else ""
            raise ConfigError(
                f"task gym:{name}: observation{where} is {part}{picture}; expected numbers: a box, or a dict of boxes"
            )
    size = gymnasium.spaces.flatdim(space)
    if not 0 < size <= _LIMIT:
        raise ConfigError(f"task gym:{name}: observations of {size} numbers; expected 1 to {_LIMIT}")
    if not isinstance(actions, box) or len(actions.shape) != 1 or not actions.is_bounded():
        raise ConfigError(f"task gym:{name}: actions are {actions}; expected a bounded box of one dimension")
    return env


def _place(error: Exception) -> str:
    """Where an error without words was raised, such as an assertion."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}, line {last.lineno}: {last.line}"


def _leaves(space: Any, where: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401  a space
    """A space's parts that have no parts, each with where it is: "['goal']"."""
    parts = getattr(space, "spaces", None)  # of a Dict, by name, or of a Tuple
    if parts is None:
        yield where, space
        return
    for key, part in parts.items() if isinstance(parts, Mapping) else enumerate(parts):
        yield from _leaves(part, f"{where}[{key!r}]")


class EnvironmentEngine:
    """One environment per row; each steps its own simulation."""

    writable: ClassVar[tuple[str, ...]] = ()  # its arrays are copies of what an environment has

    def __init__(self, name: str, **arguments: Any) -> None:  # noqa: ANN401  whatever an environment takes
        """Make the first environment; more are made as they are needed."""
        from gymnasium.spaces import flatdim, flatten

        self._flatten = flatten
        self.size = _ROWS
        self._name, self._arguments = name, arguments
        self._envs = [make(name, **arguments)]
        first: Any = self._envs[0]
        self.model: mujoco.MjModel = first.unwrapped.model
        self._fresh = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, first.unwrapped.data, self._fresh, STATE)
        self._kind, self._space = first.action_space.dtype, first.observation_space
        self._seeds = [NOMINAL] * _ROWS
        self._bad = np.zeros(_ROWS, dtype=bool)
        self._fields: dict[str, AnyArray] = {
            "ctrl": np.zeros((_ROWS, first.action_space.shape[0])),
            "qpos": np.zeros((_ROWS, self.model.nq)),
            "mocap_pos": np.zeros((_ROWS, self.model.nmocap, 3)),
            "mocap_quat": np.zeros((_ROWS, self.model.nmocap, 4)),
            "observation": np.zeros((_ROWS, flatdim(self._space))),
            "reward": np.zeros(_ROWS),
            "terminated": np.zeros(_ROWS, dtype=bool),
        }

    def field(self, name: str) -> AnyArray:
        """A live array over all rows."""
        if name not in self._fields:
            raise AttributeError(f"an environment's sim has no {name!r}; it has {', '.join(self._fields)}")
        return self._fields[name]

    def reset(self, ids: IntArray) -> None:
        """Make as many environments as there are rows; `seed` resets them."""
        while len(self._envs) < len(ids):
            self._envs.append(make(self._name, **self._arguments))

    def seed(self, row: int, seed: int) -> None:
        """Reset an environment to the start that a seed gives."""
        self._seeds[row] = seed
        env: Any = self._envs[row].unwrapped
        mujoco.mj_setState(env.model, env.data, self._fresh, STATE)  # an environment's own reset may leave some of it
        for kind in _UNSTABLE:
            env.data.warning[kind].number = 0
        x, _ = self._envs[row].reset(seed=seed)
        self._take(row, x, 0.0)

    def step(self, ids: IntArray, count: int) -> None:
        """Step environments by control steps."""
        for row in ids.tolist():
            for _ in range(count):
                x, reward, terminated, *_ = self._envs[row].step(self._fields["ctrl"][row].astype(self._kind))
                self._take(row, x, float(reward), terminated=bool(terminated))

    def _take(self, row: int, seen: Any, reward: float, *, terminated: bool = False) -> None:  # noqa: ANN401
        env: Any = self._envs[row].unwrapped
        plain = isinstance(seen, np.ndarray) and seen.ndim == 1  # not rounded to what the space says
        x: Any = seen if plain else self._flatten(self._space, seen)
        self._bad[row] = not (np.isfinite(x).all() and np.isfinite(reward)) or blown_up(env)
        self._fields["observation"][row] = x
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            self._fields[name][row] = getattr(env.data, name)
        self._fields["reward"][row], self._fields["terminated"][row] = reward, terminated

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Environments are stepped by actions only."""
        raise NotImplementedError

    def forward(self, ids: IntArray) -> None:
        """An environment's outputs are available after each step."""

    def copy(self, sources: IntArray) -> None:
        """Reset row i with the seed of row sources[i]."""
        self.reset(sources)
        seeds = [self._seeds[source] for source in sources.tolist()]
        for row, (source, seed) in enumerate(zip(sources.tolist(), seeds, strict=True)):
            if row != source or self._seeds[row] != seed:
                self.seed(row, seed)

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Which simulations became unstable or have a number that is not finite."""
        return self._bad[ids]

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """Not available: an environment observes them itself."""
        raise NotImplementedError

    def expand(self, name: str) -> AnyArray:
        """An environment's model is its own."""
        raise NotImplementedError(name)

    def set_const(self, ids: IntArray) -> None:
        """Nothing to do: there are no derived constants."""

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()


def reset_seed(rng: np.random.Generator | None) -> int:
    """Seed of an environment's reset: always the same one, or 128 bits drawn from the generator's own seed."""
    if rng is None:
        return NOMINAL
    words = rng.bit_generator.seed_seq.generate_state(4)  # type: ignore[attr-defined]
    return int.from_bytes(words.astype("<u4").tobytes(), "little")


def blown_up(env: Any) -> bool:  # noqa: ANN401  an unwrapped environment
    """Whether MuJoCo met numbers out of bounds since the last reset (it then silently restarts from the start)."""
    return any(env.data.warning[kind].number for kind in _UNSTABLE)
