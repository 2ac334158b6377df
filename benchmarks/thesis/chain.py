"""An upper level over learnt gaits: it lets one policy act until its goal grip is felt, then the next.

Plage 2016, 5.2: "an upper level control policy can then control the finger gaiting". This one feels what the task's
success feels: which fingertips press.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.policies.base import Policy
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS
from farm.tasks.finger_gait.task import PRESSES, SUCCESS_STEPS, FingerGait, stayed
from farm.tasks.loop import Batch, Seed, again
from learner.replay import LoadedPolicy


@dataclass(frozen=True)
class Chained:
    """Rollouts of a chain."""

    changes: IntArray
    """(B,) changes of grip until the end, or until the object was dropped or out of place."""
    acting: IntArray
    """(B, T) which policy acted, -1 after the end."""
    force: FloatArray
    """(B, T, 3) how hard each fingertip pressed [N], zero after the end."""


class _Hand(FingerGait):
    """The hand under whichever policy acts: actions are joint targets; it also ends where the object moved away."""

    def prepare(self, sim: Sim, rngs: Sequence[np.random.Generator | None]) -> None:
        """Remember where the object was released."""
        super().prepare(sim, rngs)
        sim.own["released"] = sim.qpos[:, len(JOINTS) :].copy()

    def ended(self, sim: Sim) -> BoolArray:
        """Where no fingertip touches the object any more, or it is out of place."""
        return super().ended(sim) | ~stayed(sim.qpos[:, len(JOINTS) :], sim.own["released"])


@dataclass(frozen=True)
class _Gait:
    """A learnt policy, with its own observation and its own meaning of an action."""

    task: FingerGait
    policy: Policy
    prepared: FloatArray
    """Of its one parameter vector, (1, ...)."""
    goal: BoolArray
    """Fingers of its goal grip, (3,)."""

    @classmethod
    def of(cls, learnt: LoadedPolicy, steps: int) -> "_Gait":
        """A gait that acts for up to so many steps."""
        known = cast("FingerGait", learnt.runner.task)
        task = FingerGait(replace(known.config, steps=steps), files=known.sources)
        task.start_commands = known.start_commands
        policy = learnt.problem.policy
        goal = np.array([finger in GRIPS[task.config.goal_grip] for finger in FINGERS])
        return cls(task, policy, policy.prepare(learnt.mu[None]), goal)

    def targets(self, sim: Sim, rows: IntArray) -> FloatArray:
        """Joint targets of some of the rollouts still going, (n, 8) [rad]."""
        x = self.task.observe(sim)[rows]
        actions = self.policy.act(np.repeat(self.prepared, len(rows), axis=0), x)
        theirs: Any = SimpleNamespace(own={"target": sim.own["target"][rows]})
        return self.task.act(theirs, actions)


def chain(policies: Sequence[LoadedPolicy], seeds: Sequence[Seed], steps: int) -> Chained:
    """Run policies in turn, the first one first, each from the grip in which the one before it ended.

    Args:
      policies: each one's goal grip has to be the next one's start grip.
      seeds: (B,) of perturbed starts.
      steps: control steps.

    Raises:
      ConfigError: the policies do not follow each other, or hold different objects.
    """
    configs: list[Any] = [policy.problem.config.task_config for policy in policies]
    for one, other in zip(configs, [*configs[1:], configs[0]], strict=True):
        if (one.goal_grip, one.object) != (other.start_grip, other.object):
            raise ConfigError(f"a gait to {one.goal_grip} is not followed by one from {other.start_grip}")
    config = replace(configs[0], steps=steps, action="absolute", clip=False)  # each gait's own task clips
    hand = _Hand(config, files=policies[0].problem.task.sources)
    sim = Sim(hand.engine(BatchEngine))
    again(lambda: hand.setup(sim))
    gaits = [_Gait.of(policy, steps) for policy in policies]
    size = sim.engine.size
    parts = [again(lambda i=i: _run(hand, sim, gaits, seeds[i : i + size])) for i in range(0, len(seeds), size)]
    return Chained(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("changes", "acting", "force")))


def _run(hand: _Hand, sim: Sim, gaits: Sequence[_Gait], seeds: Sequence[Seed]) -> Chained:
    """As many rollouts as are stepped together."""
    batch = Batch(hand, sim, seeds)
    goals = np.stack([gait.goal for gait in gaits])
    turn, felt, changes = (np.zeros(len(seeds), dtype=int) for _ in range(3))
    acting = np.full((len(seeds), hand.steps), -1)
    while not batch.over:
        going = batch.active
        acting[going, sim.t] = turn[going]
        batch.step(_targets(gaits, sim, turn[going]))
        going = batch.active
        pressing = hand.measure(sim)["force"].sum(axis=-1) >= PRESSES
        felt[going] = np.where((pressing == goals[turn[going]]).all(axis=-1), felt[going] + 1, 0)
        there = going[felt[going] >= SUCCESS_STEPS]
        changes[there] += 1
        turn[there] = (turn[there] + 1) % len(gaits)
        felt[there] = 0
    return Chained(changes, acting, batch.record().frames["force"].sum(axis=-1))


def _targets(gaits: Sequence[_Gait], sim: Sim, turn: IntArray) -> FloatArray:
    """Joint targets of the rollouts still going, each by the gait whose turn it is, (n, 8) [rad]."""
    targets = np.empty((len(turn), len(JOINTS)))
    for i, gait in enumerate(gaits):
        mine = np.flatnonzero(turn == i)
        if len(mine):
            targets[mine] = gait.targets(sim, mine)
    return targets
