"""Builds a run's simulation from its specification and runs jobs; for workers and learners."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import numpy as np

from farm import plugins, settings
from farm.arrays import AnyArray, FloatArray, IntArray
from farm.errors import ConfigError, FarmError, UnservedError, brief, described
from farm.moments import usable
from farm.net.messages import Spec
from farm.net.work import NOT_NORMALISED, Jobs, Simulated, rows_with_trace
from farm.policies.base import Policy, check_vector
from farm.policies.normalised import Normalised
from farm.sim.engines import BatchEngine
from farm.sim.interfaces import Backend, MakeEngine
from farm.sim.model_files import Files, joined
from farm.sim.scene import Scene, quiet
from farm.sim.sim import Sim
from farm.sim.trajectory import Trajectory
from farm.tasks import loop
from farm.tasks.base import Task, TaskSpec
from farm.tasks.loop import Kept
from farm.tasks.probe import specification
from farm.tasks.rollouts import (
    Rollouts,
    Seed,
    channel_traces,
    shares,
    step_traces,
    steps_shape,
    trajectory,
)
from farm.tasks.standard import standard
from farm.tasks.trouble import Trouble

SIMULATION = "farm.tasks.loop"
"""The module whose code, with all its imports, determines every rollout's numbers, with task and
policy.
"""


class Runner:
    """Runs one run's jobs."""

    @plugins.no_exit
    def __init__(
        self, task: Task, policy: Policy, make: MakeEngine = BatchEngine, *, exact: bool = True
    ) -> None:
        """Prepare the simulation; a ConfigError if the task cannot start.

        Args:
          task: what is simulated.
          policy: what decides the actions.
          make: makes the engine.
          exact: whether its numbers are MuJoCo's on a processor. If not, MuJoCo on this processor
            simulates the mean policy and every rollout that is shown; the engine simulates what
            explores.
        """
        quiet()
        self.task, self.policy = task, policy
        self.spec, self.scene = policy.spec, Scene.of(task.simulated)
        self.sim = Sim(task.engine(make))
        self._exact_sim = self.sim if exact else Sim(task.engine(BatchEngine))
        loop.again(lambda: task.setup(self._exact_sim))
        self.trouble = Trouble()
        """What went wrong in the last call of `rollouts`."""

    @property
    def size(self) -> int:
        """Parameters of the policy, P."""
        return int(self.policy.size)  # a class of one's own may give numpy's integers

    @plugins.no_exit
    def run(
        self,
        mu: FloatArray,
        jobs: Jobs,
        traces: str = "none",
        normaliser: FloatArray = NOT_NORMALISED,
        *,
        terms: bool = False,
        advance: loop.Advance = loop.unseen,
    ) -> Simulated:
        """Run jobs around a mean (P,).

        Args:
          mu: (P,).
          jobs: what to run.
          traces: which traces of exploring rollouts to return, one of TRACES.
          normaliser: as in a RoundHeader, (2, 2, d); with d > 0 the result has moments of the
              observations.
          terms: whether the result has each reward term's part of the returns.
          advance: is told how many rollouts are done.

        Raises:
          UnservedError: the normaliser does not match the observations.
        """
        theta, seeds, size = jobs.theta(mu), jobs.seeds(), normaliser.shape[-1]
        around, earlier = self._normalised(normaliser)
        elsewhere = jobs.physics & ~jobs.around & bool(size)  # a rollout of an earlier generation
        exact = (jobs.seen | ~jobs.explores) & ~jobs.physics & (self._exact_sim is not self.sim)
        trajectories: dict[int, Trajectory] = {}
        done: list[_Part] = []
        trouble = Trouble()
        for mask, policy, sim, every in (
            (~jobs.physics & ~exact, around, self.sim, 0),
            (exact, around, self._exact_sim, 0),
            (jobs.physics & ~elsewhere, around, self._exact_sim, 1),
            (elsewhere, earlier, self._exact_sim, 1),
        ):
            rows = np.flatnonzero(np.repeat(mask, jobs.rollouts))
            if not len(rows):
                continue
            batch = (
                (theta, seeds)
                if mask.all()
                else (theta[rows], [seeds[row] for row in rows.tolist()])
            )
            moments = bool(size) and not every
            extras = Kept(
                every=every, moments=moments, observations=traces == "steps" and not every
            )
            rollouts, its = loop.run(self.task, policy, sim, *batch, self.spec, extras, advance)
            trouble.add(its)
            for job in np.flatnonzero(jobs.seen & mask).tolist():
                first = int(jobs.rollouts[:job].sum())
                trajectories[job] = self.trajectory(rollouts, int(np.searchsorted(rows, first)))
            done.append((rows, rollouts))
        returns = _placed(done, lambda part: part.returns)
        wanted_traces = traces if self.spec.trace_channels or traces == "steps" else "none"
        selection = rows_with_trace(wanted_traces, returns, jobs.traced(wanted_traces))
        return Simulated(
            **(told(trouble.errors[0]) if trouble.errors else {}),
            warned=dict(trouble.warned),
            returns=returns,
            flags=_placed(done, lambda part: part.flags),
            steps=_placed(done, lambda part: part.steps),
            traces=self._traces(done, selection, steps=traces == "steps"),
            trajectories=tuple(trajectories[job] for job in sorted(trajectories)),
            measures=(
                _placed(done, lambda part: part.measures)
                if self.spec.measures
                else np.empty((0, 0))
            ),
            terms=(
                _placed(done, lambda part: shares(self.task, part.terms, part.clamped))
                if terms
                else np.empty((0, 0))
            ),
            moments=_placed(done, lambda part: _moments(part, size)) if size else np.empty((0, 0)),
        )

    def _traces(self, done: "list[_Part]", selection: IntArray, *, steps: bool) -> AnyArray:
        """Traces of the chosen rollouts, or their whole control steps, (K, T, N)."""
        values = np.zeros(
            (len(selection), *(steps_shape(self.spec) if steps else self.spec.trace_shape)),
            dtype="<f4",
        )
        make = step_traces if steps else channel_traces
        for rows, rollouts in done if len(selection) else ():
            mask = np.isin(selection, rows)
            if mask.any():
                values[mask] = make(
                    self.task, self.spec, rollouts, np.searchsorted(rows, selection[mask])
                )
        return values

    def _normalised(self, normaliser: FloatArray) -> tuple[Policy, Policy]:
        """Policies for jobs of this round, and for a rollout of an earlier one."""
        if normaliser.shape[-1] not in (0, self.spec.observation):
            raise UnservedError(
                f"a normaliser of {normaliser.shape[-1]} numbers, not {self.spec.observation}"
            )
        if not normaliser.size:
            return self.policy, self.policy
        around, earlier = (Normalised(self.policy, each) for each in normaliser)
        return around, earlier

    @plugins.no_exit
    def rollouts(
        self, theta: FloatArray, seeds: Sequence[Seed], *, physics: bool = False
    ) -> Rollouts:
        """Rollouts of parameters theta (B, P), with one frame per control step or per physics
        step.
        """
        extras = Kept(every=1 if physics else 0)
        rollouts, self.trouble = loop.run(
            self.task, self.policy, self.sim, theta, seeds, self.spec, extras
        )
        return rollouts

    def trajectory(self, rollouts: Rollouts, row: int) -> Trajectory:
        """Return one of the rollouts, frame by frame."""
        return trajectory(self.task, self.spec, self.scene, rollouts, row)

    def close(self) -> None:
        """Release the resources of the simulations."""
        for sim in {self.sim, self._exact_sim}:
            sim.engine.close()


