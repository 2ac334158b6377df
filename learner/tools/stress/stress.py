"""A learnt policy under the conditions of `farm.Robust`: each cause alone and all together, at
several strengths.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.moments import merged, usable
from farm.net.work import Jobs, Simulated
from farm.sim.sim import WRITABLE
from farm.tasks import disturbances, loop
from farm.tasks.base import Task
from farm.tasks.loop import Advance, Kept, unseen
from farm.tasks.robust import PHYSICAL, Robust
from learner.run.evaluation import failures, statistics
from learner.tools.replay.loaded import LoadedPolicy, Replay

ALL: Final = "all together"

_ERROR: Final = 0.05  # noise and bias, of an observed number's standard deviation
_DELAY: Final = 0.04  # [s]
_PART: Final = 0.2  # by which motors and masses differ
_FRICTION: Final = (0.6, 1.4)
_PAYLOAD: Final = 0.1  # of the mass of all that moves
_PUSH: Final = 0.25  # of its weight


@dataclass(frozen=True)
class Stress:
    """Results of a policy under conditions, from the same starts in each cell."""

    robust: Robust
    """The conditions at strength 1."""
    declared: bool
    """Whether the task declares them."""
    strengths: tuple[float, ...]
    cells: Mapping[str, tuple[Mapping[str, Any], ...]]
    """Figures at each strength, by cause, ALL last."""
    shown: float
    """Strength at which the worst starts are shown: 1, or the next larger one there is, else the
    largest.
    """
    worst: tuple[int, ...]
    """Starts with all causes at that strength, those with the lowest returns first."""

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON."""
        table = {name: [dict(each) for each in row] for name, row in self.cells.items()}
        return {
            "declared": self.declared,
            "conditions": asdict(self.robust),
            "strengths": list(self.strengths),
            "causes": table,
            "worst": list(self.worst[:10]),
        }


def starts(count: int, seed: int) -> list[tuple[int, ...]]:
    """Seeds of starts, the same as those of `farm evaluate`: no run learns from them."""
    return [seeds.evaluation_start(seed, start) for start in range(count)]


def cells(robust: Robust, strengths: Sequence[float]) -> int:
    """Number of cells that are simulated."""
    return len(set(_places([*robust.causes, ALL], strengths)))


def stressed(
    policy: LoadedPolicy,
    robust: Robust,
    strengths: Sequence[float],
    count: int,
    seed: int,
    advance: Advance = unseen,
) -> Stress:
    """Run a policy under each cause alone, and under all together.

    Args:
      policy: of a run; the task's strength must be 1.
      robust: the conditions at strength 1.
      strengths: factors of their distance from none.
      count: rollouts in each cell.
      seed: of the starts.
      advance: is told how many rollouts are done.

    Raises:
      ConfigError: there are no conditions, or at some strength they do not fit the task.
    """
    task = policy.problem.task
    jobs = Jobs.mean("none", starts(count, seed))
    declared = task.robust is not None
    if not robust.causes:
        raise ConfigError("there are no conditions: the ranges of farm.Robust are all empty")
    rows = {cause: robust.only(cause) for cause in robust.causes} | {ALL: robust}
    for each in (one.scaled(strength) for one in rows.values() for strength in strengths):
        _put(task, each)  # all are checked before anything is simulated
        disturbances.check(task)
    results: dict[tuple[str, float], Simulated] = {}
    for cause, strength in _places(rows, strengths):
        if (cause, strength) not in results:
            _put(task, rows[cause].scaled(strength))
            results[cause, strength] = policy.runner.run(policy.mu, jobs, advance=advance)
    _put(task, robust if declared else None)
    figures = [_figures(policy, results[place]) for place in _places(rows, strengths)]
    cells = {
        cause: tuple(figures[i * len(strengths) : (i + 1) * len(strengths)])
        for i, cause in enumerate(rows)
    }
    displayed = min((strength for strength in strengths if strength >= 1.0), default=max(strengths))
    return Stress(
        robust, declared, tuple(strengths), cells, displayed, _worst(results[ALL, displayed])
    )


def _places(rows: Iterable[str], strengths: Sequence[float]) -> list[tuple[str, float]]:
    """Cause and strength that are simulated for each cell, row by row: at strength 0 all causes
    are alike.
    """
    return [(cause if strength else ALL, strength) for cause in rows for strength in strengths]


