"""A task's `farm.Robust` in a batch of rollouts: what each one has drawn, and what follows in each
control step.
"""

from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np

from farm import seeds
from farm.arrays import FloatArray, IntArray
from farm.elementary import cos, sin
from farm.errors import ConfigError, TaskError
from farm.sim.channels import Channel
from farm.sim.sim import WRITABLE, Sim
from farm.tasks.base import Task
from farm.tasks.robust import NEUTRAL, SIZES, Robust

CONDITIONS: Final = "robust/conditions"
PUSH: Final = "robust/push"
CHANNELS: Final = (CONDITIONS, PUSH)

_ARROW: Final = 0.3  # length of the strongest push where it is drawn [m]
_STREAM: Final = "farm.Robust "  # before the names of streams, so that they are no task's
_LINEAR: Final = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_MUSCLE: Final = int(mujoco.mjtGain.mjGAIN_MUSCLE)
_OF_LINEAR = slice(0, 3)  # parameters that a force is proportional to
_OF_MUSCLE = slice(2, 4)  # its peak force


def of(task: Task) -> Robust | None:
    """The conditions of a task at the strength of its settings; None if there are none."""
    robust = None if task.robust is None else task.robust.scaled(task.config.robust)
    return robust if robust is not None and robust.causes else None


def check(task: Task) -> None:
    """Check a task's conditions against its model and duration.

    Raises:
      ConfigError: names the first thing that is not there, or does not fit.
    """
    declared: object = task.robust
    name = type(task).__name__
    if declared is None:
        if task.config.robust_ramp:
            raise ConfigError(
                f"--robust-ramp {task.config.robust_ramp}, but task {name} declares no farm.Robust"
            )
        if task.config.robust not in (0.0, 1.0):
            raise ConfigError(
                f"robust is {task.config.robust:g}, but task {name} declares no farm.Robust"
            )
        return
    if not isinstance(declared, Robust):
        raise ConfigError(f"task {name}: robust is {declared!r:.60}; expected a farm.Robust")
    robust = declared.scaled(task.config.robust)
    duration = task.steps * task.period
    try:
        for cause in ("observation_delay", "action_delay"):
            if getattr(robust, cause)[1] >= duration:
                raise ConfigError(
                    f"robust: {cause} is up to {getattr(robust, cause)[1]:g} s; a rollout takes"
                    f" {duration:g} s"
                )
        if "push" in robust.causes and robust.pushes * robust.push_duration > duration:
            raise ConfigError(
                f"robust: {robust.pushes} pushes of {robust.push_duration:g} s; a rollout takes"
                f" {duration:g} s"
            )
        for model in task.simulated:
            _check_model(robust, model)
    except ConfigError as error:
        raise ConfigError(f"task {name}: {error}") from None


def _check_model(robust: Robust, model: mujoco.MjModel) -> None:
    if "payload" in robust.causes or "push" in robust.causes:
        body_of(robust, model)
    if "motors" in robust.causes:
        if not model.nu:
            raise ConfigError("robust: motors differ, but the model has no actuator")
        kinds = zip(model.actuator_gaintype.tolist(), model.actuator_biastype.tolist(), strict=True)
        none = int(mujoco.mjtBias.mjBIAS_NONE)
        affine = int(mujoco.mjtBias.mjBIAS_AFFINE)
        for actuator, (gain, bias) in enumerate(kinds):
            if gain != _MUSCLE and not (gain in _LINEAR and bias in (none, affine)):
                raise ConfigError(
                    "robust: motors differ, but actuator"
                    f" {model.actuator(actuator).name or actuator!r} is neither a motor nor a servo"
                    " (position, velocity, damper, general with affine terms) nor a muscle"
                )


def body_of(robust: Robust, model: mujoco.MjModel) -> int:
    """Id of the body with the payload, which is pushed.

    Raises:
      ConfigError: there is none of this name, or none that moves.
    """
    if not robust.body:
        moving = np.flatnonzero(model.body_dofnum)
        if not len(moving):
            raise ConfigError("robust: no joint moves a body; there is none to push or to load")
        return int(moving[0])
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, robust.body)
    if index < 0:
        names = ", ".join(filter(None, (model.body(i).name for i in range(1, model.nbody))))
        raise ConfigError(
            f"robust: there is no body {robust.body!r}; the model has {names or 'none with a name'}"
        )
    if not model.body_weldid[index]:
        moving = [model.body(i).name for i in np.flatnonzero(model.body_weldid).tolist()]
        raise ConfigError(
            f"robust: body {robust.body!r} cannot move; those that can are"
            f" {', '.join(filter(None, moving)) or 'without names'}"
        )
    return index