def told(error: Exception) -> dict[str, Any]:
    """Fields `error` and `traceback` of a message about an error in a task's or a policy's code."""
    lines = (
        error.traceback
        if isinstance(error, FarmError) and error.traceback
        else plugins.author_traceback(error)
    )
    text = str(error) if isinstance(error, FarmError) else described(error)
    return {"error": brief(text), "traceback": lines}


_Part: TypeAlias = tuple[IntArray, Rollouts]
"""Rows of some of a call's rollouts, and their results."""


def _placed(parts: list[_Part], values: Callable[[Rollouts], AnyArray]) -> AnyArray:
    """Values of all rollouts (S, ...), from those of each part."""
    pieces = [values(rollouts) for _, rollouts in parts]
    if len(parts) == 1:  # the usual case: its rows are all rows
        return pieces[0]
    out = np.empty((sum(map(len, pieces)), *pieces[0].shape[1:]), pieces[0].dtype)
    for (rows, _), each in zip(parts, pieces, strict=True):
        out[rows] = each
    return out


def _moments(rollouts: Rollouts, size: int) -> FloatArray:
    """Moments of the observations (n, 1 + 2 d) as they are sent: zeros for those that failed or
    have none.
    """
    if not rollouts.moments.size:
        return np.zeros((len(rollouts.returns), 1 + 2 * size))
    return np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))


