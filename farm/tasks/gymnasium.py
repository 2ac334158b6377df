"""MuJoCo environments of Gymnasium as tasks, by name: `--task gym:Swimmer-v5`.

Only registered names are accepted: a name with a module to import (`module:Name-v0`) is refused. An
environment steps its own simulation, so this task has its own engine; environments in
`gymnasium_batched.py` are stepped in a batch by the backend, with the same numbers.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import metadata
from typing import TYPE_CHECKING, Any, ClassVar, Final

import mujoco
import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.sim.channels import Quantity
from farm.sim.interfaces import Engine, MakeEngine
from farm.sim.quantities import controls
from farm.sim.sim import Sim
from farm.tasks.actions.space import ActionSpace, rescaled
from farm.tasks.base import STEPS_LIMIT, Task, TaskConfig, TaskSpec
from farm.tasks.gymnasium_batched import Batched, batched
from farm.tasks.gymnasium_engine import NOMINAL, EnvironmentEngine, leaves, make, simulated

if TYPE_CHECKING:
    import gymnasium

_NAME: Final = re.compile(r"([\w.-]{1,60}/)?[\w.-]{1,60}-v\d{1,4}", re.ASCII)
_REFUSED: Final[Mapping[str, str]] = {
    "render_mode": "farm replay and farm play show rollouts",
    "xml_file": "a file does not travel to workers",
    "max_episode_steps": "--steps shortens rollouts",
}


@dataclass(frozen=True, kw_only=True)
class EnvironmentConfig(TaskConfig):
    """Settings of an environment."""

    env_arg: tuple[str, ...] = ()
    """Keyword argument of the environment, repeatable: NAME=VALUE as in JSON
    (terminate_when_unhealthy=false).
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [_argument(argument)[0] for argument in self.env_arg]
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"env-arg: {name} is given twice")

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the environment."""
        return dict(_argument(argument) for argument in self.env_arg)


def _argument(argument: object) -> tuple[str, Any]:
    """Name and value in NAME=VALUE."""
    name, equals, text = argument.partition("=") if isinstance(argument, str) else ("", "", "")
    if not (name.isidentifier() and equals):
        raise ConfigError(
            f"env-arg is {str(argument)[:80]!r}; expected NAME=VALUE, for example"
            " terminate_when_unhealthy=false"
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
    steps: int = 0  # as many as the environment has, unless a subclass says otherwise
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "policy": "linear",
            "normalise": True,
            "algorithm": "ars",
            "initial_sigma": 0.05,
            "learning_rate_mu": 0.05,
            "validate": True,
        },
    }

    def __init__(
        self,
        config: Any = None,  # noqa: ANN401
        variant: str = "",
        files: Mapping[str, str] | None = None,
    ) -> None:
        """Check the environment's name and its spaces.

        Raises:
          ConfigError: gymnasium is not installed, there is no such environment, or it cannot be
              learnt here.
        """
        super().__init__(config, variant, files)
        if ":" in variant:
            raise ConfigError(
                f"task 'gym:{variant[:80]}' names a module to import, which is refused; take"
                " gym:NAME-vN"
            )
        if not _NAME.fullmatch(variant):
            raise ConfigError(
                f"task 'gym:{variant[:80]}' is no environment's name; expected gym:NAME-vN"
            )
        if isinstance(space := type(self).actions, ActionSpace):
            raise ConfigError(
                f"task {type(self).__name__}: actions is a {type(space).__name__}, but those of"
                " an environment are Gymnasium's: leave it out, or give the environment a wrapper"
            )
        self.steps = self._horizon()
        self.batched: Batched | None = batched(self._first)
        if self.batched is not None:
            self.substeps = self.batched.env.frame_skip

    @cached_property
    def _first(self) -> "gymnasium.Env[Any, Any]":
        return make(self.variant, **self.config.arguments)

    def _horizon(self) -> int:
        _ = self._first  # made first: it reports errors in the name
        usual = type(self).steps
        if type(usual) is not int or not 0 <= usual <= STEPS_LIMIT:
            raise ConfigError(
                f"task {type(self).__name__}: steps is {usual!r:.40}; expected a whole number up to"
                f" {STEPS_LIMIT}"
            )
        steps = self.config.steps or usual
        import gymnasium

        limit = gymnasium.spec(self.variant).max_episode_steps
        if limit and steps > limit:
            which = "--steps" if self.config.steps else f"task {type(self).__name__}: steps is"
            raise ConfigError(f"{which} {steps}: task gym:{self.variant} ends after {limit}")
        if not (limit or steps):
            raise ConfigError(
                f"task gym:{self.variant} ends at no number of steps: give it one with --steps"
            )
        return min(steps or STEPS_LIMIT, limit or STEPS_LIMIT)

    def compiled(self) -> mujoco.MjModel:
        """The environment's own model."""
        return simulated(self._first)[0]

    def mjcf(self) -> str:
        """An environment has no text of its own: always a ConfigError."""
        raise ConfigError(
            f"gym:{self.variant} is made by gymnasium: there is no MJCF text to export"
        )

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
            observation=gymnasium.spaces.flatdim(self._first.observation_space),
            action=len(self.limits[0]),
            steps=self.steps,
            period=self.period,
            release=_releases(self._first),
        )

    @property
    def observations(self) -> tuple[Quantity, ...]:  # type: ignore[override]  # the space's
        """The numbers of the flattened space, with its bounds: those of joints by name where they
        are known, others are counted: "achieved_goal 0".
        """
        of_joints = () if self.batched is None else self.batched.states
        numbers = [
            Quantity(f"{_words(where)} {i}", "", float(low), float(high))
            for where, box in leaves(self._first.observation_space)
            for i, (low, high) in enumerate(zip(box.low.ravel(), box.high.ravel(), strict=True))
        ]
        states = [
            replace(number, name=state.name, unit=state.unit)
            for number, state in zip(numbers, of_joints, strict=False)
        ]
        return (*states, *numbers[len(states) :])

    @property
    def actions(self) -> tuple[Quantity, ...]:  # type: ignore[override]  # the space's
        """The action's numbers, by the model's actuators if there are as many: -1 is the
        environment's smallest value, 1 its largest.
        """
        count = len(self.limits[0])
        names = [each.name for each in controls(self.model)]
        if len(names) != count:
            names = [f"action {i}" for i in range(count)]
        return tuple(Quantity(name, "", -1.0, 1.0) for name in names)

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
        """Which environments ended their episodes, (B,)."""
        if self.batched is not None:
            return self.batched.ended(sim)
        # All end with the last step
        return np.asarray(sim.terminated | (sim.truncated & (sim.t < self.steps)))


def _words(where: str) -> str:
    """Where a part of an observation is, in words: "['goals'][0]" is "goals 0"."""
    return " ".join(re.findall(r"[\w-]+", where)) or "observation"


def _releases(env: "gymnasium.Env[Any, Any]") -> str:
    """Releases of Gymnasium and of the packages that an environment's numbers come from."""
    inner = env.unwrapped
    kinds = (type(inner), type(getattr(inner, "physics", inner)))
    modules = dict.fromkeys(("gymnasium", *(kind.__module__.partition(".")[0] for kind in kinds)))
    distributions = (
        metadata.packages_distributions() if len(modules) > 1 else {"gymnasium": ["gymnasium"]}
    )
    packages = [name for module in modules for name in sorted(set(distributions.get(module, ())))]
    return ", ".join(f"{name} {metadata.version(name)}" for name in packages)


def reset_seed(rng: np.random.Generator | None) -> int:
    """Seed of an environment's reset: always the same one, or 128 bits drawn from the generator's
    own seed.
    """
    if rng is None:
        return NOMINAL
    words = rng.bit_generator.seed_seq.generate_state(4)  # type: ignore[attr-defined]
    return int.from_bytes(words.astype("<u4").tobytes(), "little")