def channels(task: Task) -> tuple[Channel, ...]:
    """Channels that show the conditions; none if there are none."""
    robust = of(task)
    if robust is None:
        return ()
    random_causes = _drawn(robust)
    names = tuple(cause.replace("_", " ") for cause in random_causes)
    out = (
        [Channel(name=CONDITIONS, kind="scalars", shape=(len(random_causes),), labels=names)]
        if random_causes
        else []
    )
    if "push" in robust.causes:
        length = _ARROW / robust.push[1]
        out.append(
            Channel(name=PUSH, kind="arrows", shape=(1, 6), unit="N", length=length, longest=_ARROW)
        )
    return tuple(out)


def _drawn(robust: Robust) -> tuple[str, ...]:
    """Causes that are one number of a whole rollout, or their mean over actuators."""
    return tuple(cause for cause in robust.causes if cause in NEUTRAL and cause != "push")


class Disturbances:
    """The conditions of a batch of B rollouts, of which n are still going: their rows are given
    with each call.
    """

    def __init__(self, robust: Robust, task: Task) -> None:
        self._robust = robust
        self._task = task
        self._causes = robust.causes
        self._ramp = task.config.robust_ramp
        self._sizes: dict[str, FloatArray] | None = None  # of errors, (d,) each
        self._bias = np.zeros((0, 0))  # (B, d)
        self._strength: FloatArray | None = None  # (B, 1); None: all of it
        self._drawn: dict[str, FloatArray] = {}
        self._seen = _Late()
        self._done = _Late()
        self._body: IntArray = np.zeros(0, dtype=int)
        self._force = np.zeros((0, 0, 3))  # (B, pushes, 3)
        self._begins: IntArray = np.zeros((0, 0), dtype=int)
        self._lasts = max(1, round(robust.push_duration / task.period))
        self._pushing: FloatArray | None = None  # what is in xfrc_applied of it, (n, 3)

    def prepare(self, sim: Sim) -> None:
        """Change the models of rollouts that are being prepared."""
        if "motors" in self._causes:
            factors = self._uniform(sim, "motors", (sim.model.nu,))
            self._weaken(sim, factors)
        if "mass" in self._causes:
            factors = self._uniform(sim, "mass")
            sim.expand("body_mass")[:] *= factors[:, None]
            sim.expand("body_inertia")[:] *= factors[:, None, None]
        if "payload" in self._causes:
            sim.expand("body_mass")[np.arange(len(sim)), self._bodies(sim)] += self._uniform(
                sim, "payload"
            )
        if "friction" in self._causes:
            factors = self._uniform(sim, "friction")[:, None, None]
            sim.expand("geom_friction")[:] *= factors
            if any(model.npair for model in sim.models):
                sim.expand("pair_friction")[:] *= factors

    def start(self, sim: Sim) -> None:
        """Remember what each rollout has drawn, after all are prepared."""
        robust = self._robust
        period = self._task.period
        if self._ramp:
            self._strength = self._strengths(sim)[:, None]
        for cause in _drawn(robust):
            values = self._uniform(sim, cause, (sim.model.nu,) if cause == "motors" else ())
            self._drawn[cause] = values.mean(axis=1) if cause == "motors" else values
        for cause, late in (("observation_delay", self._seen), ("action_delay", self._done)):
            if cause in self._causes:
                late.by(self._drawn[cause] / period)
        if "push" in self._causes:
            if "xfrc_applied" not in getattr(sim.engine, "writable", WRITABLE):
                raise TaskError("robust: nothing can be pushed in an environment that steps itself")
            self._body = self._bodies(sim)
            self._draw_pushes(sim)

    def observe(self, sim: Sim, x: FloatArray, rows: IntArray) -> FloatArray:
        """What the policy sees of observations (n, d)."""
        if self._sizes is None:  # the first time: all rollouts are going
            self._sizes = {
                cause: self._robust.sizes(cause, x.shape[1], self._task.parts) for cause in SIZES
            }
            self._bias = self._sizes["bias"] * sim.noise(x.shape[1], _STREAM + "bias", "uniform", 0)
            if self._strength is not None:
                self._bias *= self._strength
        x = self._seen.of(x, sim.t, rows)
        if "bias" in self._causes:
            x = x + self._bias[rows]
        if "noise" in self._causes:
            noise = self._sizes["noise"] * sim.noise(x.shape[1], _STREAM + "noise")
            x = x + (noise if self._strength is None else noise * self._strength[rows])
        return x

    def late(self, action: FloatArray, t: int, rows: IntArray) -> FloatArray:
        """The actions (n, A) that take effect in a control step."""
        return self._done.of(action, t, rows)

    def release(self, sim: Sim, rows: IntArray) -> None:
        """Take the push back that the last control step had, before the task writes its own
        forces.
        """
        if self._pushing is not None:
            sim.xfrc_applied[np.arange(len(sim)), self._body[rows], :3] -= self._pushing
            self._pushing = None

    def press(self, sim: Sim, rows: IntArray) -> None:
        """Push in this control step, if it is time."""
        if not self._begins.size:
            return
        force = self._forces(sim.t, rows)
        if force.any():
            sim.xfrc_applied[np.arange(len(sim)), self._body[rows], :3] += force
            self._pushing = force

    def keep(self, going: np.ndarray) -> None:
        """Forget the rollouts that end, (n,)."""
        if self._pushing is not None:
            self._pushing = self._pushing[going]

    def measured(self, sim: Sim, rows: IntArray) -> dict[str, FloatArray]:
        """Values of the channels, (n, ...) each."""
        out = {}
        if self._drawn:
            out[CONDITIONS] = np.stack([values[rows] for values in self._drawn.values()], axis=1)
        if self._begins.size:
            places = sim.xipos[np.arange(len(sim)), self._body[rows]]
            force = np.zeros_like(places) if self._pushing is None else self._pushing
            out[PUSH] = np.concatenate([places, force], axis=1)[:, None]
        return out

    def _uniform(self, sim: Sim, cause: str, shape: tuple[int, ...] = ()) -> FloatArray:
        """Values (B, *shape) of a cause, drawn from its range; of nominal rollouts what is
        without it.
        """
        low, high = getattr(self._robust, cause)
        part = 0.5 * (sim.noise(shape, _STREAM + cause, "uniform", 0) + 1.0)
        values = low + (high - low) * part
        neutral = NEUTRAL[cause]
        if self._ramp:
            strengths = self._strengths(sim).reshape(-1, *[1] * len(shape))
            part = neutral + strengths * (values - neutral)
            values = np.where(strengths < 1.0, part, values)
        values[sim.nominal] = neutral
        return values

    def _strengths(self, sim: Sim) -> FloatArray:
        """Share of the conditions that each rollout has while they grow, (B,)."""
        return np.array([_share(seed, self._ramp) for seed in sim.seeds])

    def _bodies(self, sim: Sim) -> IntArray:
        """Number of the body with the payload in each rollout, (B,)."""
        return np.array([body_of(self._robust, model) for model in sim.models])[sim.which]

    def _weaken(self, sim: Sim, factors: FloatArray) -> None:
        """Multiply the actuators' forces by factors (B, nu)."""
        muscle = sim.model.actuator_gaintype == _MUSCLE
        for actuators, numbers in (
            (np.flatnonzero(~muscle), _OF_LINEAR),
            (np.flatnonzero(muscle), _OF_MUSCLE),
        ):
            if len(actuators):
                for name in ("actuator_gainprm", "actuator_biasprm"):
                    sim.expand(name)[:, actuators, numbers] *= factors[:, actuators, None]
        if sim.model.actuator_forcelimited.any():
            sim.expand("actuator_forcerange")[:] *= factors[:, :, None]

    def _draw_pushes(self, sim: Sim) -> None:
        """Force, direction and first control step of each push."""
        robust = self._robust
        steps = self._task.steps
        count = (robust.pushes,)
        size = self._uniform(sim, "push", count)
        angle = np.pi * sim.noise(count, _STREAM + "direction", "uniform", 0)
        self._force = np.stack([size * cos(angle), size * sin(angle), np.zeros_like(size)], axis=2)
        share = steps / robust.pushes
        free = max(share - self._lasts, 0.0)
        part = 0.5 * (sim.noise(count, _STREAM + "time", "uniform", 0) + 1.0)
        self._begins = (np.arange(robust.pushes) * share + free * part).astype(int)

    def _forces(self, t: int, rows: IntArray) -> FloatArray:
        """What pushes rollouts (n,) in a control step, (n, 3)."""
        begins = self._begins[rows]
        now = (begins <= t) & (t < begins + self._lasts)
        return (now[:, :, None] * self._force[rows]).sum(axis=1)