def served(
    spec: Spec, files: tuple[Path, ...] = (), contents: Mapping[str, bytes] = MappingProxyType({})
) -> tuple[Task, Policy]:
    """The task and the policy of a run that a learner specified.

    Args:
      spec: what it says.
      files: files whose classes may be served.
      contents: what is in the run's files that are no texts, by SHA-256.

    Raises:
      UnservedError: it names something that is missing here, is not allowed, or has different code
          here.
    """
    try:
        task_class = _plugin("tasks", spec.task, spec.code.get("task"), spec.release, files)
        policy_class = _plugin(
            "policies", spec.policy, spec.code.get("policy"), spec.policy_release, files
        )
        if plugins.code_digest(SIMULATION) != spec.code.get("simulation"):
            raise UnservedError(
                f"its simulation's code differs from the learner's (farm/); {_SAME}"
            )
        task = build_task(task_class, spec.task_config, joined(spec.files, spec.assets, contents))
        sizes = specification(task)
        if sizes.release != spec.task_release:
            raise UnservedError(
                f"the run uses {spec.task} of {spec.task_release}, but {sizes.release} is installed"
                " here"
            )
        config = settings.from_dict(policy_class.target.Config, spec.policy_config, spec.policy)
        return task, build_policy(policy_class, config, sizes, spec.constants)
    except UnservedError:
        raise
    except ConfigError as error:
        raise UnservedError(str(error)) from error


def build_task(plugin: plugins.Plugin, values: Mapping[str, Any], files: Files | None) -> Task:
    """A task from its class, the settings in a table, and the run's files."""
    config = settings.from_dict(plugin.target.Config, dict(values), plugin.wire)
    return cast(
        "Task", _constructed(plugin, "config, variant and files", config, plugin.variant, files)
    )


def task_of(task: object, *, preset: bool = False, **values: Any) -> Task:  # noqa: ANN401  settings, checked there
    """A task from its name, FILE.py:CLASS, its class, or an object of it, which has its settings.

    With `preset`, settings that are not among `values` are those of `farm run`: of the first
    preset.

    Raises:
      ConfigError: there is no such task, or a setting is invalid.
    """
    if isinstance(task, Task):
        if values:
            names = ", ".join(values)
            raise ConfigError(
                f"{names}: the task is an object that has its settings; give its class"
            )
        return task
    if isinstance(task, str):
        plugin = plugins.find("tasks", task)
    else:
        plugin = plugins.Plugin("tasks", getattr(task, "__name__", ""), task)
    kind: object = plugin.target
    if not isinstance(kind, type) or not issubclass(kind, Task):
        what = task if isinstance(task, str) else f"a {type(task).__name__}"
        raise ConfigError(f"task is {what}; expected a farm.Task, its class, or its name")
    first = next(iter(kind.presets.values()), {}) if preset else {}
    settable = {each.name for each in fields(kind.Config)}
    usual = {name: value for name, value in first.items() if name in settable}
    return build_task(plugin, {**usual, **values}, None)


