"""The base class of tasks, and the specification that other code knows of a task."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, TaskError
from farm.settings import Settings, setting
from farm.sim.channels import Camera, Channel, Measure, Quantity
from farm.tasks.actions.space import ActionSpace, rescaled

if TYPE_CHECKING:
    import mujoco

    from farm.sim.interfaces import Engine, MakeEngine
    from farm.sim.model_files import Content, Files
    from farm.sim.sim import Sim
    from farm.tasks.robust import Robust

STEPS_LIMIT: Final = 10_000
"""Control steps of a rollout, at most."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Settings):
    """Settings that every task has; a task's own `Config` adds to them.

    Example:
      ```python
      from dataclasses import dataclass

      import farm

      class Hinge(farm.Task):
          @dataclass(frozen=True, kw_only=True)
          class Config(farm.TaskConfig):
              torque: float = farm.setting(1.5, above=0.0, most=10.0)
              '''Torque at full action [N m]; the flag is --torque.'''

      assert Hinge(Hinge.Config(steps=20)).steps == 20
      ```
    """

    steps: int = setting(0, least=0, most=STEPS_LIMIT)
    """Control steps of a rollout; 0: the task's own number."""
    gamma: float = setting(1.0, above=0.0, most=1.0)
    """Discount factor of the return, per control step."""
    perturb: bool = True
    """Train with random starts and conditions (the same for both rollouts of a pair)."""
    reward_offset: float = setting(0.0, least=-1e6, most=1e6)
    """Added to the reward of every control step, for learning only: -1 removes a bonus of 1 for not
    falling.
    """
    robust: float = setting(1.0, least=0.0, most=10.0)
    """Strength of the conditions that the task declares by farm.Robust: 0 turns them off, 2 doubles
    their ranges.
    """
    robust_ramp: int = setting(0, least=0)
    """Generations in which the strength of these conditions rises from 0, in exploring rollouts
    only: what validates, evaluates and replays has all of it.
    """
    strict: bool = False
    """End the run if a rollout raises an error or gives a number that is not finite.

    Otherwise it counts as failed.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpec:
    """What learner and workers must know of a task before anything is simulated.

    Example:
      ```python
      import farm

      spec = farm.TaskSpec(observation=3, action=1, steps=100, period=0.05)
      assert spec.shapes(bodies=2) == {"bodies": (2, 7), "actions": (1,), "terms": (1,)}
      ```
    """

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
    measures: tuple[Measure, ...] = ()
    """Numbers that describe a whole rollout."""
    release: str = ""
    """Release of the task's package; empty for the farm's own and for files."""

    def shapes(self, bodies: int) -> dict[str, tuple[int, ...]]:
        """Shape of a frame of each of a trajectory's arrays, by the names of
        `Trajectory.arrays`.
        """
        shapes = {"bodies": (bodies, 7), "actions": (self.action,), "terms": (len(self.terms),)}
        return shapes | {f"channels/{channel.name}": channel.shape for channel in self.channels}

    @property
    def trace_channels(self) -> tuple[Channel, ...]:
        """The channels whose values are sent with results."""
        return tuple(channel for channel in self.channels if channel.trace)

    @property
    def trace_shape(self) -> tuple[int, int]:
        """Shape of a rollout's trace: control steps, and numbers per step (0 if no channel is
        sent).
        """
        return self.steps, sum(int(np.prod(channel.shape)) for channel in self.trace_channels)


@dataclass(frozen=True)
class Record:
    """Whole rollouts, for tasks that score them at once: T control steps of B rollouts, zero after
    the end.

    Example:
      ```python
      import farm

      class Smooth(farm.Task):
          def score(self, record):
              change = record.actions[:, 1:] - record.actions[:, :-1]  # (B, T - 1, A)
              print("most that an action changes:", abs(change).max(axis=(1, 2)))  # (B,)
      ```
    """

    frames: Mapping[str, FloatArray]
    """What `Task.measure` gave after each step, (B, T, ...)"""
    start: Mapping[str, FloatArray]
    """Values that `Task.measure` gave at the start, (B, ...)"""
    actions: FloatArray
    """(B, T, A)"""
    steps: IntArray
    """Control steps of each including its last, (B,)"""
    failed: BoolArray
    """Whether each failed in its last step: unstable physics, or a number of the task's that is
    not finite, (B,)
    """
    which: IntArray
    """Which of the task's models each has, (B,)"""


