"""Builds a run's simulation from its specification and runs jobs; for workers and learners."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np

from farm import plugins, settings
from farm.arrays import AnyArray, FloatArray, IntArray
from farm.errors import ConfigError, UnservedError
from farm.moments import usable
from farm.net.messages import Spec
from farm.net.work import NOT_NORMALISED, Jobs, Simulated, WireTrajectory, traced
from farm.policies.base import Policy
from farm.policies.normalised import Normalised
from farm.sim.engines import BatchEngine
from farm.sim.scene import Scene, quiet
from farm.sim.sim import Backend, MakeEngine, Sim
from farm.tasks import loop
from farm.tasks.base import Task, TaskSpec

SIMULATION = "farm.tasks.loop"
"""The module whose code, with all its imports, determines every rollout's numbers, with task and policy."""


class Runner:
    """Runs one run's jobs."""

    def __init__(self, task: Task, policy: Policy, make: MakeEngine = BatchEngine, *, exact: bool = True) -> None:
        """Prepare the simulation; a ConfigError if the task cannot start.

        Args:
          task: what is simulated.
          policy: what decides the actions.
          make: makes the engine.
          exact: whether its numbers are MuJoCo's on a processor. If not, MuJoCo on this processor simulates the mean
            policy and every rollout that is shown; the engine simulates what explores.
        """
        quiet()
        self.task, self.policy = task, policy
        self.spec, self.scene = policy.spec, Scene(task.model)
        self.sim = Sim(task.engine(make))
        self._judge = self.sim if exact else Sim(task.engine(BatchEngine))
        loop.again(lambda: task.setup(self._judge))

    @property
    def size(self) -> int:
        """Parameters of the policy, P."""
        return int(self.policy.size)  # a class of one's own may give numpy's integers

    def run(
        self, mu: FloatArray, jobs: Jobs, traces: str = "none", normaliser: FloatArray = NOT_NORMALISED
    ) -> Simulated:
        """Run jobs around a mean (P,).

        Args:
          mu: (P,).
          jobs: what to run.
          traces: which traces of exploring rollouts to return, one of TRACES.
          normaliser: as in a RoundHeader, (2, 2, d); with d > 0 the result has moments of the observations.

        Raises:
          UnservedError: the normaliser does not match the observations.
        """
        theta, seeds = jobs.theta(mu), jobs.seeds()
        policies, wanted = self._normalised(normaliser), normaliser.shape[-1]
        kinds = jobs.physics * (1 + ~jobs.around) if wanted else jobs.physics * 1  # 2: has its own normaliser
        if self._judge is not self.sim:
            kinds[(jobs.seen | ~jobs.explores) & ~jobs.physics] = 3  # like 0, but on the processor
        kind_of, there = np.repeat(kinds, jobs.rollouts), sorted(set(kinds.tolist()))
        seen: dict[int, WireTrajectory] = {}
        done: list[_Part] = []
        for kind in there:
            rows, physics = np.flatnonzero(kind_of == kind), kind in (1, 2)
            some = (theta, seeds) if len(there) == 1 else (theta[rows], [seeds[row] for row in rows.tolist()])
            rollouts = loop.run(
                self.task, policies[kind % 3], self._judge if kind else self.sim, *some, int(physics),
                moments=bool(wanted) and not physics,
            )  # fmt: skip
            for job in np.flatnonzero(jobs.seen & (kinds == kind)).tolist():
                first = int(jobs.rollouts[:job].sum())
                seen[job] = WireTrajectory.of(self.trajectory(rollouts, int(np.searchsorted(rows, first))))
            done.append((rows, rollouts))
        returns = _placed(done, lambda part: part.returns)
        chosen = traced(traces if self.spec.traced else "none", returns, ~np.repeat(jobs.seen, jobs.rollouts))
        return Simulated(
            returns,
            _placed(done, lambda part: part.flags),
            _placed(done, lambda part: part.steps),
            self._traces(done, chosen),
            tuple(seen[job] for job in sorted(seen)),
            _placed(done, lambda part: _moments(part, wanted)) if wanted else np.empty((0, 0)),
        )

    def _traces(self, done: "list[_Part]", chosen: IntArray) -> AnyArray:
        """Traces of the chosen rollouts, (K, T, N)."""
        values = np.zeros((len(chosen), *self.spec.trace), dtype="<f4")
        for rows, rollouts in done if len(chosen) else ():
            mine = np.isin(chosen, rows)
            if mine.any():
                values[mine] = loop.traces(self.task, self.spec, rollouts, np.searchsorted(rows, chosen[mine]))
        return values

    def _normalised(self, normaliser: FloatArray) -> tuple[Policy, Policy, Policy]:
        """Policies for jobs at control rate, at physics rate, and with parameters of their own."""
        if normaliser.shape[-1] not in (0, self.spec.observation):
            raise UnservedError(f"a normaliser of {normaliser.shape[-1]} numbers, not {self.spec.observation}")
        if not normaliser.size:
            return (self.policy,) * 3
        around, own = (Normalised(self.policy, each) for each in normaliser)
        return around, around, own

    def rollouts(self, theta: FloatArray, seeds: list[loop.Seed], *, physics: bool = False) -> loop.Rollouts:
        """Rollouts of parameters theta (B, P), with one frame per control step or per physics step."""
        return loop.run(self.task, self.policy, self.sim, theta, seeds, 1 if physics else 0)

    def trajectory(self, rollouts: loop.Rollouts, row: int) -> Any:  # noqa: ANN401  a Trajectory
        """One of them, frame by frame."""
        return loop.trajectory(self.task, self.spec, self.scene, rollouts, row)

    def close(self) -> None:
        """Release its resources."""
        for sim in {self.sim, self._judge}:
            sim.engine.close()