def draw_constants(
    plugin: plugins.Plugin,
    config: Any,  # noqa: ANN401  the policy's own settings
    task: Task,
    spec: TaskSpec,
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """New constants of a policy, from its class and its settings; a ConfigError if they are
    invalid.
    """
    constants: object = plugin.target.draw(config, spec, rng)
    if not isinstance(constants, dict) or not all(
        _is_constant(values) for values in constants.values()
    ):
        raise ConfigError(
            f"draw of {plugin.wire} gave {constants!r:.60}; expected finite float64 arrays by name"
        )
    return (
        constants | standard(task, config.weight_scale) if plugin.target.standardised else constants
    )


def _is_constant(values: object) -> bool:
    return (
        isinstance(values, np.ndarray)
        and values.dtype == np.float64
        and bool(np.isfinite(values).all())
    )


def build_policy(
    plugin: plugins.Plugin,
    config: Any,  # noqa: ANN401  the policy's own settings
    spec: TaskSpec,
    constants: Mapping[str, FloatArray],
) -> Policy:
    """A policy from its class, its settings, the task's sizes and the run's constants.

    Raises:
      ConfigError: it cannot be constructed, or its size, methods, memory or scale are invalid.
    """
    policy = cast(
        "Policy", _constructed(plugin, "config, spec and constants", config, spec, constants)
    )
    if type(policy).size is Policy.size:
        raise ConfigError(f"{plugin.wire} has no size: the number of its parameters")
    if type(policy).act is Policy.act:
        raise ConfigError(f"{plugin.wire} has no act(self, prepared, x): its actions")
    size: object = policy.size
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
        raise ConfigError(
            f"size of {plugin.wire} is {size!r}; expected a whole number of at least 1"
        )
    check_vector(f"memory of {plugin.wire}", policy.memory)
    check_vector(f"scale of {plugin.wire}", policy.scale, int(size))
    if policy.scale is not None and not (policy.scale > 0.0).all():
        raise ConfigError(
            f"scale of {plugin.wire} has {policy.scale.min()}; expected positive numbers"
        )
    _check_signatures(plugin, policy)
    return policy


def _check_signatures(plugin: plugins.Plugin, policy: Policy) -> None:
    """Check that a policy's methods take what they are given."""
    remembers = ("memory",) if policy.memory is not None else ()
    for method, names in (("prepare", ("theta",)), ("act", ("prepared", "x", *remembers))):
        with suppress(ValueError):  # of a call that is not Python's, nobody knows
            signature = inspect.signature(getattr(policy, method))
            try:
                signature.bind(*names)
            except TypeError:
                raise ConfigError(
                    f"{plugin.wire}: {method}{signature}; expected ({', '.join(names)})"
                ) from None


@plugins.no_exit
def _constructed(plugin: plugins.Plugin, arguments: str, *values: Any) -> Any:  # noqa: ANN401
    try:
        return plugin.target(*values)
    except TypeError as error:
        # The error is in the call itself
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:
            raise ConfigError(
                f"{plugin.wire}: its __init__ must take {arguments} ({error})"
            ) from None
        raise


_SAME = "install the learner's release on both sides"


def _plugin(
    kind: str, name: str, digest: str | None, release: str, files: tuple[Path, ...]
) -> plugins.Plugin:
    """The class named in a specification, if its code is the same as the learner's."""
    base = {"tasks": Task, "policies": Policy}[kind]
    from_file = plugins.named_file(name) != ""
    plugin = (
        plugins.allowed(kind, name, digest or "", files) if from_file else plugins.find(kind, name)
    )
    if not (isinstance(plugin.target, type) and issubclass(plugin.target, base)):
        raise UnservedError(f"{name} is not a {base.__name__}")
    if from_file:
        return plugin
    if plugin.release != release:
        here, learners = (each or "rolloutfarm" for each in (plugin.release, release))
        raise UnservedError(f"the run uses {name} of {learners}, but here {name} belongs to {here}")
    if plugin.digest() != digest:
        raise UnservedError(f"its code of {name!r} differs from the learner's: {_SAME}")
    return plugin


def make_backend(name: str) -> Backend:
    """The backend with this name; a ConfigError if there is none, or if it is no backend."""
    target = plugins.find("backends", name).target
    if not all(hasattr(target, each) for each in ("capacity", "engine")) or issubclass(
        target, Task
    ):
        raise ConfigError(f"{name} is no backend: it needs capacity and engine(model)")
    if type(target.capacity) is not int or target.capacity < 1:
        raise ConfigError(
            f"capacity of {name} is {target.capacity!r}; expected a whole number of at least 1"
        )
    return cast("Backend", target())


def is_exact(backend: Backend) -> bool:
    """Whether a backend's numbers are those of the backend `cpu`."""
    return bool(getattr(backend, "exact", True))