@dataclass(frozen=True)
class Score:
    """Scores of whole rollouts.

    Example:
      ```python
      import numpy as np

      import farm

      class Far(farm.Task):
          def score(self, record):  # one term, the effort; a success if it does not end early
              effort = (record.actions**2).sum(axis=2, keepdims=True)  # (B, T, 1)
              return farm.Score(terms=-effort, success=record.steps == self.steps)

      record = farm.Record(
          frames={},
          start={},
          which=np.zeros(2, dtype=int),
          steps=np.array([100, 7]),
          failed=np.zeros(2, dtype=bool),
          actions=np.ones((2, 100, 3)),
      )
      score = Far().score(record)
      assert score.terms.shape == (2, 100, 1)
      assert score.success.tolist() == [True, False]
      ```
    """

    terms: FloatArray
    """Reward terms, zero after the end, (B, T, K)"""
    success: BoolArray | None = None
    """(B,), None if the task does not define success"""


class Task:
    """A task: what is simulated, what a policy sees and does, and its reward.

    `xml` and `reward` are enough for a subclass. Everything is batched: B rollouts at a time, whose
    numbers must not depend on each other. `sim` is the batch as named live arrays
    (`farm.sim.sim.Sim`); a task sees nothing else of a simulator. The object holds no state of a
    rollout. What must be remembered is kept in `sim.own`, arrays (B, ...) whose rows stay with
    their rollouts when other rollouts end.

    A method's result of a wrong shape ends the run with a TaskError that names it. A rollout in
    which a method raises an error, or gives a number that is not finite, counts as failed, unless
    the run is `--strict`.

    Example:
      ```python
      import numpy as np

      import farm

      class Hinge(farm.Task):
          '''Stay upright.'''

          xml = '''<mujoco>
            <worldbody>
              <body><joint name="hinge" axis="0 1 0"/><geom size="0.1" pos="0 0 0.5"/></body>
            </worldbody>
            <actuator><motor joint="hinge" ctrlrange="-2 2"/></actuator>
          </mujoco>'''
          steps, substeps = 50, 10

          def reset(self, sim, row, rng):  # rng is None for nominal conditions
              sim.qpos[row] = 0.0 if rng is None else rng.uniform(-0.1, 0.1)

          def reward(self, sim, action):  # (B,)
              return np.cos(sim.qpos[:, 0])

      assert Hinge().period == 0.02  # [s]: 10 physics steps of MuJoCo's default
      ```
    """

    Config: ClassVar[type[TaskConfig]] = TaskConfig
    """The task's own settings: flags, help and config.json follow from its fields."""
    xml: str | Path = ""
    """MJCF or URDF of what is simulated, or the path of its file; or override `files` or
    `compiled`.

    What it includes and reads (meshes, textures, height fields) travels with a run. A worker does
    not look at it.
    """
    root: str | Path = ""
    """Folder of all files of `xml`, seen from the folder of the task's file; empty: that folder
    itself.
    """
    package: str = ""
    """An installed package in whose folder `root` is, for a robot that comes from there.

    It is not imported.

    Only the learner needs it: workers get the model's files from the learner.
    """
    steps: int = 100
    """Control steps of a rollout."""
    substeps: int = 1
    """Physics steps in each."""
    channels: tuple[Channel, ...] = ()
    """What a rollout shows in addition to bodies, actions and reward terms."""
    measures: tuple[Measure, ...] = ()
    """Numbers that `outcomes` gives of a whole rollout, beside its return."""
    robust: "Robust | None" = None
    """Sensor errors, delays, motors, masses, friction and pushes that differ between rollouts."""
    camera: Camera | None = None
    """Point of view of pictures; by default from the side of the moving bodies."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"default": {}}
    """Settings that runs start from, by preset and flag; the first preset is the default."""
    return_scale: float = 1.0
    """Factor of the return."""
    parts: tuple[int, ...] = ()
    """Sizes of the observation's parts if they differ in kind; empty: one part."""
    observations: tuple[Quantity, ...] = ()
    """What the observation's numbers are, for exports; empty: numbered, or qpos and qvel if
    those are observed.
    """
    actions: int | tuple[Quantity, ...] | ActionSpace = ()
    """An action space, or how many numbers an action has, or what they are; empty: one for each
    actuator.

    `farm.Offsets` and the other spaces say what the numbers do. Without actuators there are three
    for each mocap body. `act` makes controls of any other number.
    """
    ends: tuple[str, str] | None = None
    """Names of the states in which rollouts begin and should end.

    With `reached` and `lost` policies can be chained.
    """
    ending: ClassVar[str] = "ended"
    """One word for a rollout that `ended` ends, and so a flag: `farm replay RUN --dropped 5` if it
    is "dropped".
    """
    takes: ClassVar[str] = ""
    """What the part after the colon in the task's name means, for tasks with variants: `--task
    gym:NAME`.
    """

    def __init__(
        self, config: TaskConfig | None = None, variant: str = "", files: "Files | None" = None
    ) -> None:
        """Take settings, the name after the colon, and the run's files (by default this
        machine's).
        """
        self.config: Any = self.Config() if config is None else config
        self.variant = variant
        if self.config.steps:
            self.steps = self.config.steps
        self.sources: Files = self.files() if files is None else files
        self._models: tuple[mujoco.MjModel, ...] = ()

    # Simulation

    def files(self) -> "Mapping[str, Content]":
        """What decides numbers and is sent with a run, by path: texts, or bytes.

        The first model is simulated.
        """
        from farm.sim.model_files import read

        if not self.xml:
            return {}
        return read(self.xml, self.model_folder / self.root if self.model_folder else None)

    @property
    def model_folder(self) -> Path | None:
        """Folder of the package, or of the file whose class says what `xml` is; None without
        either.

        Raises:
          ConfigError: the package is not installed.
        """
        if self.package:
            return self._installed()
        if not self.xml:
            return None
        module = next(kind.__module__ for kind in type(self).__mro__ if "xml" in vars(kind))
        file = getattr(sys.modules.get(module), "__file__", None)
        return Path(file).parent if file else None

    def _installed(self) -> Path:
        """The folder of the package."""
        try:
            spec = find_spec(self.package) if "." not in self.package else None
        except ValueError:
            spec = None
        if spec is None or not spec.submodule_search_locations:
            raise ConfigError(
                f"task {type(self).__name__}: its model is in the package {self.package!r:.60},"
                " which is not installed here: install it with pip, beside rolloutfarm"
            )
        return Path(next(iter(spec.submodule_search_locations)))

    @property
    def model(self) -> "mujoco.MjModel":
        """The compiled model, the first if there are several; made once."""
        return self.simulated[0]

    @property
    def simulated(self) -> "tuple[mujoco.MjModel, ...]":
        """Compiled models of the task; made once."""
        if not self._models:
            from farm.sim.mixed import compiled_models
            from farm.sim.model_files import TEXT

            models, name = self.models(), type(self).__name__
            files = self.sources, self.main or TEXT
            self._models = compiled_models(models, name, *files) if models else (self.compiled(),)
        return self._models

    def models(self) -> "Sequence[str | mujoco.MjModel]":
        """Several models, MJCF texts or compiled: each rollout has one, see `which`.

        Empty: the model alone.
        """
        return ()

    def which(self, rng: np.random.Generator) -> int:
        """Index of a rollout's model, drawn from its generator before `prepare`; nominal
        rollouts have the first.
        """
        return int(rng.integers(len(self.simulated)))

    def compiled(self) -> "mujoco.MjModel":
        """Compile the model."""
        from farm.sim.model_files import TEXT, compiled

        return compiled(self.mjcf(), type(self).__name__, self.sources, self.main or TEXT)

    @property
    def main(self) -> str:
        """Path of the model among `sources`; empty if there is none."""
        from farm.sim.model_files import SUFFIXES

        return next((path for path in self.sources if path.lower().endswith(SUFFIXES)), "")

    def mjcf(self) -> str:
        """The model's MJCF text, from `sources`."""
        name, several = type(self).__name__, self.models()
        text = several[0] if several else self.sources.get(self.main)
        if isinstance(text, str):
            return text
        if several or type(self).compiled is not Task.compiled:
            how = "models()" if several else "compiled()"
            raise ConfigError(
                f"task {name} makes its model by {how}: without mjcf() there is no text to export"
            )
        raise ConfigError(f"task {name} has no model: give it `xml`, an MJCF text or its file")

    def engine(self, backend: "MakeEngine") -> "Engine":
        """The simulation engine: the backend's for the model, or models, unless the task has its
        own.
        """
        from farm.sim.mixed import engine

        return engine(self.simulated, backend)

    def setup(self, sim: "Sim") -> None:
        """Compute once, before the first rollout, what all rollouts need and none changes."""

    # A rollout

    def prepare(self, sim: "Sim", rngs: Sequence[np.random.Generator | None]) -> None:
        """Prepare the start of every rollout of the batch; one generator each, None for nominal
        conditions.
        """
        for row, rng in enumerate(rngs):
            self.reset(sim, row, rng)

    def reset(self, sim: "Sim", row: int, rng: np.random.Generator | None) -> None:
        """Prepare one rollout's start from the model's initial state; `rng` is its own, None for
        nominal conditions.
        """

    def observe(self, sim: "Sim") -> FloatArray:
        """What the policy sees, (B, d); qpos and qvel unless overridden."""
        return np.concatenate([sim.qpos, sim.qvel], axis=1)

    def act(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls of raw actions (B, A): of the action space, or -1 to 1 rescaled to the
        actuators' ranges.

        It may also write qpos, qvel, mocap_pos, xfrc_applied and the others of
        `farm.sim.sim.WRITABLE`: pushes, moving goals, jumps. They hold from this control step's
        first physics step on.
        """
        if self.space:
            return self.space.controls(sim, action)
        low, high = self.limits
        if action.shape[1] != len(low):
            raise TaskError(
                f"Task.act got actions of {action.shape[1]} numbers; expected {len(low)}, one per"
                " actuator"
            )
        return rescaled(action, low, high)

    def reward(self, sim: "Sim", action: FloatArray) -> FloatArray | dict[str, FloatArray]:  # noqa: ARG002
        """Reward of the control step that just ended, (B,); or named terms that add up to it."""
        raise ConfigError(
            f"task {type(self).__name__} has no reward: give it reward(self, sim, action), or score"
        )

    def ended(self, sim: "Sim") -> BoolArray | None:  # noqa: ARG002
        """Which rollouts end here, (B,); None: none before its last step."""
        return None

    def success(self, sim: "Sim") -> BoolArray | None:  # noqa: ARG002
        """Which of the rollouts that end here succeeded, (B,); None if success is not defined."""
        return None

    def reached(self, sim: "Sim") -> BoolArray:
        """Which rollouts have reached the end named in `ends`, (B,): the next policy of a chain may
        act.
        """
        raise NotImplementedError

    def lost(self, sim: "Sim") -> BoolArray:
        """Which rollouts of a chain are lost for good, (B,)."""
        raise NotImplementedError

    def measure(self, sim: "Sim") -> dict[str, FloatArray]:  # noqa: ARG002
        """Values kept of every frame, (B, ...) each: those of channels, or those that `score` and
        `show` need.
        """
        return {}

    # Whole rollouts

    def score(self, record: Record) -> Score | None:  # noqa: ARG002
        """Score whole rollouts at once instead of by `reward` and `success`; None: do not."""
        return None

    def outcomes(self, record: Record) -> dict[str, FloatArray]:  # noqa: ARG002
        """Values of `measures` of whole rollouts, (B,) each, by name; within their bounds."""
        return {}

    def show(self, frames: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of the channels from what was measured, any leading shape.

        Those measured under their names.
        """
        return {channel.name: frames[channel.name] for channel in self.channels}

    def exported(self) -> dict[str, Any]:
        """Contents that an exported policy needs in addition to model, policy and start: arrays,
        numbers and texts, by name.
        """
        return {}

    # What other code knows of it

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest control of each actuator, (nu,) each; -1 and 1 if it has no
        range.
        """
        limited = self.model.actuator_ctrllimited.astype(bool)
        low, high = self.model.actuator_ctrlrange.T
        return np.where(limited, low, -1.0), np.where(limited, high, 1.0)

    @cached_property
    def space(self) -> ActionSpace | None:
        """The action space that `actions` declares, fitted to the model; None if it declares none.

        Raises:
          ConfigError: it does not fit the model.
        """
        return self.actions.fitted(self) if isinstance(self.actions, ActionSpace) else None

    @property
    def action_size(self) -> int:
        """Length A of the action; 0 if nothing says it."""
        if self.space:
            return self.space.size
        assert not isinstance(self.actions, ActionSpace)
        if isinstance(self.actions, int):
            return self.actions
        return len(self.actions) or self.model.nu or 3 * self.model.nmocap

    @property
    def period(self) -> float:
        """A control step [s]."""
        return float(self.model.opt.timestep) * self.substeps

    def spec(self) -> TaskSpec | None:
        """The task's specification; None: it is found by one control step (`farm.tasks.probe`)."""
        return None