_Part: TypeAlias = tuple[IntArray, loop.Rollouts]
"""Some of a call's rollouts: their rows, and their results."""


def _placed(parts: list[_Part], values: Callable[[loop.Rollouts], AnyArray]) -> AnyArray:
    """Values of all rollouts (S, ...), from those of each part."""
    found = [values(rollouts) for _, rollouts in parts]
    if len(parts) == 1:  # the usual case: its rows are all rows
        return found[0]
    out = np.empty((sum(map(len, found)), *found[0].shape[1:]), found[0].dtype)
    for (rows, _), each in zip(parts, found, strict=True):
        out[rows] = each
    return out


def _moments(rollouts: loop.Rollouts, size: int) -> FloatArray:
    """Moments of the observations (n, 1 + 2 d) as they are sent: zeros for those that failed or have none."""
    if not rollouts.moments.size:
        return np.zeros((len(rollouts.returns), 1 + 2 * size))
    return np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))


def served(spec: Spec, files: tuple[Path, ...] = ()) -> tuple[Task, Policy]:
    """The task and the policy of a run that a learner specified; these files may be served.

    Raises:
      UnservedError: it names something that is missing here, is not allowed, or has different code here.
    """
    try:
        task_class = _plugin("tasks", spec.task, spec.code.get("task"), spec.release, files)
        policy_class = _plugin("policies", spec.policy, spec.code.get("policy"), spec.policy_release, files)
        if plugins.code_digest(SIMULATION) != spec.code.get("simulation"):
            raise UnservedError(f"its simulation's code differs from the learner's (farm/); {_SAME}")
        task = build_task(task_class, spec.task_config, spec.files)
        sizes = task.spec()
        if sizes.release != spec.task_release:
            raise UnservedError(
                f"the run uses {spec.task} of {spec.task_release}, but {sizes.release} is installed here"
            )
        config = settings.from_dict(policy_class.target.Config, spec.policy_config, spec.policy)
        return task, build_policy(policy_class, config, sizes, spec.constants)
    except UnservedError:
        raise
    except ConfigError as error:
        raise UnservedError(str(error)) from error


def build_task(plugin: plugins.Plugin, values: Mapping[str, Any], files: Mapping[str, str] | None) -> Task:
    """A task from its class, the settings in a table, and the run's texts."""
    config = settings.from_dict(plugin.target.Config, dict(values), plugin.wire)
    return cast("Task", _constructed(plugin, "config, variant and files", config, plugin.variant, files))


def build_policy(plugin: plugins.Plugin, config: Any, spec: TaskSpec, constants: Mapping[str, FloatArray]) -> Policy:  # noqa: ANN401
    """A policy from its class, its settings, the task's sizes and the run's constants.

    Raises:
      ConfigError: it cannot be constructed, or its size is invalid.
    """
    policy = cast("Policy", _constructed(plugin, "config, spec and constants", config, spec, constants))
    size: object = policy.size
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
        raise ConfigError(f"size of {plugin.wire} is {size!r}; expected a whole number of at least 1")
    return policy


def _constructed(plugin: plugins.Plugin, arguments: str, *values: Any) -> Any:  # noqa: ANN401
    try:
        return plugin.target(*values)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:  # the error is in the call itself
            raise ConfigError(f"{plugin.wire}: its __init__ must take {arguments} ({error})") from None
        raise


_SAME = "install the learner's release on both sides"


def _plugin(kind: str, name: str, digest: str | None, release: str, files: tuple[Path, ...]) -> plugins.Plugin:
    """The class named in a specification, if its code is the same as the learner's."""
    base = {"tasks": Task, "policies": Policy}[kind]
    from_file = plugins.named_file(name) != ""
    found = plugins.allowed(kind, name, digest or "", files) if from_file else plugins.find(kind, name)
    if not (isinstance(found.target, type) and issubclass(found.target, base)):
        raise UnservedError(f"{name} is not a {base.__name__}")
    if from_file:
        return found
    if found.release != release:
        own, there = found.release or "rolloutfarm", release or "rolloutfarm"
        raise UnservedError(f"the run uses {name} of {there}, but here {name} belongs to {own}")
    if found.digest() != digest:
        raise UnservedError(f"its code of {name!r} differs from the learner's: {_SAME}")
    return found


def backend(name: str) -> Backend:
    """The backend with this name; a ConfigError if there is none, or if it is no backend."""
    target = plugins.find("backends", name).target
    if not all(hasattr(target, each) for each in ("capacity", "engine")) or issubclass(target, Task):
        raise ConfigError(f"{name} is no backend: it needs capacity and engine(model)")
    if type(target.capacity) is not int or target.capacity < 1:
        raise ConfigError(f"capacity of {name} is {target.capacity!r}; expected a whole number of at least 1")
    return cast("Backend", target())


def exact(backend: Backend) -> bool:
    """Whether a backend's numbers are those of the backend `cpu`."""
    return bool(getattr(backend, "exact", True))
