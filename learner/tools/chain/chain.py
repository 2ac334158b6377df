"""An upper level above learnt policies: each acts until its goal is reached, then the next one
takes over.

Plage 2016, 5.2: "an upper level control policy can then control the finger gaiting". A task can be
chained if it defines the names of its start and goal (`ends`), when the goal is reached (`reached`)
and when a rollout has failed (`lost`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Acting, Batch, again
from farm.tasks.rollouts import Rollouts, Seed
from learner.tools.replay.loaded import LoadedPolicy

FELT: Final = 3
"""Successive control steps for which a goal must be reached before the next policy acts."""


@dataclass(frozen=True)
class Chained:
    """Rollouts of a chain."""

    changes: IntArray
    """(B,) number of goals reached before the rollout ended or failed."""
    acting: IntArray
    """(B, T) index of the policy that acted, -1 after the end."""
    rollouts: Rollouts
    """Rollouts of the first policy's task, whose actions here are controls."""
    task: Task
    """Task of the first policy."""


@dataclass(frozen=True)
class _Link:
    """A policy of the chain, and the task that computes its observations and controls."""

    task: Task
    policy: LoadedPolicy

    @classmethod
    def of(cls, learnt: LoadedPolicy, steps: int) -> "_Link":
        """A policy that acts for up to this number of steps.

        Raises:
          ConfigError: its task's action space remembers how a rollout began.
        """
        task = _longer(type(learnt.problem.task), learnt, steps)
        sim = Sim(task.engine(lambda model: BatchEngine(model, 1)))
        again(lambda: task.setup(sim))
        if task.space:
            before = set(sim.own)
            task.space.begin(sim)
            if set(sim.own) - before:
                raise ConfigError(
                    f"{learnt.problem.config.task} cannot be chained: its"
                    f" {type(task.space).__name__} remembers how a rollout began, and a policy of a"
                    " chain begins within one"
                )
        return cls(task, learnt)

    def controls(
        self, sim: Sim, acting: Acting, going: IntArray, turn: BoolArray
    ) -> tuple[FloatArray, Mapping[str, AnyArray]]:
        """Controls (n, nu) and written states (n, ...) of the rollouts `going` (n,); right for
        those whose turn is this policy's, `turn` (n,).
        """
        x = self.task.observe(sim)
        if self.task.space:
            x = self.task.space.see(sim, x)
        action = np.zeros((len(sim), self.policy.problem.spec.action))
        if turn.any():
            action[turn] = acting.act(x[turn], going[turn])
        with sim.writing() as states:
            return self.task.act(sim, action), states


def chain(
    policies: Sequence[LoadedPolicy], seeds: Sequence[Seed], steps: int, *, every: int = 0
) -> Chained:
    """Run policies in turn, each from where the previous one ended; the first follows the last.

    Args:
      policies: learnt on tasks that can be chained.
      seeds: seeds of the starts, (B,).
      steps: largest number of control steps.
      every: physics steps between two frames; 0: one frame per control step.

    Raises:
      ConfigError: the policies do not follow each other, simulate different models, or need the
        beginning of a rollout.
    """
    check(policies)
    first = policies[0]
    attributes = {
        "actions": (),
        "act": lambda _, __, action: action,
        "ended": lambda self, sim: self.lost(sim),
    }
    upper: Any = type("Upper", (type(first.problem.task),), attributes)
    task: Any = _longer(upper, first, steps)
    sim = Sim(task.engine(BatchEngine))
    again(lambda: task.setup(sim))
    links, size = [_Link.of(policy, steps) for policy in policies], sim.engine.size
    parts = [
        again(lambda i=i: _run(task, sim, links, seeds[i : i + size], every))
        for i in range(0, len(seeds), size)
    ]
    changes, acting, rollouts = zip(*parts, strict=True)
    return Chained(np.concatenate(changes), np.concatenate(acting), Rollouts.joined(rollouts), task)


