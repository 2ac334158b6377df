"""The base class of tasks, and the specification that other code knows of a task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.settings import Settings, setting
from farm.sim.channels import Camera, Channel

if TYPE_CHECKING:
    import mujoco

    from farm.sim.sim import Engine, MakeEngine, Sim

STEPS_LIMIT: Final = 10_000
"""Control steps of a rollout, at most."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Settings):
    """Settings that every task has; a task's own `Config` adds to them."""

    steps: int = setting(0, least=0, most=STEPS_LIMIT)
    """Control steps of a rollout; 0: the task's own number."""
    gamma: float = setting(1.0, above=0.0, most=1.0)
    """Discount factor of the return, per control step."""
    perturb: bool = True
    """Train with random starts and conditions (the same for both rollouts of a pair)."""
    reward_offset: float = setting(0.0, least=-1e6, most=1e6)
    """Added to the reward of every control step, for learning only: -1 removes a bonus of 1 for not falling."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpec:
    """What learner and workers must know of a task before anything is simulated."""

    observation: int
    """Length d of the observation x."""
    action: int
    """Length A of the action."""
    steps: int
    """Control steps of a rollout, at most."""
    period: float
    """A control step [s]."""
    terms: tuple[str, ...] = ("reward",)
    """Names of the reward's terms."""
    success: bool = False
    """Whether a rollout can succeed; otherwise there are only returns."""
    channels: tuple[Channel, ...] = ()
    """Channels that a rollout shows."""
    release: str = ""
    """Release of the task's package; empty for the farm's own and for files."""

    def shapes(self, bodies: int) -> dict[str, tuple[int, ...]]:
        """Shape of a frame of each of a trajectory's arrays, by the names of `Trajectory.arrays`."""
        own = {"bodies": (bodies, 7), "actions": (self.action,), "terms": (len(self.terms),)}
        return own | {f"channels/{channel.name}": channel.shape for channel in self.channels}

    @property
    def traced(self) -> tuple[Channel, ...]:
        """The channels whose values are sent with results."""
        return tuple(channel for channel in self.channels if channel.trace)

    @property
    def trace(self) -> tuple[int, int]:
        """Shape of a rollout's trace: control steps, and numbers per step (0 if there are no traced channels)."""
        return self.steps, sum(int(np.prod(channel.shape)) for channel in self.traced)


@dataclass(frozen=True)
class Record:
    """Whole rollouts, for tasks that score them at once: T control steps of B rollouts, zero after the end."""

    frames: Mapping[str, FloatArray]
    """What `Task.measure` gave after each step, (B, T, ...)"""
    start: Mapping[str, FloatArray]
    """The same at the start, (B, ...)"""
    actions: FloatArray
    """(B, T, A)"""
    steps: IntArray
    """Control steps of each including its last, (B,)"""
    failed: BoolArray
    """Whether the simulation became unstable in the last of them, (B,)"""


@dataclass(frozen=True)
class Score:
    """Scores of whole rollouts."""

    terms: FloatArray
    """Reward terms, zero after the end, (B, T, K)"""
    success: BoolArray | None = None
    """(B,), None if the task does not define success"""