def _worst(results: Simulated) -> tuple[int, ...]:
    """Starts by their returns, the lowest first.

    Those that failed have none and are before them.
    """
    failed = results.flags[:, 2] | results.flags[:, 3]
    return tuple(np.argsort(np.where(failed, -np.inf, results.returns), kind="stable").tolist())


def again(
    policy: LoadedPolicy, stress: Stress, indices: Sequence[int], count: int, seed: int
) -> list[Replay]:
    """Rollouts from some of the starts, with all causes at the strength that is shown, at physics
    rate.
    """
    all_starts = starts(count, seed)
    _put(policy.problem.task, stress.robust.scaled(stress.shown))
    return policy.rollouts(
        np.repeat(policy.mu[None], len(indices), axis=0), [all_starts[i] for i in indices]
    )


def sensible(policy: LoadedPolicy, seed: int, body: str = "") -> Robust:
    """Conditions for a task that declares none.

    Noise and bias are 5 % of each observed number's standard deviation in the policy's own
    rollouts; delays up to 40 ms; motors and masses 20 % weaker or stronger; friction 40 %; a
    payload of up to 10 % of the mass of all that moves, and a push of up to a quarter of its weight
    for 0.2 s. Causes that the model or engine cannot have are left out.

    Raises:
      ConfigError: there is no such body, or nothing can be pushed.
    """
    task = policy.problem.task
    error = tuple((_ERROR * _spread(policy, seed)).tolist())
    duration = task.steps * task.period
    delay = (0.0, min(_DELAY, 0.5 * duration))
    model = task.model
    mass = float(model.body_mass[model.body_weldid > 0].sum())
    push = {
        "push": (0.0, _PUSH * 9.81 * mass),
        "push_duration": min(0.2, 0.5 * duration),
        "body": body,
    }
    candidates: list[dict[str, Any]] = [
        {"noise": error},
        {"bias": error},
        {"observation_delay": delay},
        {"action_delay": delay},
        {"motors": (1.0 - _PART, 1.0 + _PART)},
        {"mass": (1.0 - _PART, 1.0 + _PART)},
        {"payload": (0.0, _PAYLOAD * mass), "body": body},
        {"friction": _FRICTION},
        push,
    ]
    if not (model.geom_contype.any() or model.npair):
        candidates = [each for each in candidates if "friction" not in each]
    if not getattr(policy.runner.sim.engine, "writable", WRITABLE):
        if body:
            raise ConfigError(
                f"--body {body}: nothing can be pushed in an environment that steps itself"
            )
        candidates = [each for each in candidates if not set(each) & set(PHYSICAL)]
    settings: dict[str, Any] = {}
    for each in candidates:
        _put(task, Robust(**each))
        try:
            disturbances.check(task)
        except ConfigError:
            if body and "body" in each:
                raise
            continue
        finally:
            _put(task, None)
        settings |= each
    robust = Robust(**settings)
    return (
        replace(robust, body=model.body(disturbances.body_of(robust, model)).name)
        if "push" in settings
        else robust
    )


def _spread(policy: LoadedPolicy, seed: int) -> FloatArray:
    """Standard deviations of what the policy observes in rollouts without any of the conditions,
    of those that do not fail, (d,).
    """
    runner = policy.runner
    count = 16
    theta = np.repeat(policy.mu[None], count, axis=0)
    rollouts, _ = loop.run(
        runner.task,
        runner.policy,
        runner.sim,
        theta,
        starts(count, seed),
        runner.spec,
        Kept(moments=True),
    )
    size = runner.spec.observation
    moments = np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))
    total = merged(np.zeros(1 + 2 * size), moments)
    return np.sqrt(total[1 + size :] / max(total[0], 1.0))


def _put(task: Task, robust: Robust | None) -> None:
    """Let a task's next rollouts have these conditions."""
    task.robust = robust


def _figures(policy: LoadedPolicy, results: Simulated) -> dict[str, Any]:
    """Figures of a cell."""
    flags = results.flags
    return {
        "rollouts": len(flags),
        "success_rate": float(flags[:, 0].mean()) if policy.problem.spec.success else None,
        "ended": int(flags[:, 1].sum()),
        "failed": failures(flags),
        **statistics(results.returns),
    }
