"""Environments of Gymnasium that step their own simulations: making and checking them, and the
engine they are.
"""

import contextlib
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, TaskError
from farm.sim import complaints
from farm.sim.engines import STATE
from farm.sim.scene import quiet

if TYPE_CHECKING:
    import gymnasium

NOMINAL: Final = 0
"""Seed of the reset under nominal conditions."""

_LIMIT: Final = 100_000  # numbers of an observation
_DIMENSIONS: Final = 2  # of a box of numbers; one of more is a picture
_SEEDS: Final = 2**32  # of numpy's old generator, which dm_control uses
_ROWS: Final = 16  # environments that are stepped in turn
_INSTEAD: Final = (
    "not an environment of MuJoCo, and only those can be learnt; take one (gym:Walker2d-v5), or"
    " write its model as a task (farm new-task), which farm run learns, and farm.Farm evaluates for"
    " a search of your own"
)
_UNSTABLE: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def make(name: str, **arguments: Any) -> "gymnasium.Env[Any, Any]":  # noqa: ANN401  whatever it takes
    """The environment of this name, made with these arguments, without its own time limit.

    Raises:
      ConfigError: gymnasium is not installed, there is no such environment, or it cannot be learnt
          here.
    """
    try:
        import gymnasium
    except ImportError:
        raise ConfigError(
            f"task gym:{name} needs gymnasium: pip install 'gymnasium[mujoco]'"
        ) from None
    quiet()
    _check_physics(name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # mostly about newer versions
            env = gymnasium.make(name, max_episode_steps=-1, disable_env_checker=True, **arguments)
            if arguments and isinstance(env.action_space, gymnasium.spaces.Box):
                env.reset(seed=NOMINAL)  # an unusable value may fail only in a step
                env.step(0.5 * (env.action_space.low + env.action_space.high))  # type: ignore[attr-defined]
    except Exception as error:  # an environment may raise anything
        reason = " ".join(str(error).split()) or _place(error)
        only = (
            " (before you do: only environments that MuJoCo simulates can be learnt)"
            if "nstall" in reason
            else ""
        )
        raise ConfigError(f"task gym:{name}: {reason}{only}") from None
    space, actions, box = env.observation_space, env.action_space, gymnasium.spaces.Box
    parts = *simulated(env), getattr(env.unwrapped, "dt", None)
    if not all(map(isinstance, parts, (mujoco.MjModel, mujoco.MjData, float))):
        raise ConfigError(f"task gym:{name}: {_INSTEAD}")
    for where, part in leaves(space):
        if not isinstance(part, box) or len(part.shape) > _DIMENSIONS or part.dtype.kind == "u":
            picture = ", a picture" if isinstance(part, box) else ""
            raise ConfigError(
                f"task gym:{name}: observation{where} is {part}{picture}; expected numbers: a box,"
                " or a dict of boxes"
            )
    size = gymnasium.spaces.flatdim(space)
    if not 0 < size <= _LIMIT:
        raise ConfigError(
            f"task gym:{name}: observations of {size} numbers; expected 1 to {_LIMIT}"
        )
    if not isinstance(actions, box) or len(actions.shape) != 1 or not actions.is_bounded():
        raise ConfigError(
            f"task gym:{name}: actions are {actions}; expected a bounded box of one dimension"
        )
    return env


def _check_physics(name: str) -> None:
    """Check that Gymnasium's own environment is one of MuJoCo, before what it needs is missing.

    Raises:
      ConfigError: it is not; what can be done instead.
    """
    import gymnasium

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            module = str(gymnasium.spec(name).entry_point).partition(":")[0]
    except Exception:  # what is wrong with the name is reported when it is made
        return
    if module.startswith("gymnasium.envs.") and not module.startswith("gymnasium.envs.mujoco"):
        raise ConfigError(f"task gym:{name}: {_INSTEAD}")


def simulated(env: "gymnasium.Env[Any, Any]") -> tuple[mujoco.MjModel, mujoco.MjData]:
    """What an environment simulates: its own model and data, or those in the `physics` of
    dm_control's.
    """
    inner = env.unwrapped
    physics = getattr(inner, "physics", inner)
    parts = (getattr(physics, name, None) for name in ("model", "data"))
    # dm_control wraps MuJoCo's objects
    model, data = (getattr(each, "ptr", each) for each in parts)
    return model, data


def _place(error: Exception) -> str:
    """Where an error without words was raised, such as an assertion."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}, line {last.lineno}: {last.line}"


def leaves(space: Any, where: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401  a space
    """A space's parts that have no parts, each with where it is: "['goal']"."""
    from gymnasium.spaces import Dict, Tuple

    if not isinstance(space, Dict | Tuple):
        yield where, space
        return
    for key, part in space.items() if isinstance(space, Dict) else enumerate(space):
        yield from leaves(part, f"{where}[{key!r}]")


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
        self.model, data = simulated(first)
        self._fresh = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, data, self._fresh, STATE)
        self._physics = hasattr(first.unwrapped, "physics")
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
            "truncated": np.zeros(_ROWS, dtype=bool),
        }

    def field(self, name: str) -> AnyArray:
        """A live array over all rows."""
        if name not in self._fields:
            raise AttributeError(
                f"an environment's sim has no {name!r}; it has {', '.join(self._fields)}"
            )
        return self._fields[name]

    def reset(self, ids: IntArray) -> None:
        """Make as many environments as there are rows; `seed` resets them."""
        while len(self._envs) < len(ids):
            self._envs.append(make(self._name, **self._arguments))

    def seed(self, row: int, seed: int) -> None:
        """Reset an environment to the start that a seed gives."""
        self._seeds[row] = seed
        model, data = simulated(self._envs[row])
        # An environment's own reset may leave some of it
        mujoco.mj_setState(model, data, self._fresh, STATE)
        for kind in _UNSTABLE:
            data.warning[kind].number = 0
        with self._replaced(row):
            x, _ = self._envs[row].reset(seed=seed % _SEEDS if self._physics else seed)
        self._take(row, x, 0.0)

    def step(self, ids: IntArray, count: int) -> None:
        """Step environments by control steps."""
        for row in ids.tolist():
            env: Any = self._envs[row]
            for _ in range(count):
                # dm_control raises an exception where its physics becomes unstable, unless it is
                # told not to
                physics = env.unwrapped.physics if self._physics else None
                calm = physics.suppress_physics_errors() if physics else contextlib.nullcontext()
                with self._replaced(row), calm:
                    x, reward, *over, _ = env.step(self._fields["ctrl"][row].astype(self._kind))
                self._take(row, x, _number(reward), over)

    @contextlib.contextmanager
    def _replaced(self, row: int) -> Iterator[None]:
        """Make an environment anew if it raises an error: nobody knows in what state that leaves
        it.
        """
        try:
            yield
        except Exception:
            with contextlib.suppress(Exception):
                self._envs[row].close()
            self._envs[row] = make(self._name, **self._arguments)
            raise

    def _take(
        self,
        row: int,
        observation: Any,  # noqa: ANN401
        reward: float,
        over: Sequence[bool] = (False, False),
    ) -> None:
        _, data = simulated(self._envs[row])
        # A plain observation is not rounded to the type that the space says
        plain = isinstance(observation, np.ndarray) and observation.ndim == 1
        x: Any = observation if plain else self._flatten(self._space, observation)
        self._bad[row] = not (np.isfinite(x).all() and np.isfinite(reward)) or blown_up(data)
        self._fields["observation"][row] = x
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            self._fields[name][row] = getattr(data, name)
        self._fields["reward"][row] = reward
        self._fields["terminated"][row], self._fields["truncated"][row] = over

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

    def warned(self, ids: IntArray) -> IntArray:
        """How often MuJoCo has warned of each of `complaints.KINDS` in rows, (n, K)."""
        return np.array(
            [complaints.counters(simulated(self._envs[row])[1]) for row in ids.tolist()]
        )

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """Raise an error: an environment observes contact forces itself."""
        raise NotImplementedError

    def expand(self, name: str) -> AnyArray:
        """An environment's model is its own: always a TaskError."""
        raise TaskError(
            f"{name} cannot differ between rollouts in an environment that steps itself"
        )

    def set_const(self, ids: IntArray) -> None:
        """Do nothing: there are no derived constants."""

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()


def _number(reward: Any) -> float:  # noqa: ANN401  what an environment gives
    """A reward as a number: also an array of one number, as Gymnasium's own checks allow.

    Raises:
      TaskError: it is something else.
    """
    values = np.asarray(reward)
    if values.size != 1 or values.dtype.kind not in "biuf":
        got = f"an array of {values.dtype} {values.shape}" if values.ndim else repr(reward)[:60]
        raise TaskError(f"the environment's reward is {got}; expected a number")
    return float(values.reshape(()))


def blown_up(data: mujoco.MjData) -> bool:
    """Whether MuJoCo met numbers out of bounds since the last reset (it then silently restarts from
    the start).
    """
    return any(data.warning[kind].number for kind in _UNSTABLE)