def _share(seed: Sequence[int] | None, ramp: int) -> float:
    """Share of the conditions that a rollout has: a learning one's grows over the generations."""
    generation = None if seed is None else seeds.generation(seed)
    return 1.0 if generation is None else min(generation / ramp, 1.0)


class _Late:
    """Numbers of rollouts, as they were some control steps ago."""

    def __init__(self) -> None:
        self._whole: IntArray | None = None
        self._part: FloatArray = np.zeros(0)
        self._past: FloatArray | None = None  # (K, B, n)

    def by(self, steps: FloatArray) -> None:
        """Let them be late by this number of control steps, (B,), which need not be whole."""
        self._whole = np.floor(steps).astype(int)
        self._part = (steps - self._whole)[:, None]

    def of(self, values: FloatArray, t: int, rows: IntArray) -> FloatArray:
        """Numbers (n, k) of rollouts (n,) at control step t as they arrive; before the first
        ones there were these.
        """
        if self._whole is None:
            return values
        if self._past is None:
            shape = (int(self._whole.max()) + 2, len(self._whole), values.shape[1])
            self._past = np.zeros(shape)
            self._past[:, rows] = values
        length = len(self._past)
        self._past[t % length, rows] = values
        back = t - self._whole[rows]
        newer = self._past[back % length, rows]
        older = self._past[(back - 1) % length, rows]
        return newer + self._part[rows] * (older - newer)