class Task:
    """A task: what is simulated, what a policy sees and does, and its reward.

    `xml` and `reward` are enough for a subclass. Everything is batched: B rollouts at a time, whose numbers must not
    depend on each other. `sim` is the batch as named live arrays (`farm.sim.sim.Sim`); a task sees nothing else of a
    simulator. The object holds no state of a rollout. What must be remembered is kept in `sim.own`, arrays (B, ...)
    whose rows stay with their rollouts when other rollouts end.
    """

    Config: ClassVar[type[TaskConfig]] = TaskConfig
    """The task's own settings: flags, help and config.json follow from its fields."""
    xml: ClassVar[str] = ""
    """MJCF of what is simulated; or override `files` or `compiled`."""
    steps: int = 100
    """Control steps of a rollout."""
    substeps: int = 1
    """Physics steps in each."""
    channels: tuple[Channel, ...] = ()
    """What a rollout shows in addition to bodies, actions and reward terms."""
    camera: Camera | None = None
    """Point of view of pictures; by default from the side of the moving bodies."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"default": {}}
    """Settings that runs start from, by preset and flag; the first preset is the default."""
    return_scale: float = 1.0
    """Factor of the return."""
    parts: tuple[int, ...] = ()
    """Sizes of the observation's parts if they differ in kind; empty: one part."""
    ends: tuple[str, str] | None = None
    """Names of the states in which rollouts begin and should end; with `reached` and `lost` policies can be chained."""
    ending: ClassVar[str] = "ended"
    """One word for a rollout that `ended` ends, and so a flag: `farm replay RUN --dropped 5` if it is "dropped"."""
    takes: ClassVar[str] = ""
    """What the part after the colon in the task's name means, for tasks with variants: `--task gym:NAME`."""

    def __init__(
        self, config: TaskConfig | None = None, variant: str = "", files: Mapping[str, str] | None = None
    ) -> None:
        """Take settings, the name after the colon, and the run's texts (by default this machine's)."""
        self.config: Any = self.Config() if config is None else config
        self.variant = variant
        if self.config.steps:
            self.steps = self.config.steps
        self.sources: Mapping[str, str] = self.files() if files is None else files
        self._model: mujoco.MjModel | None = None

    # Simulation

    def files(self) -> dict[str, str]:
        """Texts that decide numbers and are sent with a run, by name."""
        return {"model.xml": self.xml} if self.xml else {}

    @property
    def model(self) -> "mujoco.MjModel":
        """The compiled model; made once."""
        if self._model is None:
            self._model = self.compiled()
        return self._model

    def compiled(self) -> "mujoco.MjModel":
        """Compile the model."""
        from farm.sim.scene import compiled

        return compiled(self.mjcf(), type(self).__name__)

    def mjcf(self) -> str:
        """The model as one MJCF text, from `sources`."""
        if "model.xml" not in self.sources:
            raise ConfigError(f"task {type(self).__name__} has no model: give it `xml`, an MJCF text")
        return self.sources["model.xml"]

    def engine(self, backend: "MakeEngine") -> "Engine":
        """The simulation engine: the backend's for the model, unless the task has its own."""
        return backend(self.model)

    def setup(self, sim: "Sim") -> None:
        """Compute once, before the first rollout, what all rollouts need and none changes."""

    # A rollout

    def prepare(self, sim: "Sim", rngs: Sequence[np.random.Generator | None]) -> None:
        """Prepare the start of every rollout of the batch; one generator each, None for nominal conditions."""
        for row, rng in enumerate(rngs):
            self.reset(sim, row, rng)

    def reset(self, sim: "Sim", row: int, rng: np.random.Generator | None) -> None:
        """Prepare one rollout's start from the model's initial state; `rng` is its own, None for nominal conditions."""

    def observe(self, sim: "Sim") -> FloatArray:
        """What the policy sees, (B, d); qpos and qvel unless overridden."""
        return np.concatenate([sim.qpos, sim.qvel], axis=1)

    def act(self, sim: "Sim", action: FloatArray) -> FloatArray:  # noqa: ARG002
        """Controls of raw actions (B, A); -1 to 1 rescaled to the actuators' ranges unless overridden."""
        low, high = self.limits
        return rescaled(action, low, high)

    def reward(self, sim: "Sim", action: FloatArray) -> FloatArray | dict[str, FloatArray]:  # noqa: ARG002
        """Reward of the control step that just ended, (B,); or named terms that add up to it."""
        raise ConfigError(f"task {type(self).__name__} has no reward: give it reward(self, sim, action), or score")

    def ended(self, sim: "Sim") -> BoolArray | None:  # noqa: ARG002
        """Which rollouts end here, (B,); None: none before its last step."""
        return None

    def success(self, sim: "Sim") -> BoolArray | None:  # noqa: ARG002
        """Which of the rollouts that end here succeeded, (B,); None if success is not defined."""
        return None

    def reached(self, sim: "Sim") -> BoolArray:
        """Which rollouts have reached the end named in `ends`, (B,): the next policy of a chain may act."""
        raise NotImplementedError

    def lost(self, sim: "Sim") -> BoolArray:
        """Which rollouts of a chain are lost for good, (B,)."""
        raise NotImplementedError

    def measure(self, sim: "Sim") -> dict[str, FloatArray]:  # noqa: ARG002
        """Values kept of every frame, (B, ...) each: those of channels, or those that `score` and `show` need."""
        return {}

    # Whole rollouts

    def score(self, record: Record) -> Score | None:  # noqa: ARG002
        """Score whole rollouts at once instead of by `reward` and `success`; None: do not."""
        return None

    def show(self, frames: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of the channels from what was measured, any leading shape; those measured under their names."""
        return {channel.name: frames[channel.name] for channel in self.channels}

    def exported(self) -> dict[str, Any]:
        """What an exported policy needs in addition to model, policy and start: arrays, numbers and texts, by name."""
        return {}

    # What other code knows of it

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest control of each actuator, (nu,) each; -1 and 1 if it has no range."""
        limited = self.model.actuator_ctrllimited.astype(bool)
        low, high = self.model.actuator_ctrlrange.T
        return np.where(limited, low, -1.0), np.where(limited, high, 1.0)

    @property
    def period(self) -> float:
        """A control step [s]."""
        return float(self.model.opt.timestep) * self.substeps

    def spec(self) -> TaskSpec:
        """The task's specification; found from one rollout's start unless overridden."""
        from farm.tasks.loop import probe

        return probe(self)


def rescaled(action: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Scale raw actions (B, A) to the limits: -1 is the lowest, 1 the highest; clipped beyond, nan is the middle."""
    part = np.minimum(np.maximum(action, -1.0), 1.0)
    part[np.isnan(part)] = 0.0
    return low + (high - low) * (0.5 * (part + 1.0))


def flat(channels: Sequence[Channel], values: Mapping[str, AnyArray]) -> AnyArray:
    """Concatenate the channels' values (..., *shape) as float32, (..., K): a trace."""
    parts = [values[c.name].reshape(*values[c.name].shape[: -len(c.shape)], -1) for c in channels]
    return np.concatenate(parts, axis=-1).astype("<f4")