def check(policies: Sequence[LoadedPolicy]) -> None:
    """Check that each policy ends where the next one begins.

    Raises:
      ConfigError: one does not; names both.
    """
    if not policies:
        raise ConfigError(
            "a chain needs policies: give one run or more, in the order in which their policies act"
        )
    tasks: list[Any] = [policy.problem.task for policy in policies]
    for policy, task in zip(policies, tasks, strict=True):
        if task.ends is None:
            raise ConfigError(
                f"{policy.problem.config.task} cannot be chained: its task has no `ends`"
            )
        _check_ends(task)
    for one, other in pairwise([*tasks, tasks[0]]):
        if one.ends[1] != other.ends[0]:
            raise ConfigError(
                f"a policy that ends in {one.ends[1]} is not followed by one from {other.ends[0]}:"
                " give runs of which each begins where the one before ends, the first where the"
                " last does"
            )
        if one.sources != other.sources:
            raise ConfigError(
                f"the policies from {one.ends[0]} and from {other.ends[0]} simulate different"
                " models: learn both on the same one"
            )


def _check_ends(task: Task) -> None:
    """Check that a task names two ends, and says when they are reached and rollouts lost."""
    name, ends = type(task).__name__, task.ends
    if not isinstance(ends, tuple | list) or [type(each) for each in ends] != [str, str]:
        raise ConfigError(f"task {name}: ends is {ends!r:.60}; expected where it begins and ends")
    for method in ("reached", "lost"):
        if getattr(type(task), method) is getattr(Task, method):
            raise ConfigError(f"task {name} has `ends`, but no {method}(self, sim), as chains need")


def _longer(kind: type[Task], learnt: LoadedPolicy, steps: int) -> Task:
    task = learnt.problem.task
    return kind(replace(task.config, steps=steps, robust=0.0), task.variant, task.sources)


def _run(
    task: Task, sim: Sim, links: Sequence[_Link], seeds: Sequence[Seed], every: int
) -> tuple[IntArray, IntArray, Rollouts]:
    """Rollouts of a chain that are stepped together."""
    batch = Batch(task, sim, seeds, every)
    agents = [link.policy.acting(len(seeds)) for link in links]
    turn, felt, changes = (np.zeros(len(seeds), dtype=int) for _ in range(3))
    acting = np.full((len(seeds), task.steps), -1)
    while not batch.over:
        going = batch.active
        acting[going, sim.t] = turn[going]
        batch.step(_controls(links, agents, sim, going, turn[going]))
        going = batch.active
        reached = np.stack([link.task.reached(sim) for link in links])[
            turn[going], np.arange(len(going))
        ]
        felt[going] = np.where(reached, felt[going] + 1, 0)
        arrivals = going[felt[going] >= FELT]
        changes[arrivals] += 1
        turn[arrivals] = (turn[arrivals] + 1) % len(links)
        felt[arrivals] = 0
        for agent in agents:
            agent.forget(arrivals)
    return changes, acting, batch.rollouts()


def _controls(
    links: Sequence[_Link], agents: Sequence[Acting], sim: Sim, going: IntArray, turn: IntArray
) -> FloatArray:
    """Controls (n, nu) of the rollouts `going` (n,), each by the policy whose turn it is, (n,)."""
    before: Mapping[str, Any] = {name: np.array(values) for name, values in sim.own.items()}
    controls, memories, states = [], [], []
    # All tasks for all rollouts: a row's result does not depend on the others
    for i, link in enumerate(links):
        sim.own.clear()
        sim.own.update({name: values.copy() for name, values in before.items()})
        values, writes = link.controls(sim, agents[i], going, turn == i)
        controls.append(values)
        memories.append(dict(sim.own))
        states.append(writes)
    rows = np.arange(len(turn))
    sim.own.clear()
    for name in dict.fromkeys(name for each in memories for name in each):
        default = next(each[name] for each in memories if name in each)  # memory of one task only
        sim.own[name] = np.stack([each.get(name, default) for each in memories])[turn, rows]
    for name in dict.fromkeys(name for each in states for name in each):
        sim.write(
            {name: np.stack([each.get(name, getattr(sim, name)) for each in states])[turn, rows]}
        )
    return np.stack(controls)[turn, rows]
