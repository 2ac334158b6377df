"""Builds a run's simulation from its specification and runs jobs; for workers and learners."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from farm import plugins, settings
from farm.arrays import FloatArray, IntArray
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
from farm.tasks.base import Task

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
        return self.policy.size

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
        kind_of, there = np.repeat(kinds, jobs.rollouts), set(kinds.tolist())
        returns, flags = np.zeros(len(theta)), np.zeros((len(theta), 4), dtype=bool)
        steps = np.zeros(len(theta), dtype="<i8")
        moments = np.zeros((len(theta), 1 + 2 * wanted) if wanted else (0, 0))
        seen: dict[int, WireTrajectory] = {}
        done: list[tuple[IntArray, loop.Rollouts]] = []
        for kind, policy in enumerate((*policies, policies[0])):
            if kind not in there:
                continue
            rows, physics = np.flatnonzero(kind_of == kind), kind in (1, 2)
            rollouts = loop.run(
                self.task, policy, self._judge if kind else self.sim, theta[rows], [seeds[r] for r in rows.tolist()],
                int(physics), moments=bool(wanted) and not physics,
            )  # fmt: skip
            returns[rows], flags[rows], steps[rows] = rollouts.returns, rollouts.flags, rollouts.steps
            if rollouts.moments.size:
                moments[rows] = np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))
            for job in np.flatnonzero(jobs.seen & (kinds == kind)).tolist():
                first = int(jobs.rollouts[:job].sum())
                seen[job] = WireTrajectory.of(self.trajectory(rollouts, int(np.searchsorted(rows, first))))
            done.append((rows, rollouts))
        chosen = traced(traces if self.spec.traced else "none", returns, ~np.repeat(jobs.seen, jobs.rollouts))
        values = np.zeros((len(chosen), *self.spec.trace), dtype="<f4")
        for rows, rollouts in done:
            mine = np.isin(chosen, rows)
            if mine.any():
                values[mine] = loop.traces(self.task, self.spec, rollouts, np.searchsorted(rows, chosen[mine]))
        return Simulated(returns, flags, steps, values, tuple(seen[job] for job in sorted(seen)), moments)

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
        return task, policy_class.target(config, sizes, spec.constants)
    except UnservedError:
        raise
    except ConfigError as error:
        raise UnservedError(str(error)) from error


def build_task(plugin: plugins.Plugin, values: Mapping[str, Any], files: Mapping[str, str] | None) -> Task:
    """A task from its class, the settings in a table, and the run's texts."""
    config = settings.from_dict(plugin.target.Config, dict(values), plugin.wire)
    try:
        return cast("Task", plugin.target(config, plugin.variant, files))
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:  # the error is in the call itself
            raise ConfigError(f"{plugin.wire}: its __init__ must take config, variant and files ({error})") from None
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
    return cast("Backend", target())


def exact(backend: Backend) -> bool:
    """Whether a backend's numbers are those of the backend `cpu`."""
    return bool(getattr(backend, "exact", True))
